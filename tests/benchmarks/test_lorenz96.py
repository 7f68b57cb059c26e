"""Oracles: the formula index by index, its conservation law, and the integrator's order."""

from itertools import pairwise

import torch

from benchmarks.common.lorenz96 import lorenz96_step, lorenz96_tendency


def random_state(*shape):
    return 3 * torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_tendency_is_the_formula():
    x, n = random_state(2, 7), 7
    for i in range(n):
        expected = (x[:, (i + 1) % n] - x[:, i - 2]) * x[:, i - 1] - x[:, i] + 5
        torch.testing.assert_close(lorenz96_tendency(x, 5.0)[:, i], expected)


def test_advection_conserves_energy():
    # d/dt 1/2 Σ x² = Σ x (advection) + Σ x (F - x), and the quadratic advection adds nothing to it.
    state = random_state(3, 40)
    advection = lorenz96_tendency(state, forcing=0.0) + state
    # Forty terms of size up to 1e3 in double precision.
    assert (state * advection).sum(-1).abs().max() < 1e-10


def test_step_is_of_fourth_order():
    start = random_state(40)

    def integrate(steps):
        state = start
        for _ in range(steps):
            state = lorenz96_step(state, dt=0.4 / steps)
        return state

    exact = integrate(1024)
    errors = [(integrate(steps) - exact).norm().item() for steps in (32, 64, 128)]
    # Halving the step divides the error by 2⁴, up to the next order in dt.
    for coarse, fine in pairwise(errors):
        assert 14 < coarse / fine < 18
