"""Oracles: steps against sequences, the filter of the remaining dimensions, gradients by finite differences."""

import math

import pytest
import torch
from tensordict import TensorDict

from tests.filters.differences_for_tests import check_largest_gradients
from tests.filters.factories import assert_equal, random_draws, toy_frames
from tests.filters.particle_for_tests import BELIEF, SCHEMES, E, bootstrap, toy_filter


@pytest.mark.parametrize("scheme", SCHEMES)
def test_resets_start_from_equal_weights(float64, scheme):
    filter = random_draws(toy_filter(scheme))
    frames = filter.draw_noise(toy_frames((3, 12)))
    out = filter.sequence(frames.copy())
    start = frames["is_init"].squeeze(-1)
    for key in ("belief", "forecast"):
        assert (out[key, "log_weight"][start] == -math.log(E)).all()
        assert out[key, "ensemble"][start].equal(frames["noise", "initial.initial"][start])
    updated = ~start & frames["observed"].squeeze(-1)
    assert updated.any()
    assert (out["belief", "log_weight"].std(-1)[updated] > 1e-3).all()
    # A reset forgets: what follows equals a sequence that begins there.
    row, time = (start & (torch.arange(12) > 0)).nonzero()[0].tolist()
    tail = filter.sequence(frames[row : row + 1, time:].copy())
    assert_equal(tail[0], out[row, time:], BELIEF, atol=1e-12)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("learned", [False, True])
def test_missing_frames_are_pure_prediction(float64, scheme, learned):
    filter = toy_filter(scheme, learned)
    frames = toy_frames((2, 6), resets=False, masks=0)
    frames["observed"] = torch.ones(2, 6, 1, dtype=torch.bool)
    frames["observed"][:, 2:5] = False
    frames["measurement"][:, 2:5] = torch.nan
    out = filter.sequence(frames)
    assert all(out[key].isfinite().all() for key in BELIEF)
    assert out["belief", "ensemble"].equal(out["forecast", "ensemble"])
    for t in (2, 3, 4):
        assert out["belief", "log_weight"][:, t].equal(out["belief", "log_weight"][:, 1]), "weights stay"
    assert (out["info", "log_likelihood"][:, 2:5] == 0).all()
    assert not out["forecast", "log_weight"][:, 1].equal(out["belief", "log_weight"][:, 1])
    assert not out["belief", "log_weight"][:, 5].equal(out["belief", "log_weight"][:, 4])
    out["belief", "mean"].square().sum().backward()
    grads = [p.grad for p in filter.parameters() if p.grad is not None]
    assert all(grad.isfinite().all() for grad in grads)


@pytest.mark.parametrize("scheme", ["systematic", "soft", "transport"])
def test_resampling_uses_a_mask_of_another_name(float64, scheme):
    frames = TensorDict({"observation": torch.randn(3, 8, 2)}, [3, 8])
    frames["observed"] = torch.rand(3, 8, 1) < 0.6
    frames["observed"][:, 3:5], frames["observed"][:, 2] = False, True
    usual = bootstrap(20, resampling=scheme)
    frames = usual.draw_noise(frames)
    expected = usual.sequence(frames.copy())
    renamed = bootstrap(20, resampling=scheme, observed_key=("camera", "seen"))
    frames["camera", "seen"] = frames["observed"]
    found = renamed.sequence(frames.exclude("observed"))
    keys = [*BELIEF, ("forecast", "log_weight"), ("forecast", "ensemble")]
    assert_equal(found, expected, keys)
    for t in (3, 4):
        assert found["forecast", "log_weight"][:, t].equal(found["belief", "log_weight"][:, t - 1]), "not resampled"
    assert found["forecast", "log_weight"][:, 2].std() < found["belief", "log_weight"][:, 2].std()


# ------------------------------------------------------------------------------------------------- gradients


@pytest.mark.parametrize("scheme", ["systematic", "soft", "transport"])
def test_gradient_flow(float64, scheme):
    filter = toy_filter(scheme)
    frames = filter.draw_noise(toy_frames((2, 6), resets=False, masks=0))
    frames["measurement"].requires_grad_()
    out = filter.sequence(frames.copy())
    (grad,) = torch.autograd.grad(out["belief", "mean"][:, 4].sum(), frames["measurement"], retain_graph=True)
    size = grad.abs().sum((0, 2))
    assert (size[[0, 5]] == 0).all()
    assert size[4] > 0
    # Hard resampling ends the gradient at the step, the others let it through to the first update.
    assert (size[1:4] == 0).all() if scheme == "systematic" else (size[1:4] > 0).all()
    out["belief", "mean"].square().sum().backward()
    for name in ("transition", "sensor", "observation", "noise"):
        grads = [p.grad for p in filter[name].parameters() if p.grad is not None]
        assert all(grad.isfinite().all() for grad in grads), name
        assert sum(grad.abs().sum() for grad in grads) > 0, name


def test_gradient_through_a_sequence_by_finite_differences(float64):
    filter = toy_filter("soft")
    frames = filter.draw_noise(toy_frames((2, 5), masks=0, resets=False))
    loss = lambda: filter.sequence(frames.copy())["belief", "mean"].square().sum()  # noqa: E731
    loss().backward()
    parts = [filter[name] for name in ("transition", "observation", "noise")]
    # A particle that is picked again within 1e-6 would show as a difference of order 1e6.
    assert check_largest_gradients(parts, loss, rtol=1e-5, atol=1e-7) >= 8
