"""Readings that span a gap. Oracles: the filter without gaps, a Kalman filter on the cloned state, plane geometry."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential

from tests.filters.factories import random_draws
from torch_denkf.applications.car import UnicycleMotion, UnicycleTransition
from torch_denkf.applications.car.modules.pairs import ClonedPrior, ClonedTransition, PairObservation, with_history
from torch_denkf.applications.car.modules.unicycle_noise import UnicycleNoise
from torch_denkf.filters import EKF, DEnKF
from torch_denkf.imperfect import RejectReadings
from torch_denkf.modules import AroundState, ConstantNoise, EnsembleAnalysis, GaussianAround, Select

DT, Q, R, START = 0.5, (0.3, 0.05), (0.2, 0.02), (0.0, 0.0, 0.0, 0.6, 0.1)


class Walk(torch.nn.Module):
    """Changes of the velocities: N(0, Q)."""

    def forward(self, velocity):
        return torch.randn_like(velocity) * velocity.new_tensor(Q).sqrt()


class Straight(torch.nn.Module):
    """Changes of the speed alone: N(0, Q)."""

    def forward(self, velocity):
        return torch.randn_like(velocity) * velocity.new_tensor([Q[0] ** 0.5, 0.0])


def pair_filter(size, scheme="perturbed", reach=None, change=None, lags=2, start=START, **options):
    keys = {"forecast_key": ("forecast", "clone"), "observed_key": ("forecast", "observed"), "observation_key": "y"}
    return DEnKF(
        UnicycleTransition(change or Walk(), DT),
        None,
        PairObservation(reach),
        ConstantNoise(torch.tensor(R).sqrt(), in_key="y"),
        TensorDictSequential(
            EnsembleAnalysis(scheme, belief_prefix="analysis", **keys),
            UnicycleMotion(DT, history_key=("belief", "history"), **options),
        ),
        initial=with_history(AroundState(start, ensemble_size=size), lags=lags),
    )


def frames_of(y, steps):
    is_init = torch.zeros(len(y), 1, dtype=torch.bool)
    is_init[0] = True
    steps = torch.tensor(steps).unsqueeze(-1)
    state = torch.tensor([0.0, 0.0, 0.0, 4.0, 0.1]).expand(len(y), 5)
    return TensorDict({"y": y, "steps": steps, "observed": steps > 0, "is_init": is_init, "state": state}, [len(y)])


def test_neighbours_are_filtered_as_without_a_history(float64):
    plain = DEnKF(
        UnicycleTransition(Walk(), DT),
        None,
        Select([3, 4]),
        ConstantNoise(torch.tensor(R).sqrt(), in_key="y"),
        TensorDictSequential(
            EnsembleAnalysis("perturbed", observation_key="y", belief_prefix="analysis"), UnicycleMotion(DT)
        ),
        initial=AroundState(START, ensemble_size=16),
    )
    frames = frames_of(torch.randn(9, 2) + torch.tensor([4.0, 0.1]), [0, 1, 1, 0, 1, 1, 0, 0, 1])
    results = []
    for filter in map(random_draws, (plain, pair_filter(16))):  # a history takes part in what draws are exact to
        torch.manual_seed(2)
        results.append(filter.sequence(frames.copy())["belief", "ensemble"])
    torch.testing.assert_close(*results, rtol=0, atol=1e-12)


def test_the_way_over_a_gap_is_that_of_the_corrected_steps(float64):
    before = torch.tensor([1.0, 2.0, 0.3, 9.0, 0.2]).expand(2, 5)
    history = torch.tensor([[9.0, 0.2], [8.0, -0.1]]).expand(2, 2, 2)
    analysis = torch.tensor([0.0, 0.0, 0.0, 5.0, 0.4, 6.0, 0.5, 7.0, 0.6]).expand(2, 9)
    for steps, path in ((3, [(7.0, 0.6), (6.0, 0.5), (5.0, 0.4)]), (2, [(8.0, -0.1), (6.0, 0.5), (5.0, 0.4)])):
        td = TensorDict({"belief": {"ensemble": before, "history": history}, "analysis": {"ensemble": analysis}})
        out = UnicycleMotion(DT, history_key=("belief", "history"))(td.set("steps", torch.tensor([steps])))
        # By complex numbers: back along the two past steps, forwards along the corrected ones.
        place, heading = complex(1.0, 2.0), 0.3
        for v, w in ((9.0, 0.2), (8.0, -0.1)):
            place -= v * DT * complex(torch.polar(torch.tensor(1.0), torch.tensor(heading - w * DT / 2)))
            heading -= w * DT
        for v, w in path:
            place += v * DT * complex(torch.polar(torch.tensor(1.0), torch.tensor(heading + w * DT / 2)))
            heading += w * DT
        expected = torch.tensor([place.real, place.imag, heading, 5.0, 0.4])
        torch.testing.assert_close(out["belief", "ensemble"][0], expected, rtol=0, atol=1e-12)
        assert out["belief", "history"][0].tolist() == [[5.0, 0.4], list(path[1])]


def test_out_of_range_pairs_are_masked(float64):
    frames = frames_of(torch.full((4, 2), 9.0), [0, 0, 0, 3])
    frames["state"] = torch.tensor([0.0, 0.0, 0.0, 9.0, 0.1]).expand(4, 5)
    torch.manual_seed(0)
    far = pair_filter(16, reach=[10.0, torch.inf]).sequence(frames.copy())
    torch.manual_seed(0)
    blind = pair_filter(16).sequence(frames.copy().set("observed", torch.zeros(4, 1, dtype=torch.bool)))
    assert not far["forecast", "observed"][-1].any()  # 3 x 9 m/s, known to about 1 m/s each
    assert far["belief", "ensemble"].equal(blind["belief", "ensemble"])


def test_neighbouring_frames_are_read_at_any_believed_speed(float64):
    """Otherwise a filter whose speed has run away stays blind, and keeps it."""
    frames = frames_of(torch.full((12, 2), 4.0) * torch.tensor([1.0, 0.0]), [0, *[1] * 11])
    frames["state"] = torch.tensor([0.0, 0.0, 0.0, 60.0, 0.0]).expand(12, 5)
    torch.manual_seed(0)
    out = pair_filter(32, reach=[10.0, torch.inf]).sequence(frames)
    assert out["forecast", "observed"][1:].all()
    assert abs(float(out["belief", "mean"][-1, 3]) - 4.0) < 2.0  # far within the 10 m/s of the reach


def test_a_slow_camera_is_read_again_when_the_car_slows_down(float64):
    """Keeps pairs in range under a large variance: else an overestimated speed would never be corrected."""
    frames = frames_of(torch.full((91, 2), 6.0) * torch.tensor([1.0, 0.0]), [0] + [0, 0, 3] * 30)
    frames["state"] = torch.tensor([0.0, 0.0, 0.0, 9.0, 0.0]).expand(91, 5)  # estimate; the true speed is 3 x 2 m/s
    torch.manual_seed(0)
    out = pair_filter(64, reach=[10.0, torch.inf]).sequence(frames)
    read = out["forecast", "observed"].squeeze(-1)
    assert not read[3]
    assert read[60::3].all()
    assert abs(float(out["belief", "mean"][-1, 3]) - 2.0) < 1.0


def test_a_smoothed_path_is_that_of_a_kalman_filter_of_velocity_and_way(float64):
    """Its way is corrected by all innovations since; so is the filter's path, if the history is as long as the drive.

    Without smoothing the way is the sum of filtered velocities, which lag behind: 4 m/s jumps to 6 and stays there.
    """
    size, steps = 40_000, [0, *[1] * 5]
    y = torch.tensor([[6.0, 0.0]]).repeat(6, 1)
    frames = frames_of(y, steps)
    frames["state"] = torch.tensor([0.0, 0.0, 0.0, 4.0, 0.0]).expand(6, 5)
    still = (0.0, 0.0, 0.0, 0.0, 0.0)  # nothing is corrected before the start
    found = {}
    for smooth in (False, True):
        filter = random_draws(pair_filter(size, change=Straight(), lags=5, start=still, smooth=smooth))
        torch.manual_seed(0)
        found[smooth] = filter.sequence(frames.copy())["belief", "ensemble"][-1]
    mean, cov = torch.tensor([4.0, 0.0]), torch.zeros(2, 2)  # of speed and way
    shift, noise = torch.tensor([[1.0, 0.0], [DT, 1.0]]), torch.tensor([1.0, DT])
    for value in y[1:, 0]:
        mean, cov = shift @ mean, shift @ cov @ shift.T + Q[0] * noise[:, None] * noise
        gain = cov[:, 0] / (cov[0, 0] + R[0])
        mean, cov = mean + gain * (value - mean[0]), cov - gain[:, None] * cov[0]
    way = found[True][:, 0]
    error = float((cov[1, 1] / size).sqrt())
    assert abs(float(way.mean() - mean[1])) < 4 * error
    torch.testing.assert_close(way.var(), cov[1, 1], rtol=4 * (2 / size) ** 0.5, atol=0)
    assert float(mean[1] - found[False][:, 0].mean()) > 20 * error  # 0.13 m of 14.5 m
    torch.testing.assert_close(found[True][:, 3:], found[False][:, 3:], rtol=0, atol=1e-12)  # velocities are the same


def test_an_ekf_with_clones_is_the_kalman_filter_with_clones(float64):
    """Without turning all is linear: the EKF on the cloned state must be exact, the trend included."""
    steps = [0, 1, 0, 2, 1, 0, 0, 3, 1]
    y = torch.randn(9, 2) + torch.tensor(steps).unsqueeze(-1) * torch.tensor([4.0, 0.0])
    y[:, 1] = 0.0
    motion = UnicycleTransition(torch.zeros_like, DT, history_key=("belief", "history"))
    share = float(motion.raw_trend[0].sigmoid())
    noise = ConstantNoise([Q[0] ** 0.5, 1e-9], in_key=("belief", "mean"), out_key=("forecast", "noise"))
    ekf = EKF(
        ClonedTransition(motion),
        None,
        PairObservation(history_key=None),
        ConstantNoise(torch.tensor(R).sqrt(), in_key="y"),
        process_noise=UnicycleNoise(noise, DT),
        initial=ClonedPrior(GaussianAround([0.0, 0.0, 0.0, 0.6, 0.0]), 2),
        observation_key="y",
        observed_key=("forecast", "observed"),
    )
    frames = frames_of(y, steps)
    frames["state"] = torch.tensor([0.0, 0.0, 0.0, 4.0, 0.0]).expand(9, 5)
    out = ekf.sequence(frames)["belief"]
    mean, cov = torch.tensor([4.0, 4.0, 4.0, 0.0]), torch.zeros(4, 4)
    cov[:3, :3] = 0.36
    shift = torch.tensor([[1 + share, -share, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [DT * (1 + share), -DT * share, 0, 1]])
    enters = torch.tensor([1.0, 0.0, 0.0, DT])
    for t in range(1, 9):
        mean, cov = shift @ mean, shift @ cov @ shift.T + Q[0] * enters[:, None] * enters
        if steps[t]:
            h = torch.tensor([float(lag < steps[t]) for lag in range(3)] + [0.0])
            gain = cov @ h / (h @ cov @ h + R[0])
            mean, cov = mean + gain * (y[t, 0] - h @ mean), cov - gain[:, None] * (h @ cov)
        dims = [3, 5, 7, 0]
        torch.testing.assert_close(out["mean"][t, dims], mean, rtol=0, atol=1e-8)
        torch.testing.assert_close(out["cov"][t][dims][:, dims], cov, rtol=0, atol=1e-8)


@pytest.mark.parametrize("masked", [True, False])
def test_a_rejected_reading_counts_as_not_observed(float64, masked):
    frames = frames_of(torch.randn(6, 2) + torch.tensor([4.0, 0.1]), [0, 1, 1, 1, 1, 1])
    bad, hidden = frames.clone(), frames.clone()
    bad["y"][3] = torch.nan
    hidden["observed"][3] = False
    if not masked:
        del bad["observed"]
    filter, outs = pair_filter(16), []
    for data in (RejectReadings({"y": "observed"}, by_component=["y"])(bad), hidden):
        torch.manual_seed(3)
        outs.append(filter.sequence(data))
    assert outs[0]["info", "rejected"].flatten().tolist() == [0, 0, 0, 2, 0, 0]
    torch.testing.assert_close(outs[0]["belief", "ensemble"], outs[1]["belief", "ensemble"], rtol=0, atol=0)
