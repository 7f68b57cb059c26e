"""Tests diagnostics next to a belief that resets: zeros, or the update's own where the reset is updated."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from tests.filters.factories import linear_denkf, linear_kalman, linear_system, linear_with
from tests.filters.test_forecasts import Reversed
from torch_denkf.modules import FromSensor

MEAN, VAR = ("belief", "mean"), ("belief", "var")


@pytest.fixture(autouse=True)
def _double(float64):
    torch.manual_seed(0)


def frames_with_starts():
    frames = TensorDict({"observation": torch.randn(3, 7, 2)}, [3, 7])
    frames["is_init"] = torch.zeros(3, 7, 1, dtype=torch.bool)
    frames["is_init"][:, 0] = frames["is_init"][1, 4] = True
    return frames


@pytest.mark.parametrize("how", ["sequence", "step"])
@pytest.mark.parametrize("update_at_reset", [False, True])
def test_the_diagnostics_of_a_start(how, update_at_reset):
    """With an update: the innovation of the reading against the initial belief, in closed form."""
    filter, frames = linear_kalman(update_at_reset=update_at_reset), frames_with_starts()
    _, _, H, R = linear_system()
    starts = frames["is_init"].squeeze(-1)
    if how == "sequence":
        out = filter.sequence(frames.copy())
    else:
        row, rows = filter.initialise(frames[:, 0].copy()), []
        for t in range(7):
            row = filter(frames[:, t].copy().update(row.select(*filter.carry_keys)))
            rows.append(row.exclude("next"))
        out = torch.stack(rows, 1)
    innovation = frames["observation"][starts] - filter.initial.mean @ H.mT
    cov = H @ filter.initial.cov @ H.mT + torch.diag(R)
    nis = (innovation * torch.linalg.solve(cov, innovation.mT).mT).sum(-1, keepdim=True)
    if not update_at_reset:
        innovation, nis = torch.zeros_like(innovation), torch.zeros_like(nis)
        assert (out[VAR][starts] == filter.initial.cov.diagonal()).all()
        assert (out[MEAN][starts] == filter.initial.mean).all()
    torch.testing.assert_close(out["info", "innovation"][starts], innovation)
    torch.testing.assert_close(out["info", "nis"][starts], nis)
    assert (out["info", "nis"][~starts] > 0).all()


def test_a_start_that_is_updated_needs_no_action():
    """The first observation of an episode comes before any action."""
    plain = linear_denkf(update_at_reset=True)
    driven = Reversed(linear_system()[0], torch.tensor([[0.5], [-1.0]]))
    filter = linear_with({"transition": driven}, update_at_reset=True)
    td = TensorDict({"observation": torch.randn(3, 2)}, [3])
    start = filter.initialise(td.copy())
    assert start.get(("forecast", "speed"), None) is None
    torch.testing.assert_close(start[MEAN], plain.initialise(td.copy())[MEAN])


def test_a_start_from_the_sensors_reading_runs_the_sensor():
    """Also where it is not updated with that frame: the initial belief reads what the frame modules write."""
    *_, R = linear_system()
    sensor = TensorDictModule(lambda raw: 2.0 * raw, ["raw"], ["observation"])
    initial = FromSensor([0, 1], [0.0, 0.0], [1.0, 1.0], ensemble_size=20_000, observation_key="observation")
    filter = linear_with({"sensor": sensor}, initial=initial)
    out = filter.initialise(TensorDict({"raw": torch.tensor([[1.0, -3.0]])}, [1]))
    # 5 standard errors of 20,000 members.
    assert ((out[MEAN] - torch.tensor([2.0, -6.0])).abs() < 5 * (R / 20_000).sqrt()).all()
    torch.testing.assert_close(out[VAR][0], R, rtol=5 * (2 / 20_000) ** 0.5, atol=0)
    assert filter.initialise({"raw": torch.zeros(2)})[MEAN].shape == (2,)
