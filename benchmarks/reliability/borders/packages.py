"""Packaged steps: files, and what they are called with."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.case import apart, workshop
from benchmarks.reliability.damage import fields, same
from benchmarks.reliability.hostile import PICKLES, npz_of_zeros
from benchmarks.reliability.target import Folder, Subject, Target, targets_of
from tests.filters.factories import linear_kalman
from torch_denkf.deployment import export_step, load_step

STEP = "step.pt2"


@cache
def sound(compiled: bool) -> Path:
    """A folder with a packaged step."""
    folder = workshop() / ("compiled" if compiled else "graph")
    frame = TensorDict({"observation": torch.ones(2), "observed": torch.ones(1, dtype=torch.bool)})
    apart(lambda: export_step(linear_kalman(), frame, folder / STEP, compiled=compiled))
    return folder


def entries() -> dict[str, Any]:
    """Returns what a step takes."""
    return {
        "observation": torch.tensor([1.0, 2.0]),
        "observed": torch.ones(1, dtype=torch.bool),
        "belief.mean": torch.zeros(2),
        "belief.cov": torch.eye(2),
    }


def _called(folder: Path) -> Any:
    return load_step(folder / STEP)(entries())


def _right(result: Any) -> bool:
    """Right where the step returns what the filter's own does."""
    row = TensorDict({tuple(name.split(".")): value for name, value in entries().items()})
    out = linear_kalman().step(row)
    expected = {name: out[tuple(name.split("."))] for name in ("belief.mean", "belief.cov", "belief.var")}
    return same({name: result[name] for name in expected}, expected, atol=1e-5)


ENTRY = d.Wrong(
    {
        "too wide": lambda value: value.repeat(*[2] * value.ndim),
        "a batch": lambda value: value[None],
        "float64": torch.Tensor.double,
        "int64": torch.Tensor.long,
        "a list": torch.Tensor.tolist,
        "nothing": None,
    }
)


def _called_with(change: d.Change, folder: Path) -> Any:
    given = entries()
    change(given)
    return load_step(sound(False) / STEP)(given)


def described(change: Any) -> d.Change:
    """Changes the description in a package."""

    def act(file: Path) -> None:
        with zipfile.ZipFile(file) as archive:
            content = {name: archive.read(name) for name in archive.namelist()}
        with zipfile.ZipFile(file, "w") as out:
            for name, data in content.items():
                out.writestr(name, change(data.decode()).encode() if name.endswith("torch_denkf") else data)

    return act


def _input_less(text: str) -> str:
    text = text.replace('["observed", [1], "torch.bool"]', "")
    return text.replace(", ,", ",").replace("[,", "[").replace(", ]", "]")


DESCRIPTIONS = {
    "empty": lambda text: "",
    "no JSON": lambda text: "x",
    "a list": lambda text: "[]",
    "an empty object": lambda text: "{}",
    "an input less": _input_less,
    "an output less": lambda text: text.replace('"belief.var"', "").replace(", ]", "]"),
    "another shape": lambda text: text.replace('["observation", [2]', '["observation", [3]'),
}
EXPORT = {
    "path": d.of("step.zip", "file/step.pt2", "/dev/full/step.pt2"),
    "out_keys": d.of(["nothing"]),
    "example": d.Wrong({"without a reading": TensorDict({}), "nothing": None}),
    "filter": d.Wrong({"no filter": torch.nn.Linear(2, 2)}),
}
ALSO = {
    "path": ("pt2", "file", "step.pt2", "/dev/full"),
    "out_keys": ("nothing", "write"),
    "example": ("observation",),
}


def _exported(path: str = "step.pt2", **given: Any) -> Any:
    Path("file").touch()
    example = TensorDict({"observation": torch.ones(2)})
    settings = {"filter": linear_kalman(), "example": example, **given}
    return export_step(**settings, path=Path.cwd() / path, compiled=False)


def targets() -> Iterator[Target]:
    """Packages, what they are called with, and the arguments of what writes them."""
    npz_of_zeros(1 << 30)  # here, not in each case's process
    flips = {f"a bit flipped at {5 * at} %": d.flipped(at / 20, 0x40) for at in range(1, 20)}
    for kind, compiled in (("graph", False), ("compiled", True)):
        package = Folder("packages", partial(sound, compiled), _called)
        wrong = (d.SEALED | flips).each(d.written)
        yield package.target(kind, wrong, _right, file=STEP, slow=compiled)
    package = Folder("packages", partial(sound, False), _called)
    yield package.target("in its place", d.PLACES, file=STEP, within=4)
    yield package.target("hostile", {what: d.instead(write) for what, write in PICKLES.items()}, file=STEP, within=4)
    changes = d.Wrong(DESCRIPTIONS).each(described)
    yield package.target("its description", changes, words=(STEP, "observation"), file=STEP)
    needs = partial(sound, False)
    for name in entries():
        yield Target("packages", f"called, {name}", (name,), _called_with, fields({name: ENTRY}), needs=needs)
    nothing = d.Wrong({"nothing at all": dict.clear})
    yield Target("packages", "called", ("observation", "entries"), _called_with, nothing, needs=needs)
    yield from targets_of("packages", Subject(_exported, wrong=EXPORT, also=ALSO, name="export_step"))
