"""Oracle: finite differences."""

import pytest

from tests.filters.differences_for_tests import check_largest_gradients
from tests.filters.particle_for_tests import toy_filter
from tests.objectives.problem_for_tests import problem
from torch_denkf.objectives import MixtureLoss


@pytest.fixture(autouse=True)
def _double(float64):
    return


def test_far_from_all_particles_there_is_still_a_gradient():
    filter = toy_filter()
    frames, _ = problem(filter)
    frames["state"] = frames["state"] + 1e3  # the density itself is zero in floating point
    loss = MixtureLoss(filter, component_std=0.1)(frames)["loss_state"]
    loss.backward()
    grads = [p.grad for p in filter.parameters() if p.grad is not None]
    assert loss.isfinite()
    assert all(grad.isfinite().all() for grad in grads)
    assert sum(grad.abs().sum() for grad in grads) > 1


@pytest.mark.parametrize("scheme", ["soft", "transport"])
@pytest.mark.parametrize("score", ["mixture", "crps"])
def test_gradient_by_finite_differences(scheme, score):
    filter = toy_filter(scheme, learned=True)
    frames, _ = problem(filter, batch=(2, 5))
    loss = MixtureLoss(filter, score=score, mean=0.3, component_std=0.5)
    sum(loss(frames).values()).backward()
    parts = [filter[name] for name in ("observation", "likelihood", "transition")]
    # A jump, a particle picked again within 1e-6, would show as a difference of order 1e5.
    assert check_largest_gradients(parts, lambda: sum(loss(frames).values()), rtol=1e-4, atol=1e-8) >= 6


def test_gradients_reach_the_likelihood_through_hard_resampling():
    # In each step the belief holds all particles with the weights of that step's reading.
    filter = toy_filter("systematic", learned=True)
    frames, _ = problem(filter, resets=False, masks=0)
    MixtureLoss(filter)(frames)["loss_state"].backward()
    for name in ("likelihood", "observation", "transition"):
        assert sum(p.grad.abs().sum() for p in filter[name].parameters() if p.grad is not None) > 1e-6, name
