"""Intervals on simulated drives, what happens to corners, and a run of a few rows."""

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from benchmarks.sequence07.filters import DT, POSE, SPACE, SWAYS, CarMotion, car_filter, pose_of, prepared
from benchmarks.sequence07.study import Claim, and_one_more, claimed, run, windows
from benchmarks.sequence07.task import chained
from torch_denkf.functional.manifolds import SE3
from torch_denkf.smoothers import RTSSmoother


@pytest.fixture(autouse=True)
def _double(float64):
    return


def driven(count=240, runs=4, seed=0, slips=True):
    """Returns drives as the filters take them to be: readings and poses ``[C, T]``; each ninth row is not seen."""
    torch.manual_seed(seed)
    data = TensorDict({"motion": SE3().neutral(torch.zeros(7)).expand(runs, count, 7).clone()}, [runs, count])
    data["motion_cov"] = torch.diag_embed(torch.tensor([1e-4] * 3 + [2e-3] * 3).square()).expand(runs, count, 6, 6)
    data["dt"] = torch.full((runs, count, 1), DT)
    data["gyro"] = torch.zeros(runs, count, 3)
    data["gyro_observed"] = torch.ones(runs, count, 1, dtype=torch.bool)
    data["motion_observed"] = (torch.arange(count) % 9 > 0).reshape(1, count, 1).expand(runs, count, 1).clone()
    data["motion"][..., 6] = 8.0 * DT  # for the speed before a row
    believed, motion = prepared(data), CarMotion()
    state = SPACE.perturb(
        SPACE.neutral(torch.zeros(26)).expand(runs, 26), car_filter("EKF").initial.std, torch.randn(runs, 25)
    )
    state[:, 12] = 8.0 + torch.randn(runs)
    state[:, 20:] *= slips
    states = [state]
    for row in range(1, count + 1):
        at = min(row, count - 1)
        noise = believed["process"][:, at].sqrt() * torch.randn(runs, 15)
        parts = noise[:, :6], noise[:, SWAYS], noise[:, 6:9], slips * noise[:, 9:]
        step = torch.cat([torch.zeros(runs, 6), *parts], -1)
        dt = torch.full((runs, 1), DT if row > 1 else 0.0)
        state = SPACE.plus(
            motion.move(state, *(believed[key][:, at] for key in ("kept", "swing", "slip_kept")), dt=dt), step
        )
        states.append(state)
    states = torch.stack(states, 1)
    poses, states = states[:, 1:, POSE], states[:, :-1]
    root = torch.linalg.cholesky(believed["motion_noise"])
    error = (root @ torch.randn(runs, count, 6, 1)).squeeze(-1)
    data["motion"] = SE3().plus(SE3().exp(states[..., 7:13] * DT), error)
    gyro = believed["gyro_noise"].sqrt() * torch.randn(runs, count, 3)
    data["gyro"] = states[..., 7:10] + states[..., 17:20] + gyro
    return data, poses


def test_coverage_of_simulated_errors_is_nominal():
    truth, var = SE3().exp(0.1 * torch.randn(500, 2, 6)), torch.rand(500, 2, 6) * 1e-4
    mean = SE3().perturb(truth, var.sqrt(), torch.randn(500, 2, 6))
    held = Claim(mean, var, truth).held()
    assert_close(held, torch.full((2,), 0.9), rtol=0, atol=0.015)
    assert_close(Claim(mean, var / 4, truth).held(), torch.full((2,), 0.589), rtol=0, atol=0.03)


@pytest.mark.parametrize("kind", ["EKF", pytest.param("DEnKF", marks=pytest.mark.slow)])
def test_relative_motion_errors_match_their_covariance(kind):
    """Drives that are what the filter takes them for, with coloured noise: over 1, 10 and 100 rows."""
    data, poses = driven()
    options = {} if kind == "EKF" else {"members": 64, "localisation": "significance"}
    means = run(car_filter(kind, **options), prepared(data))["belief", "mean"]
    parts = [windows(data[at : at + 1], means[at : at + 1], poses[at]) for at in range(len(data))]
    part, true = torch.cat([part.flatten(0, 1) for part, _ in parts]), torch.cat([true for _, true in parts])
    held = claimed(run(car_filter(kind, again=True, **options), part), true).held()
    assert ((held > 0.8) & (held < 0.98)).all(), held


def test_zero_order_hold_of_the_velocity():
    step = SE3().exp(torch.tensor([0.0, 0.1, 0.0, 0.0, 0.0, 1.0]))
    motions = step.expand(5, 7).clone()
    motions[3] = SE3().neutral(step)
    dt = torch.full((5, 1), 0.1)
    dt[3] = 0.2  # twice as long
    path = chained(motions, torch.tensor([False, True, True, False, True]), dt)
    assert_close(path[-1], SE3().exp(torch.tensor([0.0, 0.5, 0.0, 0.0, 0.0, 5.0])))


@pytest.mark.slow
def test_a_smoothed_step_is_nearer_than_a_reading_and_than_a_filtered_step():
    data, poses = driven(120, slips=False)
    out = run(RTSSmoother(car_filter("EKF")), prepared(and_one_more(data)))
    paths = [chained(one["motion"], one["motion_observed"].squeeze(-1), one["dt"]) for one in data]
    paths = [torch.stack(paths), pose_of(out)[0], pose_of(out, "smoothed")[0]]
    steps = [SE3().compose(SE3().inverse(path[:, :-1]), path[:, 1:]) for path in (*paths, poses)]
    errors = [SE3().minus(step, steps[-1]).square().mean().sqrt() for step in steps[:-1]]
    assert errors[2] < 0.95 * min(errors[:2])


def test_members_with_room_for_the_state_are_the_extended_filter():
    data, _ = driven(30, runs=2)
    paths = []
    for options in ({"kind": "EKF"}, {"kind": "DEnKF", "members": 32, "slip": False}):
        torch.manual_seed(1)
        paths.append(pose_of(run(car_filter(**options), prepared(and_one_more(data))))[0])
    apart = SE3().minus(*paths)
    assert apart[..., 3:].norm(dim=-1).max() < 0.02, "m, of 25 driven; random draws are some tenths off"
    assert apart[..., :3].norm(dim=-1).max() < 0.002
