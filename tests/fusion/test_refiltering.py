"""Refiltering of late readings equals filtering in order of time stamps, under the same noise."""

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from tests.filters.factories import FixedEnsemble, NoisyLinear, linear_denkf, linear_system
from tests.fusion.test_fused import BELIEF, DELAY, PATTERNS, B, T, arrived, arriving, fused, readings, sensors
from torch_denkf.filters import ParticleFilter
from torch_denkf.fusion import FusedFilter, Refiltering, SensorAttention
from torch_denkf.modules import ConstantNoise, GaussianLikelihood, GaussianPrior, LinearObservation
from torch_denkf.monitoring import Gated, InnovationMonitor, Monitored, MonitoredSensor

LATE = {"late": ("second", "second_observed")}
MEMBERS = torch.randn(7, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def assert_in_order(filter, late, keys, atol=1e-10):
    """Asserts that each belief equals that of the readings received by then, in order of their time stamps."""
    frames = filter.draw_noise(readings())
    out = Refiltering(filter, LATE, DELAY).sequence(arriving(frames, late))
    for now in range(T):
        expected = filter.sequence(arrived(frames, late, now))
        for key in keys:
            assert_close(out[key][:, now], expected[key][:, -1], rtol=0, atol=atol)


def noisy_motion():
    F, Q, _, _ = linear_system()
    return NoisyLinear(F, torch.linalg.cholesky(Q))


@pytest.mark.parametrize("joint", [False, True])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_an_ensemble_with_process_noise(float64, pattern, joint):
    assert_in_order(fused("ensemble", members=MEMBERS, joint=joint), PATTERNS[pattern], [("belief", "ensemble")])


@pytest.mark.parametrize("pattern", PATTERNS)
def test_particles(float64, pattern):
    _, _, H, R = linear_system()
    filter = ParticleFilter(
        noisy_motion(),
        None,
        LinearObservation(H[1:]),
        GaussianLikelihood(observation_key="second", observed_key="second_observed"),
        noise=ConstantNoise(R[1:].sqrt(), in_key="second"),
        observed_key="second_observed",
        initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=20),
    )
    assert_in_order(filter, PATTERNS[pattern], filter.carry_keys)


@pytest.mark.parametrize("kind", ["Kalman", "UKF"])
def test_gaussian_filters_equal_the_augmented_state(float64, kind):
    late = PATTERNS["out of order"]
    assert_in_order(fused(kind), late, BELIEF)
    out = Refiltering(fused(kind), LATE, DELAY).sequence(arriving(readings(), late))
    expected = fused(kind, delay=DELAY, late_key="late").sequence(arriving(readings(), late))
    for key in BELIEF:
        assert_close(out[key], expected[key], rtol=0, atol=1e-10)


def test_attention_weights_of_late_readings(float64):
    torch.manual_seed(0)
    weights = SensorAttention({"first": 1, "second": 1}, size=4)
    with torch.no_grad():
        for parameter in weights.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    filter = FusedFilter(noisy_motion(), sensors(), initial=FixedEnsemble(MEMBERS), weights=weights)
    assert_in_order(filter, PATTERNS["out of order"], [("belief", "ensemble")])


def test_different_delays_in_a_batch_and_their_gradients(float64):
    filter = fused("ensemble", members=MEMBERS)
    frames = filter.draw_noise(readings())
    frames["second_observed"][:] = True
    late = torch.zeros(B, T, 1, dtype=torch.int64)
    rows = frames.copy()
    for row, steps in enumerate((1, 2, 3)):  # a different delay in each row; no other reading at the arrival
        late[row, 5 + steps] = steps
        rows["second"][row, 5 + steps] = frames["second"][row, 5]
    rows["late"] = late
    order, rows = frames.clone(), rows.clone()
    rows["second_observed"][:, 5] = False
    for row, steps in enumerate((1, 2, 3)):
        order["second_observed"][row, 5 + steps] = False
    inputs = [frames["second"].clone().requires_grad_() for frames in (rows, order)]
    rows["second"], order["second"] = inputs
    outs = [Refiltering(filter, LATE, DELAY).sequence(rows.copy()), filter.sequence(order.copy())]
    for out in outs:
        out["belief", "ensemble"][:, -1].square().sum().backward()
    assert_close(outs[0]["belief", "ensemble"][:, -1], outs[1]["belief", "ensemble"][:, -1], rtol=0, atol=1e-10)
    for row, steps in enumerate((1, 2, 3)):
        assert_close(inputs[0].grad[row, 5 + steps], inputs[1].grad[row, 5], rtol=0, atol=1e-10)
        assert inputs[1].grad[row, 5].abs() > 1e-4


def test_readings_from_before_the_episode_or_the_window_are_not_used(float64):
    filter = fused("ensemble", members=MEMBERS)
    frames = filter.draw_noise(readings())
    hidden = frames.copy()
    hidden["second_observed"] = torch.zeros_like(frames["second_observed"])
    expected = filter.sequence(hidden)["belief", "ensemble"]
    for late in (torch.arange(T), torch.full((T,), DELAY + 1)):
        rows = frames.copy()
        rows["late"] = late.reshape(1, T, 1).expand(B, T, 1)
        out = Refiltering(filter, LATE, DELAY).sequence(rows)
        assert_close(out["belief", "ensemble"], expected, rtol=0, atol=1e-12)


def test_noise_is_drawn_once_and_actions_drive_the_next_step(float64):
    control = torch.tensor([[1.0, 0.0], [0.5, 1.0]])
    filter = linear_denkf("perturbed", noisy=True, control=control)
    frames = TensorDict({"observation": torch.randn(2, 6, 2), "action": torch.randn(2, 6, 2)}, [2, 6])
    frames["observed"] = torch.ones(2, 6, 1, dtype=torch.bool)
    frames["late"] = torch.zeros(2, 6, 1, dtype=torch.int64)
    late = Refiltering(filter, {"late": ("observation", "observed")}, 2)
    given = filter.draw_noise(frames.copy())
    expected = filter.sequence(given.copy())["belief", "ensemble"]
    assert_close(late.sequence(given)["belief", "ensemble"], expected, rtol=0, atol=1e-10)
    frames["late"][:, 4] = 2
    rows = frames.unbind(1)
    window = late.start(rows[0])
    for row in rows[1:4]:
        window = late.step(window, row)
    noise = [row["noise"].clone() for row in window.rows]
    window = late.step(window, rows[4])
    assert (window.rows[1]["noise"] == noise[2]).all()
    hidden = rows[4].copy()
    hidden["observed"] = torch.zeros_like(hidden["observed"])
    again = window.beliefs[0]
    for row, reading in zip(window.rows, (rows[4], rows[3], hidden), strict=True):
        step = reading.copy().update(row.select("noise", "action")).update(again.select(*filter.carry_keys))
        again = filter.step(step)
    assert_close(window.belief["belief", "ensemble"], again["belief", "ensemble"], rtol=0, atol=1e-12)


def test_invalid_arguments_raise(float64):
    filter, frames = fused("Kalman"), arriving(readings(), PATTERNS["out of order"])
    late = {"delay": DELAY}, {"delay": DELAY, "late_key": "late"}
    twice = [fused("Kalman", joint=joint, **options) for options in late for joint in (False, True)]
    twice += [fused("ensemble", members=MEMBERS, **options) for options in late]
    for match, made, keys, lag in (
        ("lag", filter, LATE, 0),
        ("update_at_reset", filter.with_options(update_at_reset=True), LATE, DELAY),
        ("last, of its mask", filter, {"late": "second"}, DELAY),
        ("last, of its mask", filter, {"late": ("second_observed",)}, DELAY),
        ("does not read", filter, {"late": ("second", "late")}, DELAY),
        ("does not read", filter, {"late": ("third", "second_observed")}, DELAY),
        *(("late twice", each, LATE, DELAY) for each in twice),
    ):
        with pytest.raises(ValueError, match=match):
            Refiltering(made, keys, lag)
    refiltering = Refiltering(filter, LATE, DELAY)
    with pytest.raises(KeyError, match="late"):
        refiltering.sequence(frames.copy().exclude("late"))
    middle, ends = frames["is_init"].clone(), torch.zeros(B, T, 1, dtype=torch.bool)
    middle[:, 4] = ends[1, 5] = True
    flat = TensorDict({**frames[0].to_dict(), "late": frames["late"][0, :, 0]}, [T])
    for match, wrong in (
        ("cut it there", frames.copy().set("is_init", middle)),
        ("cut it there", frames.exclude("is_init").set(("next", "done"), ends)),
        (r"second_observed\.bool", frames.copy().set("second_observed", frames["second_observed"].double())),
        (r"late\.long", frames.copy().set("late", frames["late"].double())),
        (r"late\.long", frames.copy().set("late", frames["late"].bool())),
        (r"\[\*B, 1\]", flat),
    ):
        with pytest.raises(ValueError, match=match):
            refiltering.sequence(wrong)
    refiltering.sequence(frames.exclude("is_init").set(("next", "done"), torch.zeros_like(ends)))
    rows = frames.unbind(1)
    with pytest.raises(ValueError, match="is_init"):
        refiltering.step(refiltering.start(rows[0]), rows[1].copy().update({"is_init": torch.ones(B, 1).bool()}))


def test_step_accepts_a_dictionary(float64):
    filter, frames = fused("Kalman"), arriving(readings(), PATTERNS["out of order"])[0]
    refiltering = Refiltering(filter, LATE, DELAY)
    window = refiltering.start({})
    for row in frames.unbind(0)[1:]:
        window = refiltering.step(window, row.exclude("is_init").to_dict())
    expected = refiltering.sequence(frames.copy())
    assert_close(window.belief["belief", "mean"], expected["belief", "mean"][-1], rtol=0, atol=0)


def test_wrappers_around_refiltering_raise(float64):
    monitor = InnovationMonitor({"second": MonitoredSensor("info", 1)})
    refiltering = Refiltering(fused("Kalman"), LATE, DELAY)
    for wrap in (Gated, lambda filter: Monitored(filter, monitor)):
        with pytest.raises(TypeError, match="Refiltering goes outermost"):
            wrap(refiltering)


def test_two_sensors_late_in_one_row_and_a_late_entry_without_a_reading(float64):
    filter = fused("Kalman")
    frames = readings()
    for name in ("first", "second"):
        frames[f"{name}_observed"][:] = True
    order, rows = frames.clone(), frames.clone()
    late = {"first": 3, "second": 1}  # arrive at t = 7; no other reading at the times of their stamps
    for name, steps in late.items():
        rows[f"{name}_late"] = torch.zeros(B, T, 1, dtype=torch.int64)
        rows[f"{name}_late"][:, 7] = steps
        rows[name][:, 7], rows[f"{name}_observed"][:, 7 - steps] = frames[name][:, 7 - steps], False
        order[f"{name}_observed"][:, 7] = False
    # A delay without a reading changes nothing: t = 7 stays without one, t = 8 keeps its own.
    rows["first_late"][:, 9], rows["first_observed"][:, 9] = 2, False
    rows["second_late"][:, 9], rows["second_observed"][:, 9] = 1, False
    for name in late:
        order[f"{name}_observed"][:, 9] = False
    keys = {f"{name}_late": (name, f"{name}_observed") for name in late}
    for mapping in (keys, dict(reversed(keys.items()))):
        out = Refiltering(filter, mapping, DELAY).sequence(rows.clone())
        for key in BELIEF:
            assert_close(out[key][:, -1], filter.sequence(order.clone())[key][:, -1], rtol=0, atol=1e-10)
