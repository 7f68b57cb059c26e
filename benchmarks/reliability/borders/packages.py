"""Packaged steps: files, and what they are called with."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from benchmarks.reliability.borders.checkpoints import HOSTILE
from benchmarks.reliability.case import Case, apart, workshop
from benchmarks.reliability.damage import BYTES, gone, same, written
from benchmarks.reliability.hostile import npz_of_zeros, ran
from tests.filters.factories import linear_kalman
from torch_denkf.deployment import export_step, load_step

STEP = "step.pt2"


@cache
def sound(compiled: bool) -> Path:
    """A packaged step."""
    file = workshop() / ("compiled" if compiled else "graph") / STEP
    frame = TensorDict({"observation": torch.ones(2), "observed": torch.ones(1, dtype=torch.bool)})
    apart(lambda: export_step(linear_kalman(), frame, file, compiled=compiled))
    return file


def entries() -> dict[str, torch.Tensor]:
    """What a step takes."""
    return {
        "observation": torch.tensor([1.0, 2.0]),
        "observed": torch.ones(1, dtype=torch.bool),
        "belief.mean": torch.zeros(2),
        "belief.cov": torch.eye(2),
    }


def reference() -> dict[str, torch.Tensor]:
    """What a step returns."""
    row = TensorDict({tuple(name.split(".")): value for name, value in entries().items()})
    out = linear_kalman().step(row)
    return {name: out[tuple(name.split("."))] for name in ("belief.mean", "belief.cov", "belief.var")}


def _load(compiled: bool, change: Callable[[Path], Any], folder: Path) -> Any:
    file = folder / STEP
    file.write_bytes(sound(compiled).read_bytes())
    change(file)
    return load_step(file)(entries()), ran(folder)


def _right(result: Any) -> bool:
    written, code_ran = result
    return not code_ran and same({name: written[name] for name in reference()}, reference(), atol=1e-5)


def _call(change: Callable[[dict[str, Any]], Any], folder: Path) -> Any:
    given: dict[str, Any] = entries()
    changed = change(given)
    return load_step(sound(False))(given if changed is None else changed), False


CALLS: dict[str, tuple[tuple[str, ...], Callable[[dict[str, Any]], Any]]] = {}
for _name in ("observation", "observed", "belief.mean", "belief.cov"):
    CALLS |= {
        f"without {_name}": ((_name,), lambda given, name=_name: given.pop(name) is None or None),
        f"{_name} too wide": (
            (_name,),
            lambda given, name=_name: given.update({name: given[name].repeat(*[2] * given[name].ndim)}),
        ),
        f"{_name} a batch": ((_name,), lambda given, name=_name: given.update({name: given[name][None]})),
        f"{_name} float64": ((_name,), lambda given, name=_name: given.update({name: given[name].double()})),
        f"{_name} int64": ((_name,), lambda given, name=_name: given.update({name: given[name].long()})),
        f"{_name} a list": ((_name,), lambda given, name=_name: given.update({name: given[name].tolist()})),
        f"{_name} nothing": ((_name,), lambda given, name=_name: given.update({name: None})),
    }
CALLS["nothing at all"] = (("observation", "entries"), lambda given: {})


def _signature(change: Callable[[str], str]) -> Callable[[Path], Any]:
    """Changes the description in a package."""

    def act(file: Path) -> None:
        with zipfile.ZipFile(file) as archive:
            content = {name: archive.read(name) for name in archive.namelist()}
        with zipfile.ZipFile(file, "w") as out:
            for name, data in content.items():
                if name.endswith("torch_denkf"):
                    data = change(data.decode()).encode()
                out.writestr(name, data)

    return act


SIGNATURES: dict[str, Callable[[str], str]] = {
    "empty": lambda text: "",
    "no JSON": lambda text: "x",
    "a list": lambda text: "[]",
    "an empty object": lambda text: "{}",
    "an input less": lambda text: (
        text.replace('["observed", [1], "torch.bool"]', "").replace(", ,", ",").replace("[,", "[").replace(", ]", "]")
    ),
    "an output less": lambda text: text.replace('"belief.var"', "").replace(", ]", "]"),
    "another shape": lambda text: text.replace('["observation", [2]', '["observation", [3]'),
}
EXPORT: dict[str, tuple[tuple[str, ...], dict[str, Any]]] = {
    "another suffix": (("pt2",), {"path": "step.zip"}),
    "in a file": (("file", "step.pt2"), {"path": "file/step.pt2"}),
    "an output that is not written": (("out_keys", "nothing", "write"), {"out_keys": ["nothing"]}),
    "an example without a reading": (("observation",), {"example": TensorDict({})}),
    "an example of nothing": (("example",), {"example": None}),
    "no filter": (("filter",), {"filter": torch.nn.Linear(2, 2)}),
}


def _export(given: dict[str, Any], folder: Path) -> Any:
    (folder / "file").write_text("")
    settings = {
        "filter": linear_kalman(),
        "example": TensorDict({"observation": torch.ones(2)}),
        "path": "step.pt2",
        **given,
    }
    settings["path"] = folder / settings["path"]
    return export_step(**settings, compiled=False)


def _too_large(folder: Path) -> Any:
    """Writing to a disk that is full."""
    return export_step(
        linear_kalman(), TensorDict({"observation": torch.ones(2)}), "/dev/full/step.pt2", compiled=False
    )


def cases() -> Iterator[Case]:
    """All damaged packages."""
    npz_of_zeros(1 << 30)  # here, not in each case's process
    border = "packages"
    for compiled in (False, True):
        kind, needs = "compiled" if compiled else "graph", partial(sound, compiled)
        for what, change in BYTES.items():
            act = partial(_load, compiled, lambda file, change=change: written(file, change))
            yield Case(border, f"{kind}: {what}", (STEP,), act, _right, needs=needs, slow=compiled)
        for at in range(1, 20):
            flip = lambda data, at=at: data[: (k := at * len(data) // 20)] + bytes([data[k] ^ 0x40]) + data[k + 1 :]  # noqa: E731
            act = partial(_load, compiled, lambda file, flip=flip: written(file, flip))
            yield Case(border, f"{kind}: a bit flipped at {5 * at} %", (STEP,), act, _right, needs=needs, slow=compiled)
    needs = partial(sound, False)
    for what, change in HOSTILE.items():
        yield Case(border, f"a package that is {what}", (STEP,), partial(_load, False, change), within=4, needs=needs)
    for what, text in SIGNATURES.items():
        yield Case(
            border,
            f"its description: {what}",
            (STEP, "observation"),
            partial(_load, False, _signature(text)),
            needs=needs,
        )
    yield Case(border, "taken away", (STEP,), partial(_load, False, gone), needs=needs)
    for what, (words, call) in CALLS.items():
        yield Case(border, f"called with {what}", words, partial(_call, call), needs=needs)
    for what, (words, given) in EXPORT.items():
        yield Case(border, f"export: {what}", words, partial(_export, given))
    yield Case(border, "export: to a device", ("step.pt2", "/dev/full"), _too_large)
