"""Checkpoints, and trainings that go on from them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.case import apart, workshop
from benchmarks.reliability.damage import same
from benchmarks.reliability.documents import edited
from benchmarks.reliability.hostile import PICKLES, npz_of_zeros
from benchmarks.reliability.target import Folder, Subject, Target, targets_of
from tests.training.problem import make_trainer
from torch_denkf.training import FilterTrainer, Stage
from torch_denkf.training.checkpoint import read_checkpoint

UPDATES = 4
LAST = "last.pt"
NAN = float("nan")


@cache
def sound() -> Path:
    """Two trainings, one at its end, one that was left after its first stage."""
    root = workshop() / "training"

    def train() -> None:
        make_trainer(root / "done", updates=UPDATES, progress=False).fit()
        make_trainer(root / "begun", updates=UPDATES, stages=("sensor",), progress=False).fit()

    apart(train)
    return root


def _right(weights: Any) -> bool:
    """Right where the weights are those at the end."""
    return same(weights, read_checkpoint(sound() / "done" / LAST)["model"])


def _read(out: Path) -> Any:
    return read_checkpoint(out / LAST)["model"]


def _resume(out: Path) -> Any:
    trainer = make_trainer(out, updates=UPDATES, progress=False)
    trainer.fit()
    return dict(trainer.model.state_dict())


def _run(name: str) -> Path:
    return sound() / name


READ = Folder("checkpoints", partial(_run, "done"), _read)
RESUMED = {name: Folder("checkpoints", partial(_run, name), _resume) for name in ("begun", "done")}


def _first(content: dict[str, Any]) -> str:
    """Returns the name of the first matrix of the weights."""
    return next(name for name, value in content["model"].items() if value.is_floating_point() and value.ndim > 1)


def in_first(change: Any) -> d.Change:
    """Changes the first matrix of the weights."""
    return lambda content: d.put(("model", _first(content)), change)(content)


TEXT = d.of("x")
PLACE = d.of("x", -3, 10**6)
FIELDS = {
    "stage": PLACE,
    "update": PLACE,
    **dict.fromkeys(("results", "logs", "hooks"), TEXT),
    **dict.fromkeys(("model", "settings", "best"), TEXT | {"empty": {}}),
    "updates": d.Wrong({}),
}
CONTENT = d.fields(FIELDS) | {
    "another seed": d.put(("settings", "seed"), 99),
    "a weight of NaN": in_first(lambda value: value * NAN),
    "a weight of another shape": in_first(lambda value: value[..., :1].contiguous()),
    "a weight less": in_first(d.MISSING),
}
#: What the end does not depend on.
HARMLESS = {
    "without last_metrics": d.put(("last_metrics",), d.MISSING),
    "a weight of another precision": in_first(torch.Tensor.double),
}


def _checkpoints() -> Iterator[Target]:
    files = d.SEALED.each(d.written)
    hostile = {what: d.instead(write) for what, write in PICKLES.items()}
    for folder, name in ((READ, "read"), (RESUMED["begun"], "resume")):
        yield folder.target(f"{name}, bytes", files, _right, file=LAST)
    nothing = d.Wrong({what: d.PLACES.named[what] for what in ("taken away", "a link to nowhere", "a link to itself")})
    places = d.PLACES.but(*nothing.named)
    for folder, name, within in ((READ, "read", 2), (RESUMED["done"], "resume", 4)):
        yield folder.target(f"{name}, hostile", hostile, file=LAST, within=within)
        yield folder.target(f"{name}, in its place", places, file=LAST, within=within)
    yield READ.target("read, nothing there", nothing, file=LAST)
    best = (LAST, "best_sensor.pt")
    yield RESUMED["done"].target("resume, best files there", nothing, _right, best, LAST)
    for name, folder in RESUMED.items():
        yield folder.target(f"resume, {name}", CONTENT.each(edited), file=LAST)
        yield folder.target(f"resume, {name}, harmless", d.Wrong(HARMLESS).each(edited), _right, file=LAST)
    outside = edited(d.put(("best", "stage"), "../../outside"))
    yield RESUMED["begun"].one("resume, a best stage outside", outside, LAST, file=LAST)


SETTINGS = {
    **dict.fromkeys(("updates", "validate_every", "save_every", "log_every"), d.of("x", -3, 1.5, 0)),
    "max_skipped": d.of("x", -3),
    "seed": d.of("x", -3, 1.5),
    "keep": d.of("worst", 3),
    "monitor": d.of("beauty"),
    "loggers": d.of(("paper",)),
    "device": d.of("abacus", "cuda:77"),
    "out": d.of("file"),
}
STAGE = {
    "name": d.of("../x", "", 3),
    "lr": d.POSITIVE,
    "weight_decay": d.NOT_NEGATIVE.but("inf"),
    "schedule": d.of("weekly", 3),
    "clip": d.POSITIVE.but("inf"),
    "lengths": d.of({5: 4}, {0: -4}, "x"),
}


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


def targets() -> Iterator[Target]:
    """Checkpoints, and the arguments of what writes them."""
    npz_of_zeros(1 << 30)  # here, not in each case's process
    yield from _checkpoints()
    also = {"loggers": ("logger",), "name": ("stage's name",), "out": ("file",)}
    yield from targets_of(
        "training",
        Subject(_trained, wrong=SETTINGS, also=also, name="FilterTrainer"),
        Subject(_staged, wrong=STAGE, also=also, name="Stage"),
    )
