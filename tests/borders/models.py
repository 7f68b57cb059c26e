"""Files of models: checkpoints, and trainings that continue from them; trained filters in folders; packaged steps."""

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
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import MISSING, NAN, put, same, written
from benchmarks.reliability.documents import edited
from benchmarks.reliability.hostile import PICKLES, archive, members_of, npz_of_zeros
from benchmarks.reliability.target import Source, Subject, Target, targets_of
from tests.borders.folders import made
from tests.filters.factories import linear_kalman
from tests.training.problem import make_trainer
from torch_denkf import _registered
from torch_denkf.applications.car.odometry.checkpoint import load_car_filter
from torch_denkf.applications.reacher import reacher
from torch_denkf.deployment import export_step, load_step
from torch_denkf.deployment.folder import described
from torch_denkf.pretrained import from_pretrained, save_pretrained
from torch_denkf.training import FilterTrainer, Stage
from torch_denkf.training.checkpoint import read_checkpoint

HOSTILE = d.Wrong({what: d.instead(write) for what, write in PICKLES.items()})
IN_PLACE = d.PLACES.but(*d.NOTHING.named)

# ------------------------------------------------------------------------------------------------------- checkpoints

LAST = "last.pt"


def _resumed(out: Path) -> Any:
    trainer = make_trainer(out, updates=4, progress=False)
    trainer.fit()
    return dict(trainer.model.state_dict())


def _read(out: Path) -> Any:
    return read_checkpoint(out / LAST)["model"]


#: A training at its end, and one that was left after its first stage.
DONE = made("done", lambda out: make_trainer(out, updates=4, progress=False).fit())
BEGUN = made("begun", lambda out: make_trainer(out, updates=4, stages=("sensor",), progress=False).fit())
READ = Source("checkpoints", DONE, _read, "read, ")
RESUMED = {
    name: Source("checkpoints", sound, _resumed, "resume, ") for name, sound in (("done", DONE), ("begun", BEGUN))
}


def in_first(change: Any) -> d.Change:
    """Changes the first matrix of the weights."""

    def act(content: dict[str, Any]) -> None:
        weights = content["model"]
        first = next(name for name, value in weights.items() if value.is_floating_point() and value.ndim > 1)
        put(first, change)(weights)

    return act


FIELDS = ("stage", "update", "results", "logs", "hooks", "model", "settings", "best", "updates")
CONTENT = {
    **{f"{field} missing": put(field, MISSING) for field in FIELDS},
    **{f"{field} x": put(field, "x") for field in FIELDS[:-1]},
    **{f"{field} {value}": put(field, value) for field in FIELDS[:2] for value in (-3, 10**6)},
    **{f"{field} empty": put(field, {}) for field in FIELDS[5:8]},
    "another seed": put(("settings", "seed"), 99),
    "a weight of NaN": in_first(lambda value: value * NAN),
    "a weight of another shape": in_first(lambda value: value[..., :1].contiguous()),
    "a weight less": in_first(MISSING),
}
#: What the end does not depend on.
HARMLESS = {
    "without last_metrics": put("last_metrics", MISSING),
    "a weight of another precision": in_first(torch.Tensor.double),
}


def _of_checkpoints() -> Iterator[Target]:
    right, begun, done = READ.like(), RESUMED["begun"], RESUMED["done"]
    for source, finished, within in ((READ, READ, 2), (begun, done, 4)):
        yield source.target("bytes", d.SEALED, right, file=LAST)
        yield finished.target("hostile", HOSTILE, file=LAST, within=within)
        yield finished.target("in its place", IN_PLACE, file=LAST, within=within)
    yield READ.target("nothing there", d.NOTHING, file=LAST)
    yield done.target("best files there", d.NOTHING, right, (LAST, "best_sensor.pt"), LAST)
    for name, source in RESUMED.items():
        yield source.target(name, d.Wrong(CONTENT).each(edited), file=LAST)
        yield source.target(f"{name}, harmless", d.Wrong(HARMLESS).each(edited), right, file=LAST)
    yield begun.target("a best stage outside", edited(put(("best", "stage"), "../../outside")), file=LAST)


# -------------------------------------------------------------------------------------------------------- pretrained

CONFIG, WEIGHTS = "config.json", "weights.safetensors"
FOLDERS = _registered.weights()
LOADERS: dict[str, Callable[[Path], Any]] = {"reacher": from_pretrained, "car-odometry": load_car_filter}


def signed(change: d.Change) -> d.Change:
    """Changes the description or the weights, and the checksums, as somebody with bad intentions would."""

    def act(file: Path) -> None:
        change(file)
        config = file.with_name(CONFIG)
        if file.name == WEIGHTS and file.is_file():
            edited(put("sha256", hashlib.sha256(file.read_bytes()).hexdigest()))(config)
        content = json.loads(config.read_text())
        if isinstance(content, dict):
            config.write_text(described(content))

    return act


#: Settings of a car's filter.
CAR = {
    "ensemble_size": d.LARGE_COUNT,
    "velocity_std": d.vector(2, positive=True),
    "velocity_mean": d.vector(2),
    **dict.fromkeys(("lags", "longest", "features"), d.COUNT),
    **dict.fromkeys(("dt", "reach", "focal", "inflation"), d.POSITIVE),
    "size": d.SIZE,
    "colour": d.of("red"),
}
VECTOR = d.of("x", [NAN] * 4, [0.0], [])
SETTINGS: dict[str, dict[str, d.Wrong]] = {
    "reacher": {
        "ensemble_size": d.LARGE_COUNT,
        "encoder_std": d.POSITIVE,
        "state_mean": VECTOR,
        "state_std": VECTOR | d.of([0.0] * 4, [-1.0] * 4),
        "num_cells": d.of("x", [8, 8], [], [10**9, 10**9], [-8]),
        "colour": d.of("red"),
    },
    "car-odometry": {
        **CAR,
        **{name: CAR[name].but("a matrix", "complex") for name in ("velocity_std", "velocity_mean")},
        "features": d.COUNT | {"others": 8},
    },
}
#: Changes of weights that have the right names.
CHANGES: dict[str, d.Change] = {
    "a weight more": lambda tensors: {**tensors, "more": torch.ones(2)},
    "no weights": lambda tensors: {},
    "a weight of whole numbers": lambda tensors: {name: value.long() for name, value in tensors.items()},
}
#: Changes of a description by hand.
EDITED: dict[str, d.Change] = {
    "another setting": put(("settings", "ensemble_size"), 3),
    "another seed": put(("training", "seed"), 1),
    "another version": put(("versions", "torch"), "1.0"),
    "one entry more": put("note", "better"),
    **{f"without {name}": put(name, MISSING) for name in ("versions", "checksum")},
    "a checksum of numbers": put("checksum", 3),
}
HEADERS = d.of(0, 1 << 40, (1 << 63) + 5).each(
    lambda size: signed(written(lambda data: struct.pack("<Q", size) + data[8:]))
)


def _of_pretrained(name: str) -> Iterator[Target]:
    folder = Source(
        "pretrained", lambda: FOLDERS[name], lambda root: dict(LOADERS[name](root).state_dict()), f"{name}, "
    )
    right, weights = folder.like(), load_file(FOLDERS[name] / WEIGHTS)
    ends = min(weights), max(weights)
    for file, wrong in ((CONFIG, d.BYTES), (WEIGHTS, d.SEALED)):
        yield folder.target(file, wrong, right, file=file)
        yield folder.target(f"{file} in its place", d.PLACES, file=file, within=4)
    known, loose = ("format", "builder", "settings", "sha256"), lambda place: place[0] == "settings"
    yield from folder.document(CONFIG, right, skip=lambda place: place[0] not in known, loose=loose, then=signed)
    yield folder.target("description", d.Wrong(EDITED).each(edited), None, "checksum", CONFIG)
    for setting, values in SETTINGS[name].items():
        wrong = values.each(lambda value, setting=setting: signed(edited(put(("settings", setting), value))))
        yield folder.target(setting, wrong, None, (CONFIG, setting), CONFIG)
    yield from folder.document(WEIGHTS, skip=lambda place: place[0] not in ends, then=signed)
    yield folder.target("weights", d.Wrong(CHANGES).each(edited).each(signed), file=WEIGHTS)
    half = signed(edited(put(ends[0], torch.Tensor.half)))
    yield folder.target("a weight of half precision", half, folder.like(near=1e-2), file=WEIGHTS)
    yield folder.target("a header of", HEADERS, file=WEIGHTS)
    yield folder.target("weights that are", HOSTILE.each(signed), file=WEIGHTS, within=4)


# ---------------------------------------------------------------------------------------------------------- packages

STEP = "step.pt2"
#: What a step takes.
ENTRIES = {
    "observation": torch.tensor([1.0, 2.0]),
    "observed": torch.ones(1, dtype=torch.bool),
    "belief.mean": torch.zeros(2),
    "belief.cov": torch.eye(2),
}


def _package(compiled: bool) -> Callable[[Path], Any]:
    frame = TensorDict({name: ENTRIES[name] for name in ("observation", "observed")})
    return lambda folder: export_step(linear_kalman(), frame, folder / STEP, compiled=compiled)


def _called(folder: Path, entries: dict[str, Any] | None = None) -> Any:
    return load_step(folder / STEP)(dict(ENTRIES) if entries is None else entries)


def _as_by_hand(result: Any) -> bool:
    """Tells whether the step returns what the filter's own does."""
    out = linear_kalman().step(TensorDict({tuple(name.split(".")): value for name, value in ENTRIES.items()}))
    expected = {f"belief.{name}": out["belief", name] for name in ("mean", "cov", "var")}
    return same({name: result[name] for name in expected}, expected, atol=1e-5)


ENTRY = {
    "too wide": lambda value: value.repeat(*[2] * value.ndim),
    "a batch": lambda value: value[None],
    "float64": torch.Tensor.double,
    "int64": torch.Tensor.long,
    "a list": torch.Tensor.tolist,
    "nothing": None,
    "missing": MISSING,
}


def redescribed(change: Callable[[str], str]) -> d.Change:
    """Changes the description in a package."""

    def act(file: Path) -> None:
        members = members_of(file)
        texts = {name: change(data.decode()) for name, data in members.items() if name.endswith("torch_denkf")}
        archive(members | texts)(file)

    return act


def _less(part: str) -> Callable[[str], str]:
    """Takes an entry out of a list of the description."""
    return lambda text: text.replace(f"{part}, ", "").replace(f", {part}", "")


DESCRIPTIONS = d.of("", "x", "{", "[]", "{}", '{"inputs": [], "outputs": []}', '{"inputs": 3}').each(
    lambda whole: lambda text: whole
) | {
    "an input less": _less('["observed", [1], "torch.bool"]'),
    "an output less": _less('"belief.var"'),
    "another shape": lambda text: text.replace('["observation", [2]', '["observation", [3]'),
}


ARCHIVES = {
    "an empty archive": archive({}),
    "a name of a compiled one": archive({"data/aotinductor/model": "nothing"}),
    "an archive's version alone": archive({"archive/version": "0", "archive/models/model": "x"}),
}


def _of_packages() -> Iterator[Target]:
    graph, compiled = (made(name, _package(name == "compiled")) for name in ("graph", "compiled"))
    bits = d.Wrong({f"a bit flipped at {5 * at} %": written(d.flipped(at / 20, 0x40)) for at in range(1, 20)})
    for sound in (graph, compiled):
        source = Source("packages", sound, _called)
        kind = "compiled" if sound is compiled else "graph"
        yield source.target(kind, d.SEALED | bits, _as_by_hand, file=STEP, slow=sound is compiled)
    source = Source("packages", graph, _called)
    yield source.target("in its place", d.PLACES, file=STEP, within=4)
    yield source.target("hostile", HOSTILE | ARCHIVES, file=STEP, within=4)
    changes = DESCRIPTIONS.each(redescribed)
    yield source.target("its description", changes, None, (STEP, "observation"), STEP)
    called = Source("packages", lambda: dict(ENTRIES), lambda entries: _called(graph(), entries), "called, ")
    for name in ENTRIES:
        yield called.target(name, d.Wrong(ENTRY).each(partial(put, name)), None, name, needs=graph)
    yield called.target("without entries", dict.clear, None, ("observation", "entries"), needs=graph)


# -------------------------------------------------------------------------------------------------------- arguments


def _trained(out: Any = "out", **settings: Any) -> Any:
    Path("file").touch()
    return make_trainer(Path(out), **{"updates": 1, "progress": False, **settings}).fit()


def _staged(**given: Any) -> Any:
    net = torch.nn.Linear(1, 1)

    def sample(generator: torch.Generator, length: int | None) -> TensorDict:
        return TensorDict({"x": torch.rand(8, 1, generator=generator)}, [8])

    loss = lambda batch: {"loss_fit": net(batch["x"]).square().mean()}  # noqa: E731
    stage = Stage(**{"name": "fit", "loss": loss, "sample": sample, "updates": 2, **given})
    return FilterTrainer(net, [stage], out=Path("out"), device="cpu", progress=False).fit()


def _training() -> Iterator[Subject]:
    settings = {
        **dict.fromkeys(("updates", "validate_every", "save_every", "log_every"), d.of("x", -3, 1.5, 0)),
        "max_skipped": d.of("x", -3),
        "seed": d.of("x", -3, 1.5),
        "keep": d.of("worst", 3),
        "monitor": d.of("beauty"),
        "loggers": d.of(("paper",)),
        "device": d.of("abacus", "cuda:77"),
        "out": d.of("file"),
    }
    stage = {
        "name": d.of("../x", "", 3),
        "updates": d.COUNT,
        "lr": d.POSITIVE,
        "weight_decay": d.NOT_NEGATIVE.but("inf"),
        "schedule": d.of("weekly", 3),
        "clip": d.POSITIVE.but("inf"),
        "lengths": d.of({5: 4}, {0: -4}, "x"),
    }
    yield Subject(_trained, wrong=settings, also={"loggers": ("logger",), "out": ("file",)}, name="FilterTrainer")
    yield Subject(_staged, wrong=stage, also={"name": ("stage's name",)}, name="Stage")


def _saved(**given: Any) -> Any:
    given = {"builder": reacher, "settings": {}, **given}
    given = {name: value for name, value in given.items() if value is not None}
    return save_pretrained(torch.nn.Linear(2, 2), "folder", **given)


def _pretrained() -> Iterator[Subject]:
    objects = {"a": object()}
    saved = {"builder": d.of(None), "settings": d.of(objects, {"a": NAN}, "x"), "training": d.of(objects)}
    yield Subject(_saved, wrong=saved, name="save_pretrained")


def _exported(path: str = "step.pt2", **given: Any) -> Any:
    Path("file").touch()
    settings = {"filter": linear_kalman(), "example": TensorDict({"observation": torch.ones(2)}), **given}
    return export_step(**settings, path=Path.cwd() / path, compiled=False)


def _packages() -> Iterator[Subject]:
    wrong = {
        "path": d.of("step.zip", "file/step.pt2", "/dev/full/step.pt2"),
        "out_keys": d.of(["nothing"]),
        "example": d.Wrong({"without a reading": TensorDict({}), "nothing": None}),
        "filter": d.of(torch.nn.Linear(2, 2)),
    }
    words = {"path": ("pt2", "file", "/dev/full"), "out_keys": ("nothing", "write"), "example": ("observation",)}
    yield Subject(_exported, wrong=wrong, also=words, name="export_step")


def targets() -> Iterator[Target]:
    """Yields all files and arguments."""
    npz_of_zeros(1 << 30)  # here, not in each case's process
    yield from _of_checkpoints()
    for name in LOADERS:
        yield from _of_pretrained(name)
    yield from _of_packages()
    for border, subjects in {"training": _training, "pretrained": _pretrained, "packages": _packages}.items():
        yield from targets_of(border, *subjects())
    names = d.of("walker", "../../etc", "/etc", "", "a\0b", 3)
    also = {"name_or_folder": ("config.json", "car-odometry, imu, quadruped, reacher, ur5-table")}
    yield from targets_of("pretrained", Subject(from_pretrained, wrong={"name_or_folder": names}, also=also), said=True)
