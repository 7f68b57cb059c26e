"""The parts of the G1 study that a wrong table could come from: roles, failing cameras and scores."""

import math

import pytest
import torch
from tensordict import TensorDict

from benchmarks.common.arm import JOINTS, Roles
from benchmarks.common.arm.readings import BLACK, Windows, fail
from benchmarks.common.arm.scores import estimated
from benchmarks.g1.recordings import NAMES, Recordings, drawn_recording
from benchmarks.g1.study import score_row
from torch_denkf.data import LeRobotReplay


def readings(count=4, steps=60):
    """Returns a sensor that is right, of episodes of which the others are shorter than the first."""
    valid = torch.ones(count, steps, 1, dtype=torch.bool)
    valid[1:, 30:] = False
    truth = torch.randn(count, steps, JOINTS, generator=torch.Generator().manual_seed(0))
    sensor = {"ensemble": truth.unsqueeze(-2), "encoding": truth}
    masks = {"valid": valid, "observed": valid.clone(), "arrived": valid.clone()}
    return TensorDict({**masks, "state": truth, "sensor": sensor}, [count, steps])


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


# Failing cameras ------------------------------------------------------------------------------------------------------


def test_black_frames_are_removed():
    clean = readings()
    dark = fail(clean, "black20")
    assert fail(clean, "clean")["observed"].equal(clean["observed"])
    lost = (clean["observed"] & ~dark["observed"]).squeeze(-1)
    assert int(lost[0].sum()) == BLACK
    assert (lost[0].nonzero().flatten().diff() == 1).all()  # one after the other
    assert (dark["sensor", "ensemble"][lost] == 0).all()
    kept = ~lost & clean["valid"].squeeze(-1)
    assert dark["sensor", "ensemble"][kept].equal(clean["sensor", "ensemble"][kept])


def test_windows_stay_within_an_episode_and_lose_no_first_frame():
    clean = readings()
    windows = Windows([clean, clean], 20, (0.9, 0.1)).sample(torch.Generator().manual_seed(0), 500)
    assert windows["valid"].all()
    assert windows["observed"][:, 0].all()
    lost = 1 - windows["observed"].float().mean().item()
    assert 0.125 < lost < 0.25  # half of up to half; a third of up to 20
    with pytest.raises(ValueError, match="windows of 31 rows do not fit in a sequence of 30"):
        Windows([clean], 31)


# Scores ---------------------------------------------------------------------------------------------------------------


def test_scores_exclude_masked_rows():
    clean = readings()
    mean = clean["state"] + torch.tensor([0.01] * 6 + [0.08])
    mean[:, 0], mean[2, 40:] = 99.0, 99.0
    row = score_row(estimated(clean, mean, torch.full_like(mean, 0.03**2)), "clean")
    assert row["joint_mae_deg"] == pytest.approx(math.degrees(0.02), rel=1e-3)
    assert row[f"{NAMES[-1]}_deg"] == pytest.approx(math.degrees(0.08), rel=1e-3)
    assert row["coverage90"] == pytest.approx(6 / 7)  # 0.08 is outside of 1.645 x 0.03
