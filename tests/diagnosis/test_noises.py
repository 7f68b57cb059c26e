"""Noises that are no covariances are named; entries that are none are in tests/borders/noises.py, too."""

import re

import pytest
import torch

from tests.diagnosis.noises_for_tests import AT, B, Given, Made, T, attitude, filter_of, run, sound_frames
from tests.filters.factories import linear_system

NAN = torch.nan
R, Q = ("sensor", "noise"), ("forecast", "noise")
WRONG = {"vector": [0.5, -1.0], "matrix": [[1.0, 2.0], [2.0, 1.0]]}


def filter_and_frames(name, which, source, kind, wrong):
    """Returns a filter, its frames, and the words by which a message may name what is wrong."""
    wrong = torch.tensor(wrong)
    fine = torch.tensor([0.5, 0.3]) if kind == "vector" else torch.tensor([[0.5, 0.1], [0.1, 0.3]])
    frames, modules = sound_frames(), {"R": Given("r", R), "Q": Given("q", Q)}
    if source == "entry":
        frames[which.lower()] = fine.expand(B, T, *fine.shape).clone()
        frames[which.lower()][AT] = wrong
    else:
        modules[which] = Made(wrong, fine, "observation", {"R": R, "Q": Q}[which])
        frames["observation"][AT] = 7.0
    return filter_of(name, modules["R"], modules["Q"]), frames


GAUSSIAN = ["KalmanFilter", "EKF", "UKF", "FusedEKF"]
SAMPLED = ["etkf", "particles", "FusedEnsemble"]
CASES = [(name, which, "vector") for name in GAUSSIAN + SAMPLED for which in "RQ"]
CASES += [(name, which, "matrix") for name in GAUSSIAN for which in "RQ"] + [(name, "Q", "matrix") for name in SAMPLED]


@pytest.mark.parametrize("way", ["step", "sequence"])
@pytest.mark.parametrize(("name", "which", "kind"), CASES)
def test_a_module_that_makes_no_covariance_is_named(name, which, kind, way):
    torch.manual_seed(0)
    filter, frames = filter_and_frames(name, which, "module", kind, WRONG[kind])
    with pytest.raises(ValueError, match="Made") as error:
        run(filter, frames, way)
    assert re.search(r"\[1, 2\]" if way == "sequence" else r"row \[1\]", str(error.value))
    assert "covariance" in str(error.value)


@pytest.mark.parametrize("kind", ["vector", "matrix"])
@pytest.mark.parametrize("name", GAUSSIAN)
def test_noise_free_reading_is_reproduced(name, kind):
    """A variance of zero is one: the limit of small ones."""
    zero = torch.zeros(2) if kind == "vector" else torch.zeros(2, 2)
    means = []
    for r in (zero, zero + 1e-9 * (torch.ones(2) if kind == "vector" else torch.eye(2))):
        filter, frames = filter_and_frames(name, "R", "entry", kind, r.tolist())
        means.append(run(filter, frames, "sequence")["belief", "mean"])
    torch.testing.assert_close(means[0], means[1], rtol=1e-4, atol=1e-4)
    exact = torch.linalg.solve(linear_system()[2], frames["observation"][AT])
    torch.testing.assert_close(means[0][AT], exact, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", SAMPLED)
def test_members_cannot_take_a_reading_without_noise(name):
    filter, frames = filter_and_frames(name, "R", "entry", "vector", [0.0, 0.3])
    with pytest.raises(ValueError, match=r"'r'|'sensor', 'gps', 'noise'") as error:
        run(filter, frames, "step")
    assert "its variance 0 is 0" in str(error.value)


@pytest.mark.parametrize("first", [-1.0, NAN])
def test_the_noise_of_an_initial_belief_is_not_read(first):
    filter, frames = filter_and_frames("EKF", "R", "entry", "vector", [0.5, 0.3])
    frames["r"][:, 0] = first
    assert filter.sequence(frames)["belief", "mean"].isfinite().all()


def test_a_negative_covariance_that_was_given_is_named():
    """It would stay below zero where little is learned, without a NaN."""
    filter, frames = filter_and_frames("EKF", "R", "entry", "vector", [0.5, 0.3])
    row = filter.initialise(frames[:, 0].exclude("is_init"))
    row["belief", "cov"] = torch.tensor([[-0.4, 0.0], [0.0, 1.0]]).expand(B, 2, 2)
    row.update(frames[:, 1].exclude("is_init"))
    row["q"], row["observed"] = torch.full((B, 2), 1e-3), torch.zeros(B, 1, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"negative variance in \('belief', 'var'\) in row \[0\]: component 0"):
        filter.step(row)


# ------------------------------------------------------------------------------------------- causes of other numbers


INPUTS = {
    "a quaternion of zeros": ("y", 0.0, r"'y', which is no point of SO3\(\): it has \[0, 0, 0, 0\]"),
    "time that runs back": ("dt", -0.1, r"the process noise that NoiseOfStep .* makes of .*'dt' \[-0.1\]"),
    "a step of 3e12 years": ("dt", 1e20, r"'dt' \[1e\+20\]"),
    "a reading beyond float32": ("gyro", 1e30, r"'gyro' \[1e\+30, 1e\+30, 1e\+30\]"),
}


@pytest.mark.parametrize("what", INPUTS)
@pytest.mark.parametrize("kind", ["EKF", "etkf"])
def test_the_cause_is_the_input_and_not_the_motion(kind, what):
    torch.manual_seed(0)
    filter, rows = attitude(kind)
    key, value, message = INPUTS[what]
    rows[key][1, 1] = value
    row = filter.initialise(rows[:, 0].copy()).update(rows[:, 1])
    if kind == "EKF" and what == "a step of 3e12 years":  # finite: the attitude is not known, and the reading tells it
        assert filter.step(row)["belief", "mean"].isfinite().all()
        return
    with pytest.raises(ValueError, match=message) as error:
        filter.step(row)
    assert "in row [1]" in str(error.value)
    with pytest.warns(UserWarning, match=r"NaN from row \[1, 1\] of the sequence on, because of .*" + message):
        out = filter.sequence(rows)
    assert out["belief", "mean"][0].isfinite().all()
