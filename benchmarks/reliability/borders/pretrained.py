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

import torch_denkf.pretrained
from benchmarks.reliability.borders.checkpoints import HOSTILE
from benchmarks.reliability.case import Case
from benchmarks.reliability.damage import BYTES, copied, gone, same, written
from benchmarks.reliability.hostile import npz_of_zeros, ran
from torch_denkf.odometry import load_car_filter
from torch_denkf.pretrained import from_pretrained, reacher, save_pretrained

CONFIG, WEIGHTS = "config.json", "weights.safetensors"
FOLDERS = Path(torch_denkf.pretrained.__file__).parent / "weights"
LOADERS: dict[str, Callable[[Path], Any]] = {"reacher": from_pretrained, "car-odometry": load_car_filter}
NAN = float("nan")
Change = Callable[[Path], Any]


def _load(name: str, change: Change, folder: Path) -> Any:
    copy = copied(FOLDERS / name, folder)
    change(copy)
    return name, dict(LOADERS[name](copy).state_dict()), ran(folder)


def _right(result: Any, tolerance: float = 0.0) -> bool:
    name, weights, code_ran = result
    sound = dict(LOADERS[name](FOLDERS / name).state_dict())
    return not code_ran and same(weights, sound, rtol=tolerance, atol=tolerance)


def config(change: Callable[[dict], Any]) -> Change:
    """Changes the description."""

    def act(folder: Path) -> None:
        content = json.loads((folder / CONFIG).read_text())
        changed = change(content)
        (folder / CONFIG).write_text(json.dumps(content if changed is None else changed))

    return act


def _signed(folder: Path) -> None:
    """Adapts the checksum, as somebody with bad intentions would."""
    digest = hashlib.sha256((folder / WEIGHTS).read_bytes()).hexdigest()
    config(lambda content: content.update(sha256=digest))(folder)


def weights(change: Callable[[dict[str, torch.Tensor]], Any]) -> Change:
    """Changes the weights, and the checksum."""

    def act(folder: Path) -> None:
        tensors = load_file(folder / WEIGHTS)
        change(tensors)
        save_file(tensors, folder / WEIGHTS)
        _signed(folder)

    return act


def _first(change: Callable[[torch.Tensor], torch.Tensor | None]) -> Change:
    def act(tensors: dict[str, torch.Tensor]) -> None:
        name = next(name for name, value in tensors.items() if value.is_floating_point() and value.ndim > 1)
        changed = change(tensors[name])
        if changed is None:
            del tensors[name]
        else:
            tensors[name] = changed.contiguous()

    return weights(act)


def _header(size: int) -> Change:
    def act(folder: Path) -> None:
        data = (folder / WEIGHTS).read_bytes()
        (folder / WEIGHTS).write_bytes(struct.pack("<Q", size) + data[8:])
        _signed(folder)

    return act


FIELDS: dict[str, dict[str, Any]] = {
    "format": {"another": "x/9", "a number": 3, "nothing": None, "a list": []},
    "builder": {"unknown": "os.system", "a number": 3, "nothing": None, "a path": "../x", "a list": ["reacher"]},
    "settings": {"a list": [], "nothing": None, "text": "x"},
    "sha256": {"another": "0" * 64, "empty": "", "a number": 3, "nothing": None},
}
SETTINGS: dict[str, dict[str, dict[str, Any]]] = {
    "reacher": {
        "ensemble_size": {"zero": 0, "negative": -3, "text": "x", "nothing": None, "a fraction": 1.5},
        "encoder_std": {"zero": 0.0, "negative": -1.0, "nan": NAN, "text": "x", "nothing": None},
        "state_mean": {"too short": [0.0], "nan": [NAN] * 4, "text": "x", "nothing": None, "empty": []},
        "state_std": {"too short": [1.0], "nan": [NAN] * 4, "zero": [0.0] * 4, "negative": [-1.0] * 4, "text": "x"},
        "num_cells": {"others": [8, 8], "negative": [-8], "empty": [], "text": "x", "huge": [10**9, 10**9]},
        "colour": {"no such setting": "red"},
    },
    "car-odometry": {
        "ensemble_size": {"zero": 0, "negative": -3, "text": "x", "nothing": None},
        "dt": {"zero": 0.0, "negative": -1.0, "nan": NAN, "text": "x", "nothing": None},
        "velocity_std": {
            "negative": [-1.0, 1.0],
            "zero": [0.0, 0.0],
            "nan": [NAN, NAN],
            "text": "x",
            "too long": [1.0] * 3,
        },
        "velocity_mean": {"nan": [NAN, 0.0], "too long": [1.0] * 3, "text": "x"},
        "lags": {"zero": 0, "negative": -3, "text": "x", "a fraction": 1.5},
        "longest": {"zero": 0, "negative": -3, "text": "x", "a fraction": 1.5},
        "reach": {"negative": -1.0, "nan": NAN, "text": "x"},
        "features": {"zero": 0, "negative": -3, "others": 8},
        "size": {"zero": [0, 300], "negative": [-100, 300], "one number": [100], "text": "x"},
        "focal": {"zero": 0.0, "negative": -1.0, "nan": NAN, "text": "x"},
        "inflation": {"zero": 0.0, "negative": -1.0, "nan": NAN, "text": "x"},
    },
}
DAMAGE: dict[str, Change] = {
    "a weight of NaN": _first(lambda value: value * NAN),
    "a weight of infinity": _first(lambda value: value + float("inf")),
    "a weight of another shape": _first(lambda value: value[..., :1]),
    "a weight of half precision": _first(lambda value: value.half()),
    "a weight of whole numbers": _first(lambda value: value.long()),
    "a weight less": _first(lambda value: None),
    "a weight more": weights(lambda tensors: tensors.update(more=torch.ones(2))),
    "no weights": weights(dict.clear),
    "a header of no bytes": _header(0),
    "a header of a terabyte": _header(1 << 40),
    "a header of 2^63 bytes": _header((1 << 63) + 5),
}


def cases() -> Iterator[Case]:
    """All damaged folders."""
    npz_of_zeros(1 << 30)  # here, not in each case's process
    border = "pretrained"
    for name in LOADERS:
        for file in (CONFIG, WEIGHTS):
            for what, change in BYTES.items():
                act = partial(_load, name, lambda folder, file=file, change=change: written(folder / file, change))
                yield Case(border, f"{name}, {file}: {what}", (file,), act, _right)
            yield Case(
                border,
                f"{name}, {file} taken away",
                (file,),
                partial(_load, name, lambda folder, file=file: gone(folder / file)),
            )
            yield Case(
                border,
                f"{name}, {file} a folder",
                (file,),
                partial(_load, name, lambda folder, file=file: (gone(folder / file), (folder / file).mkdir())),
            )
            link = lambda folder, file=file: (gone(folder / file), (folder / file).symlink_to("/dev/zero"))  # noqa: E731
            yield Case(border, f"{name}, {file} a link to a device", (file,), partial(_load, name, link), within=4)
        for field, values in FIELDS.items():
            for what, value in values.items():
                act = partial(
                    _load, name, config(lambda content, field=field, value=value: content.update({field: value}))
                )
                yield Case(border, f"{name}, {field}: {what}", (CONFIG,), act)
            act = partial(_load, name, config(lambda content, field=field: content.pop(field) is None or None))
            yield Case(border, f"{name} without {field}", (CONFIG,), act)
        for setting, values in SETTINGS[name].items():
            for what, value in values.items():
                edit = lambda content, setting=setting, value=value: content["settings"].update({setting: value})  # noqa: E731
                yield Case(border, f"{name}, {setting}: {what}", (CONFIG, setting), partial(_load, name, config(edit)))
        for what, change in DAMAGE.items():
            right = partial(_right, tolerance=1e-2) if "half" in what else None
            yield Case(border, f"{name}: {what}", (WEIGHTS,), partial(_load, name, change), right)
        for what, change in HOSTILE.items():

            def plant(folder: Path, change: Change = change) -> None:
                change(folder / WEIGHTS)
                if (folder / WEIGHTS).is_file():
                    _signed(folder)

            if what != "a device":
                yield Case(
                    border, f"{name}, weights that are {what}", (WEIGHTS,), partial(_load, name, plant), within=4
                )
    for what, value in {
        "unknown": "walker",
        "outside": "../../etc",
        "absolute": "/etc",
        "empty": "",
        "a zero byte": "a\0b",
        "a number": 3,
    }.items():
        words = (str(value), "config.json", "name_or_folder", "trained filter")
        yield Case(border, f"from_pretrained({what})", words, lambda folder, value=value: from_pretrained(value))
    model = torch.nn.Linear(2, 2)
    own = {"builder": reacher, "settings": {}}
    saves: dict[str, tuple[str, dict[str, Any]]] = {
        "no builder": ("builder", {}),
        "settings that JSON does not know": ("settings", {"builder": reacher, "settings": {"a": object()}}),
        "settings with NaN": ("settings", {"builder": reacher, "settings": {"a": NAN}}),
        "settings of text": ("settings", {"builder": reacher, "settings": "x"}),
        "training that JSON does not know": (
            "training",
            {**own, "training": {"a": object()}},
        ),
    }
    for what, (word, given) in saves.items():
        yield Case(
            border,
            f"save_pretrained: {what}",
            (word,),
            lambda folder, given=given: save_pretrained(model, folder, **given),
        )
