"""Noises that are no covariance, and inputs that leave float32, in every filter: of the data or made by a module."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import finite, same
from benchmarks.reliability.target import Target
from tests.diagnosis.noises_for_tests import AT, Given, attitude, filter_of, run, sound_frames
from torch_denkf.imperfect import RejectReadings

NAN, INF = float("nan"), float("inf")
GAUSSIAN = ("KalmanFilter", "EKF", "UKF", "FusedEKF")
SAMPLED = ("etkf", "perturbed", "sakov", "particles", "FusedEnsemble")
BELIEF = [("belief", "mean"), ("belief", "var")]
Change = Callable[[TensorDict], TensorDict]
BELOW = st.floats(-1e30, -1e-6)


def _with(value: Tensor, place: tuple[int, ...], number: float) -> Tensor:
    out = value.clone()
    out[place] = number
    return out


VARIANCES = d.Wrong(
    {
        what: _with(torch.tensor([0.5, 0.3]), (1,), number)
        for what, number in {"-1": -1.0, "-.02": -0.02, "-1e30": -1e30, "nan": NAN, "inf": INF, "-inf": -INF}.items()
    },
    st.builds(
        lambda number, place: (f"{number} in place {place}", _with(torch.tensor([0.5, 0.3]), (place,), number)),
        BELOW,
        st.integers(0, 1),
    ),
)
SOUND = torch.tensor([[0.5, 0.1], [0.1, 0.3]])
COVARIANCES = d.Wrong(
    {
        "a negative variance": _with(SOUND, (1, 1), -0.02),
        "all -1": -torch.ones(2, 2),
        "-1 on the diagonal": -torch.eye(2),
        "indefinite": torch.tensor([[1.0, 2.0], [2.0, 1.0]]),
        "hardly indefinite": torch.tensor([[1.0, 1.01], [1.01, 1.0]]),
        "one triangle": torch.tensor([[1.0, 50.0], [0.0, 1.0]]),
        "the other triangle": torch.tensor([[1.0, 0.0], [50.0, 1.0]]),
        "not symmetric": torch.tensor([[1.0, 0.3], [0.2, 1.0]]),
        "zero beside a correlation": torch.tensor([[0.0, 0.1], [0.1, 1.0]]),
        "nan": _with(SOUND, (0, 1), NAN),
        "inf": _with(SOUND, (0, 0), INF),
        "mixed units": torch.tensor([[1e6, 2.0], [2.0, 1e-6]]),
    },
    st.floats(1.01, 1e6).map(
        lambda much: (f"a correlation of {much}", torch.tensor([[1.0, much], [much, 1.0]])),
    ),
)


def _fed(name: str, which: str, way: str, change: Change, value: Tensor, _: Any) -> Any:
    modules = {"R": Given("r", ("sensor", "noise")), "Q": Given("q", ("forecast", "noise"))}
    frames = sound_frames()
    sound = torch.tensor([0.5, 0.3]) if value.ndim == 1 else SOUND
    frames[which.lower()] = sound.expand(*frames.batch_size, *sound.shape).clone()
    frames[which.lower()][AT] = value
    return _run(filter_of(name, modules["R"], modules["Q"]), change(frames), way)


def _run(filter: Any, frames: TensorDict, way: str) -> TensorDict:
    """Runs a filter; a warning of a NaN in a sequence is as good as an error."""
    torch.manual_seed(0)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="The belief is NaN")
        return run(filter, frames, way).select(*BELIEF)


def _hidden(frames: TensorDict) -> TensorDict:
    frames["observed"][AT] = False
    return frames


def _without_second(frames: TensorDict) -> TensorDict:
    frames["observed"] = frames["observed"].expand(*frames.batch_size, 2).clone()
    frames["observed"][AT] = torch.tensor([True, False])
    return frames


def _rejected(frames: TensorDict) -> TensorDict:
    return RejectReadings({"observation": "observed"}, noises={"observation": "r"})(frames)


def _unread(name: str, way: str, sound: Tensor, result: TensorDict, hide: Change = _hidden) -> bool:
    """Right where the result is that of a hidden reading."""
    return finite(result) and same(result, _fed(name, "R", way, hide, sound, None), rtol=1e-5)


def _far(kind: str, way: str, key: str, number: float, _: Path) -> Any:
    filter, rows = attitude(kind)
    rows[key][1, 1] = number
    torch.manual_seed(0)
    return _run(filter, rows, way)


NUMBERS = d.Wrong(
    {
        "zero": 0.0,
        "-1": -1.0,
        "-.1": -0.1,
        "1e6": 1e6,
        "1e15": 1e15,
        "1e20": 1e20,
        "1e30": 1e30,
        "nan": NAN,
        "inf": INF,
    },
    (st.floats(1e18, 3e38) | st.floats(-3e38, -1e18)).map(lambda number: (f"{number}", number)),
)


def targets() -> Iterator[Target]:
    """R and Q, shown and hidden and rejected; times, quaternions and rates that are none."""
    for name in GAUSSIAN + SAMPLED:
        for way in ("step", "sequence"):
            for which, word in (("R", "r"), ("Q", "q")):
                kinds = {"variances": VARIANCES}
                if name in GAUSSIAN or which == "Q":
                    kinds["covariance"] = COVARIANCES
                for kind, wrong in kinds.items():
                    act = partial(_fed, name, which, way, lambda frames: frames)
                    # An infinite variance is that of a reading that says nothing.
                    right = partial(_unread, name, way, SOUND.diagonal(), hide=_without_second)
                    rights = {"inf": right} if name in SAMPLED else {}
                    rights = rights if which == "R" else {}
                    yield Target("noises", f"{name}, {way}, {which}, {kind}", (word,), act, wrong, rights=rights)
                    if which == "R":
                        for how, change in (("hidden", _hidden), ("rejected", _rejected)):
                            act = partial(_fed, name, which, way, change)
                            right = partial(_unread, name, way, SOUND if kind == "covariance" else SOUND.diagonal())
                            yield Target("noises", f"{name}, {way}, R, {kind}, {how}", (word,), act, wrong, right)
    for kind in ("EKF", "etkf"):
        for way in ("step", "sequence"):
            for key in ("y", "dt", "gyro"):
                act = partial(_far, kind, way, key)
                yield Target("noises", f"{kind} of an attitude, {way}, {key}", (key,), act, NUMBERS, finite)
