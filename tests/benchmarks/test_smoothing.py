"""The study's systems and its tables: an independent integration, seeds that stand alone, rows that meet."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from benchmarks.smoothing.cases import CASES
from benchmarks.smoothing.ours import rows
from benchmarks.smoothing.systems import SYSTEMS, Cycle, lorenz63_step, simulate


def test_lorenz63_is_the_solution_of_its_equations(float64):
    start = np.array([1.509, -1.531, 25.46])

    def tendency(_, state):
        x, y, z = state
        return [10 * (y - x), x * (28 - z) - y, x * y - 8 / 3 * z]

    exact = solve_ivp(tendency, (0, 0.25), start, rtol=1e-11, atol=1e-11).y[:, -1]
    state = torch.from_numpy(start)
    for _ in range(25):
        state = lorenz63_step(state)
    np.testing.assert_allclose(state.numpy(), exact, atol=1e-4)  # the fourth power of a step of 0.01, times 25


@pytest.mark.parametrize("name", SYSTEMS)
def test_truth_and_readings(float64, name):
    system = SYSTEMS[name]
    path, readings = simulate(system, [0, 3], 40)
    alone = simulate(system, [3], 40)
    assert path[1:].equal(alone[0])
    assert readings[1:].equal(alone[1]), "a seed's run does not depend on the others"
    assert path.shape[:2] == (2, 40 * system.steps + 1)
    ends = path[:, :: system.steps]
    torch.testing.assert_close(Cycle(system).compute(ends[:, :-1]), ends[:, 1:])
    errors = readings - ends[:, 1:]
    assert errors.var() == pytest.approx(system.noise, rel=5 * (2 / errors.numel()) ** 0.5)


def test_a_smoother_is_better_than_its_filter(float64):
    case = next(case for case in CASES if case.name == "lorenz63-EnKS-5")
    for row in rows(case, [0, 1], 60):
        assert row["rmse_smoother"] < 0.8 * row["rmse_filter"] < 1.2
