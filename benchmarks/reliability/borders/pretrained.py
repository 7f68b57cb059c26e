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
from safetensors.torch import load_file

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import same
from benchmarks.reliability.documents import edited
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
NAN = float("nan")


def _weights(name: str, folder: Path) -> Any:
    return dict(LOADERS[name](folder).state_dict())


def signed(change: d.Change) -> d.Change:
    """Changes the description or the weights, and the checksums, as somebody with bad intentions would."""

    def act(file: Path) -> None:
        change(file)
        config = file.with_name(CONFIG)
        if file.name == WEIGHTS and file.is_file():
            digest = hashlib.sha256(file.read_bytes()).hexdigest()
            edited(d.put(("sha256",), digest))(config)
        content = json.loads(config.read_text())
        if isinstance(content, dict):
            config.write_text(described(content))

    return act


def _header(size: int) -> d.Change:
    return signed(d.written(lambda data: struct.pack("<Q", size) + data[8:]))


ANOTHER = {"colour": d.of("red")}
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
VECTOR = d.of("x", [NAN] * 4, [0.0], [])
SETTINGS: dict[str, dict[str, d.Wrong]] = {
    "reacher": {
        "ensemble_size": d.LARGE_COUNT,
        "encoder_std": d.POSITIVE,
        "state_mean": VECTOR,
        "state_std": VECTOR | {"zero": [0.0] * 4, "negative": [-1.0] * 4},
        "num_cells": d.of("x", [8, 8], [], [10**9, 10**9], [-8]),
        **ANOTHER,
    },
    "car-odometry": {
        **CAR,
        **{name: CAR[name].but("a matrix") for name in ("velocity_std", "velocity_mean")},
        "features": d.COUNT | {"others": 8},
    },
}
#: Changes of weights that have the right names.
CHANGES: dict[str, d.Change] = {
    "a weight more": lambda tensors: {**tensors, "more": torch.ones(2)},
    "no weights": lambda tensors: {},
    "a weight of whole numbers": lambda tensors: {name: value.long() for name, value in tensors.items()},
}
HEADERS = {"no bytes": _header(0), "a terabyte": _header(1 << 40), "2^63 bytes": _header((1 << 63) + 5)}
NAMES = d.of("walker", "../../etc", "/etc", "", "a\0b", 3)
SAVED = {
    "builder": d.of(None),
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
    config = ("format", "builder", "settings", "sha256")
    loose = lambda place: place[0] == "settings"  # noqa: E731
    yield from folder.document(CONFIG, right, skip=lambda place: place[0] not in config, loose=loose, then=signed)
    for setting, values in SETTINGS[name].items():
        wrong = values.each(lambda value, setting=setting: signed(edited(d.put(("settings", setting), value))))
        yield folder.target(f"{name}, {setting}", wrong, words=(CONFIG, setting), file=CONFIG)
    first, last = (sorted(load_file(FOLDERS[name] / WEIGHTS))[at] for at in (0, -1))
    yield from folder.document(WEIGHTS, None, skip=lambda place: place[0] not in (first, last), then=signed)
    yield folder.target(f"{name}, weights", d.Wrong(CHANGES).each(edited).each(signed), file=WEIGHTS)
    half = signed(edited(lambda tensors: {**tensors, first: tensors[first].half()}))
    near = partial(right, near=1e-2)
    yield folder.one(f"{name}, a weight of half precision", half, WEIGHTS, file=WEIGHTS, right=near)
    yield folder.target(f"{name}, a header of", HEADERS, file=WEIGHTS)
    hostile = {what: signed(d.instead(write)) for what, write in PICKLES.items()}
    yield folder.target(f"{name}, weights that are", hostile, file=WEIGHTS, within=4)


def targets() -> Iterator[Target]:
    """Trained filters, and the arguments of what reads and writes them."""
    npz_of_zeros(1 << 30)  # here, not in each case's process
    for name in LOADERS:
        yield from _folders(name)
    also = {"name_or_folder": ("config.json", "trained filter")}
    names = Subject(from_pretrained, wrong={"name_or_folder": NAMES}, also=also)
    yield from targets_of("pretrained", names, said=True)
    yield from targets_of("pretrained", Subject(_saved, wrong=SAVED, name="save_pretrained"))
