"""The parts of the G1 study that a wrong table could come from: roles and scores."""

import math

import pytest
import torch
from benchmarks.g1.scores import scores
from tensordict import TensorDict

from benchmarks.g1.motion import with_rates
from benchmarks.g1.recordings import JOINTS, Recordings, Roles, drawn_recording
from torch_denkf.data import LeRobotReplay

COUNT, STEPS, MEMBERS, FEATURES = 4, 60, 8, 5


def readings(error=0.0, spread=0.01):
    """A sensor that is wrong by ``error`` everywhere, of sines."""
    generator = torch.Generator().manual_seed(0)
    phase = torch.rand(COUNT, 1, JOINTS, generator=generator)
    truth = (torch.arange(STEPS).view(1, -1, 1) / 10 + 6.3 * phase).sin()
    samples = truth.unsqueeze(-2) + error + spread * torch.randn(COUNT, STEPS, MEMBERS, JOINTS, generator=generator)
    seen = torch.ones(COUNT, STEPS, 1, dtype=torch.bool)
    encoding = torch.randn(COUNT, STEPS, FEATURES, generator=generator)
    out = TensorDict(
        {
            "observed": seen,
            "valid": seen.clone(),
            "arrived": seen.clone(),
            "state": truth,
            "start": torch.zeros_like(truth),
        },
        [COUNT, STEPS],
    )
    out["sensor"] = TensorDict({"ensemble": samples, "encoding": encoding}, [COUNT, STEPS])
    out["motion"] = torch.stack([with_rates(one) for one in truth])
    return out


# Roles ----------------------------------------------------------------------------------------------------------------


def test_no_episode_has_two_roles(tmp_path):
    with pytest.raises(ValueError, match=r"two roles: \[3\]"):
        Roles([1], [2, 3], [4], [3, 5])
    recordings = Recordings(out=tmp_path, size=(12, 16), tune=3, validation=2, drawn=True)
    tests = {e.number for e in LeRobotReplay(drawn_recording((12, 16)), split="test").episodes}
    first, second = recordings.roles(0), recordings.roles(1)
    assert set(first.test) == set(second.test) == tests
    assert (len(first.tune), len(first.validation)) == (3, 2)
    assert len({*first.sensor, *first.tune, *first.validation, *first.test}) == 20
    assert first.sensor != second.sensor


# Scores and tables ----------------------------------------------------------------------------------------------------


def test_scores_leave_out_what_does_not_count():
    clean = readings()
    clean["valid"][1:, 30:] = False
    mean = clean["state"] + torch.tensor([0.01] * 6 + [0.08])
    mean[:, 0], mean[2, 40:] = 99.0, 99.0
    row = scores(mean, torch.full_like(mean, 0.03**2), clean)
    assert row["joint_mae_deg"] == pytest.approx(math.degrees(0.02), rel=1e-4)
    assert row["wrist_yaw_deg"] == pytest.approx(math.degrees(0.08), rel=1e-4)
    assert row["coverage90"] == pytest.approx(6 / 7)  # 0.08 is outside of 1.645 x 0.03
    assert row["wrist_yaw_coverage90"] == 0.0
