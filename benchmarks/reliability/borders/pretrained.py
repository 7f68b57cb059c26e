"""Trained filters in folders."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

from benchmarks.reliability import damage as d
from benchmarks.reliability.borders.checkpoints import WEIGHTS as CHANGES
from benchmarks.reliability.borders.checkpoints import in_first
from benchmarks.reliability.borders.lerobot import in_json
from benchmarks.reliability.damage import fields, same
from benchmarks.reliability.hostile import PICKLES, npz_of_zeros
from benchmarks.reliability.target import Folder, Subject, Target, targets_of
from torch_denkf import _registered
from torch_denkf.applications.car.odometry.checkpoint import load_car_filter
from torch_denkf.applications.reacher import reacher
from torch_denkf.deployment.folder import described
from torch_denkf.pretrained import from_pretrained, save_pretrained

CONFIG, WEIGHTS = "config.json", "weights.safetensors"
FOLDERS = _registered.weights()
LOADERS: dict[str, Callable[[Path], Any]] = {"reacher": from_pretrained, "car-odometry": load_car_filter}
NAN, INF = float("nan"), float("inf")


def _weights(name: str, folder: Path) -> Any:
    return dict(LOADERS[name](folder).state_dict())


def in_config(change: d.Change) -> d.Change:
    """Changes the description, and its checksum, as somebody with bad intentions would."""

    def act(file: Path) -> None:
        in_json(change)(file)
        content = json.loads(file.read_text())
        if isinstance(content, dict):
            file.write_text(described(content))

    return act


def signed(change: d.Change) -> d.Change:
    """Changes the file of weights, and its checksum, as somebody with bad intentions would."""

    def act(file: Path) -> None:
        change(file)
        if file.is_file():
            digest = hashlib.sha256(file.read_bytes()).hexdigest()
            in_config(lambda content: content.update(sha256=digest))(file.with_name(CONFIG))

    return act


def in_weights(change: d.Change) -> d.Change:
    """Changes the weights."""

    def act(file: Path) -> None:
        tensors = load_file(file)
        change(tensors)
        save_file(tensors, file)

    return signed(act)


def _header(size: int) -> d.Change:
    return signed(d.written(lambda data: struct.pack("<Q", size) + data[8:]))


FIELDS = {
    "format": d.types("nothing", "a list", "a fraction", another="x/9"),
    "builder": d.types("nothing", "a fraction", unknown="os.system") | {"a path": "../x", "a list": ["reacher"]},
    "settings": d.types("nothing", "a list", "text"),
    "sha256": d.types("nothing", "a fraction", another="0" * 64, empty=""),
}
NOTHING = d.types("nothing")
VECTOR = d.types("text", nan=[NAN] * 4, short=[0.0])
ANOTHER = {"colour": d.Wrong({"no such setting": "red"})}
#: Settings of a car's filter.
CAR = {
    "ensemble_size": d.LARGE_COUNT,
    "velocity_std": d.vector(2, positive=True),
    "velocity_mean": d.vector(2),
    **dict.fromkeys(("lags", "longest", "features"), d.COUNT),
    **dict.fromkeys(("dt", "reach", "focal", "inflation"), d.POSITIVE),
    "size": d.SIZE,
    **ANOTHER,
}
SETTINGS: dict[str, dict[str, d.Wrong]] = {
    "reacher": {
        "ensemble_size": d.LARGE_COUNT | NOTHING,
        "encoder_std": d.POSITIVE | NOTHING,
        "state_mean": VECTOR | NOTHING | {"empty": []},
        "state_std": VECTOR | {"zero": [0.0] * 4, "negative": [-1.0] * 4},
        "num_cells": d.types("text", others=[8, 8], empty=[], huge=[10**9, 10**9]) | {"negative": [-8]},
        **ANOTHER,
    },
    "car-odometry": {
        **CAR,
        **{name: CAR[name].but("a matrix") for name in ("velocity_std", "velocity_mean")},
        "ensemble_size": d.LARGE_COUNT | NOTHING,
        "dt": d.POSITIVE | NOTHING,
        "features": d.COUNT | {"others": 8},
    },
}
DAMAGE = d.Wrong(
    {
        **CHANGES,
        "a weight of infinity": lambda value: value + INF,
        "a weight of whole numbers": lambda value: value.long(),
    }
).each(in_first) | {"a weight more": lambda tensors: tensors.update(more=torch.ones(2)), "no weights": dict.clear}
HEADERS = {"no bytes": _header(0), "a terabyte": _header(1 << 40), "2^63 bytes": _header((1 << 63) + 5)}
NAMES = {
    "unknown": "walker",
    "outside": "../../etc",
    "absolute": "/etc",
    "empty": "",
    "a zero byte": "a\0b",
    "a number": 3,
}
SAVED = {
    "builder": d.Wrong({"none": None}),
    "settings": d.Wrong({"that JSON does not know": {"a": object()}, "with NaN": {"a": NAN}, "of text": "x"}),
    "training": d.Wrong({"that JSON does not know": {"a": object()}}),
}


def _saved(**given: Any) -> Any:
    own = {"builder": reacher, "settings": {}, **given}
    own = {name: value for name, value in own.items() if value is not None}
    return save_pretrained(torch.nn.Linear(2, 2), "folder", **own)


def _folders(name: str) -> Iterator[Target]:
    def right(weights: Any, near: float = 0.0) -> bool:
        return same(weights, _weights(name, FOLDERS[name]), rtol=near, atol=near)

    folder = Folder("pretrained", lambda: FOLDERS[name], partial(_weights, name))
    for file, wrong in ((CONFIG, d.BYTES), (WEIGHTS, d.SEALED)):
        yield folder.target(f"{name}, {file}", wrong.each(d.written), right, file=file)
        yield folder.target(f"{name}, {file} in its place", d.PLACES, file=file, within=4)
    yield folder.target(f"{name}, fields", fields(FIELDS).each(in_config), file=CONFIG)
    for setting, values in SETTINGS[name].items():
        wrong = fields({("settings", setting): values}, missing=False).each(in_config)
        yield folder.target(f"{name}, {setting}", wrong, words=(CONFIG, setting), file=CONFIG)
    yield folder.target(f"{name}, weights", DAMAGE.each(in_weights), file=WEIGHTS)
    half = in_weights(in_first(torch.Tensor.half))
    yield folder.one(
        f"{name}, a weight of half precision", half, WEIGHTS, file=WEIGHTS, right=partial(right, near=1e-2)
    )
    yield folder.target(f"{name}, a header of", HEADERS, file=WEIGHTS)
    hostile = {what: signed(d.instead(write)) for what, write in PICKLES.items()}
    yield folder.target(f"{name}, weights that are", hostile, file=WEIGHTS, within=4)


def targets() -> Iterator[Target]:
    """Trained filters, and the arguments of what reads and writes them."""
    npz_of_zeros(1 << 30)  # here, not in each case's process
    for name in LOADERS:
        yield from _folders(name)
    also = {"name_or_folder": ("config.json", "trained filter")}
    names = Subject(from_pretrained, wrong={"name_or_folder": d.Wrong(NAMES)}, also=also)
    yield from targets_of("pretrained", names, said=True)
    yield from targets_of("pretrained", Subject(_saved, wrong=SAVED, name="save_pretrained"))
