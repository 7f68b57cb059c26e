"""Checkpoints, and trainings that go on from them."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch

from benchmarks.reliability.case import Case, apart, workshop
from benchmarks.reliability.damage import BYTES, copied, gone, same, written
from benchmarks.reliability.hostile import Bomb, npz_of_zeros, ran
from tests.training.problem import make_trainer
from torch_denkf.training import read_checkpoint, write_checkpoint

UPDATES = 4
LAST = "last.pt"
Change = Callable[[Path], Any]


@cache
def sound() -> Path:
    """Two trainings, one at its end, one that was left after its first stage."""
    root = workshop() / "training"

    def train() -> None:
        make_trainer(root / "done", updates=UPDATES, progress=False).fit()
        make_trainer(root / "begun", updates=UPDATES, stages=("sensor",), progress=False).fit()

    apart(train)
    return root


def reference() -> dict[str, Any]:
    """Weights at the end."""
    return read_checkpoint(sound() / "done" / LAST)["model"]


def _read(change: Change, folder: Path) -> Any:
    file = copied(sound() / "done", folder) / LAST
    change(file)
    content = read_checkpoint(file)
    return content["model"], ran(folder)


def _resume(run: str, change: Change, folder: Path, **settings: Any) -> Any:
    out = copied(sound() / run, folder)
    change(out / LAST)
    trainer = make_trainer(out, **{"updates": UPDATES, "progress": False, **settings})
    trainer.fit()
    return dict(trainer.model.state_dict()), ran(folder)


def _right(result: tuple[Any, bool]) -> bool:
    weights, code_ran = result
    return not code_ran and same(weights, reference())


def _content(change: Callable[[dict], Any]) -> Change:
    """Changes what is in a checkpoint, and writes it as the library does."""

    def act(file: Path) -> None:
        content = read_checkpoint(file)
        change(content)
        write_checkpoint(file, content)

    return act


def _saved(content: Any) -> Change:
    def act(file: Path) -> None:
        torch.save(content, file)

    return act


def _zip(file: Path) -> None:
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("readme.txt", "hello")


def _pickle_in_zip(file: Path) -> None:
    """Torch's layout, with a pickle of somebody else's."""
    buffer = io.BytesIO()
    torch.save({"format": "torch_denkf.training/1"}, buffer)
    with zipfile.ZipFile(buffer) as archive, zipfile.ZipFile(file, "w") as out:
        for name in archive.namelist():
            out.writestr(name, Bomb.pickled() if name.endswith("data.pkl") else archive.read(name))


HOSTILE: dict[str, Change] = {
    "a pickle": lambda file: file.write_bytes(Bomb.pickled()),
    "torch's pickle of code": _saved(Bomb()),
    "torch's pickle of code, nested": _saved({"format": "torch_denkf.training/1", "model": {"a": Bomb()}}),
    "a pickle in torch's archive": _pickle_in_zip,
    "another archive": _zip,
    "an archive that unpacks to a gigabyte": lambda file: file.write_bytes(npz_of_zeros(1 << 30)),
    "a whole module": _saved(torch.nn.Linear(2, 2)),
    "a list": _saved([1, 2]),
    "a dictionary of others": _saved({"weights": torch.ones(2)}),
    "a later format": _saved({"format": "torch_denkf.training/9"}),
    "a folder": lambda file: (gone(file), file.mkdir()),
    "a device": lambda file: (gone(file), file.symlink_to("/dev/zero")),
}


def _set(*path: str, value: Any) -> Callable[[dict], Any]:
    def change(content: dict) -> None:
        for name in path[:-1]:
            content = content[name]
        content[path[-1]] = value

    return change


def _weights(change: Callable[[torch.Tensor], torch.Tensor | None]) -> Callable[[dict], Any]:
    """Changes one weight."""

    def act(content: dict) -> None:
        name = next(name for name, value in content["model"].items() if value.is_floating_point() and value.ndim > 1)
        changed = change(content["model"][name])
        if changed is None:
            del content["model"][name]
        else:
            content["model"][name] = changed

    return act


CONTENT: dict[str, Callable[[dict], Any]] = {
    "stage beyond the last": _set("stage", value=99),
    "stage negative": _set("stage", value=-1),
    "stage text": _set("stage", value="x"),
    "update beyond the last": _set("update", value=10**6),
    "update negative": _set("update", value=-3),
    "update text": _set("update", value="x"),
    "model text": _set("model", value="x"),
    "model empty": _set("model", value={}),
    "results text": _set("results", value="x"),
    "settings text": _set("settings", value="x"),
    "settings empty": _set("settings", value={}),
    "logs text": _set("logs", value="x"),
    "hooks text": _set("hooks", value="x"),
    "best text": _set("best", value="x"),
    "best empty": _set("best", value={}),
    "a best stage outside": _set("best", "stage", value="../../outside"),
    "another seed": _set("settings", "seed", value=99),
    "a weight of NaN": _weights(lambda value: value * torch.nan),
    "a weight of another shape": _weights(lambda value: value[..., :1]),
    "a weight of another precision": _weights(lambda value: value.double()),
    "a weight less": _weights(lambda value: None),
    **{
        f"without {key}": (lambda content, key=key: content.pop(key) is None)
        for key in (
            "stage",
            "update",
            "model",
            "updates",
            "results",
            "settings",
            "best",
            "logs",
            "hooks",
            "last_metrics",
        )
    },
}


def cases() -> Iterator[Case]:
    """All damaged checkpoints."""
    npz_of_zeros(1 << 30)  # here, not in each case's process
    border, words = "checkpoints", (LAST,)
    for what, change in {**BYTES}.items():
        act = lambda file, change=change: written(file, change)  # noqa: E731
        yield Case(border, f"read: {what}", words, partial(_read, act), _right, needs=sound)
        yield Case(border, f"resume: {what}", words, partial(_resume, "begun", act), _right, needs=sound)
    for what, change in HOSTILE.items():
        yield Case(border, f"read: {what}", words, partial(_read, change), within=2, needs=sound)
        yield Case(border, f"resume: {what}", words, partial(_resume, "done", change), within=4, needs=sound)
    for what, change in CONTENT.items():
        for run in ("begun", "done"):
            if run == "done" and what == "a best stage outside":
                continue
            act = partial(_resume, run, _content(change))
            right = _right if what in ("a weight of another precision",) or "last_metrics" in what else None
            yield Case(border, f"resume, {run}: {what}", words, act, right, needs=sound)
    yield Case(border, "read: taken away", words, partial(_read, gone), needs=sound)
    act = partial(_resume, "done", gone)
    yield Case(
        border, "resume: last.pt taken away, best files there", (LAST, "best_sensor.pt"), act, _right, needs=sound
    )
    yield from _settings()


SETTINGS: dict[str, dict[str, Any]] = {
    "updates": {"zero": 0, "negative": -1, "a fraction": 1.5, "text": "x"},
    "validate_every": {"zero": 0, "negative": -1, "a fraction": 1.5, "text": "x"},
    "save_every": {"zero": 0, "negative": -1, "a fraction": 1.5, "text": "x"},
    "log_every": {"zero": 0, "negative": -1, "a fraction": 1.5, "text": "x"},
    "max_skipped": {"negative": -1, "text": "x"},
    "seed": {"negative": -1, "a fraction": 1.5, "text": "x"},
    "keep": {"unknown": "worst", "a number": 3},
    "monitor": {"unknown": "beauty"},
    "loggers": {"unknown": ("paper",)},
    "device": {"unknown": "abacus", "a number that is not there": "cuda:77"},
}


def _settings() -> Iterator[Case]:
    def train(folder: Path, **settings: Any) -> Any:
        return make_trainer(folder / "out", **{"updates": 1, "progress": False, **settings}).fit()

    for name, values in SETTINGS.items():
        for what, value in values.items():
            words = (name, "logger") if name == "loggers" else (name,)
            yield Case("training", f"FilterTrainer({name}: {what})", words, partial(train, **{name: value}))
    yield from _stages()

    def in_file(folder: Path) -> Any:
        (folder / "file").write_text("")
        return make_trainer(folder / "file", updates=1, progress=False).fit()

    yield Case("training", "FilterTrainer(out: a file)", ("out", "file"), in_file)


def _stages() -> Iterator[Case]:
    from torch_denkf.training import FilterTrainer, Stage

    net = torch.nn.Linear(1, 1)
    wrong: dict[str, dict[str, Any]] = {
        "name": {"a path": "../x", "empty": "", "a number": 3},
        "lr": {"zero": 0.0, "negative": -1.0, "nan": float("nan"), "inf": float("inf"), "text": "x"},
        "weight_decay": {"negative": -1.0, "nan": float("nan"), "text": "x"},
        "schedule": {"unknown": "weekly", "a number": 3},
        "clip": {"zero": 0.0, "negative": -1.0, "nan": float("nan"), "text": "x"},
        "lengths": {"without the first": {5: 4}, "negative": {0: -4}, "text": "x"},
    }

    def fit(folder: Path, **given: Any) -> Any:
        def sample(generator: torch.Generator, length: int | None) -> Any:
            from tensordict import TensorDict

            return TensorDict({"x": torch.rand(8, 1, generator=generator)}, [8])

        settings = {
            "name": "fit",
            "loss": lambda batch: {"loss_fit": net(batch["x"]).square().mean()},
            "sample": sample,
            "updates": 2,
        }
        return FilterTrainer(
            net, [Stage(**{**settings, **given})], out=folder / "out", device="cpu", progress=False
        ).fit()

    for name, values in wrong.items():
        for what, value in values.items():
            words = (name, "stage's name") if name == "name" else (name,)
            yield Case("training", f"Stage({name}: {what})", words, partial(fit, **{name: value}))
