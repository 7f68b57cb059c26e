"""Late readings of orientations, of a mean and a covariance: against plain numbers, and against filtering again."""

import pytest
import torch

from tests.filters.test_spaces import (
    MEAN,
    SPACE,
    STD,
    VAR,
    B,
    Orientation,
    Q,
    R,
    T,
    Turning,
    assert_turned,
    log,
    turned_beliefs,
)
from tests.smoothers.small_angles import PROCESS, SMALL, STARTS, assert_small_differences, linear, readings, rotating
from torch_denkf.functional.manifolds import SO3
from torch_denkf.fusion import FusedFilter, FusedSensor, Refiltering
from torch_denkf.modules import EKFTransition, GaussianAround, UKFTransition
from torch_denkf.modules.process_noise import as_process_noise
from torch_denkf.monitoring import Gated

DELAY = 3
TRANSITIONS = {"EKF": EKFTransition, "UKF": UKFTransition}


@pytest.fixture(autouse=True)
def _double(float64):
    return


def fused(kind, parts, std, q, r, *, space=None, reading_space=None, **sensor):
    """Returns a filter of one sensor."""
    start = GaussianAround(std, state_key="start", space=space)
    motion = TRANSITIONS[kind](parts[0], as_process_noise(q, start.state_dim), space=space)
    sensor = {"observed_key": "observed", "reading_space": reading_space, "delay": DELAY, **sensor}
    return FusedFilter(motion, {"pose": FusedSensor(parts[2], r, **sensor)}, initial=start)


def orientations(kind, **sensor):
    """Reads the log of orientations."""
    parts = Turning(), None, Orientation()
    return fused(kind, parts, STD, Q, R, space=SPACE, reading_space=SO3(), **sensor)


def arriving(data, late):
    """Returns the readings when they arrive: at t comes that of t - late[t]; the first frame's is not used."""
    index = torch.arange(T) - late
    out = data.clone()
    for key in ("pose", "observed"):
        out[key] = data[key][:, index.clamp(min=0)]
    out["observed"] = out["observed"] & (index > 0).unsqueeze(-1)
    out["late"] = late.reshape(1, T, 1).expand(B, T, 1)
    return out


LATE = torch.tensor([0, 2] * T)[:T]  # that of t=2 before that of t=1, and so on


@pytest.mark.parametrize("kind", TRANSITIONS)
def test_small_angles_are_plain_numbers(kind):
    (data, flat), r = readings(), [SMALL * std for std in R]
    options = {"late_key": "late"}
    on_space = fused(kind, rotating(), STARTS, PROCESS, r, space=SPACE, reading_space=SO3(), **options)
    out = on_space.sequence(arriving(data, LATE))
    expected = fused(kind, linear(), STARTS, PROCESS, r, **options).sequence(arriving(flat, LATE))
    for key in ("belief", "smoothed"):
        assert_small_differences(out, expected, key, data["start"])


@pytest.mark.parametrize("kind", TRANSITIONS)
def test_late_readings_nearly_equal_refiltering(kind):
    """Steps that were made before a reading came are linear in what it says; the error is a product of angles."""
    data = arriving(log(), LATE)
    out = orientations(kind, late_key="late").sequence(data.clone())
    again = Refiltering(orientations(kind, delay=0), {"late": ("pose", "observed")}, DELAY).sequence(data.clone())
    std = again[VAR].sqrt()
    away = SPACE.minus(out[MEAN], again[MEAN])[:, 1:] / std[:, 1:]
    assert away.square().mean().sqrt() < 0.05
    assert away.abs().max() < 0.3
    assert (out[VAR] / again[VAR] - 1)[:, 1:].abs().max() < 0.05


@pytest.mark.parametrize("kind", TRANSITIONS)
def test_a_late_reading_corrects_its_own_time_as_in_order(kind):
    """With the same delay for all, the belief of so many steps ago has seen what the filter in order had seen."""
    data = log()
    out = orientations(kind).sequence(arriving(data, torch.full((T,), DELAY)))
    expected = orientations(kind, delay=0).sequence(data)
    own, due = out["smoothed"][:, DELAY:], expected["belief"][:, :-DELAY]
    assert (SPACE.minus(own["mean"], due["mean"]).abs() / due["var"].sqrt()).max() < 0.2
    assert (own["var"] / due["var"] - 1).abs().max() < 0.02


@pytest.mark.parametrize("turn", [[2.0, -1.0, 0.5], [torch.pi, 0.0, 0.0]])
@pytest.mark.parametrize("kind", [*TRANSITIONS, "gated"])
def test_a_turned_world_turns_the_belief_and_nothing_else(kind, turn):
    filter = orientations("EKF" if kind == "gated" else kind, late_key="late")
    filter = Gated(filter, response="student", window=1, rate=1e-2) if kind == "gated" else filter
    data, turn = arriving(log(), LATE), SO3().exp(torch.tensor(turn))
    here, there = turned_beliefs(filter, turn, data)
    assert_turned(here, there, turn, 1e-9)
