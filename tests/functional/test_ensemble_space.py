"""Large states: tiles against the dense solution in observation space, single against double precision, memory."""

import pytest
import torch

from torch_denkf.functional import _ensemble_space, analyse
from torch_denkf.functional.inflation import random_rotation

SCHEMES = ["sensor", "perturbed", "etkf", "sakov"]
EXACT = {"rtol": 1e-9, "atol": 1e-9}


def problem(scheme, size, dim, count, batch=(), noise=0.3, dtype=torch.float64):
    """Returns arguments of analyse: neighbours in the state are correlated, the observation is off by about one."""
    generator = torch.Generator().manual_seed(0)

    def randn(*shape):
        return torch.randn(*batch, *shape, generator=generator, dtype=torch.float32).to(dtype)

    forecast = 1 + randn(size, dim)
    predicted = forecast[..., :count].clone() if dim >= count else 1 + randn(size, count)
    observation = 1 + randn(1, count) + noise**0.5 * randn(size, count)
    arguments = {
        "forecast": forecast,
        "predicted": predicted,
        "observation": observation if scheme == "sensor" else observation[..., 0, :],
        "noise": noise * (0.5 + randn(count).square()),
        "scheme": scheme,
    }
    if scheme == "perturbed":
        arguments["perturbation"] = randn(size, count)
    if scheme == "etkf":
        arguments["rotation"] = random_rotation(size, batch, generator=generator, dtype=dtype)
    return arguments


@pytest.fixture
def small_tiles(monkeypatch):
    """Tiles of 64 columns of 6 members (x 2 in a batch)."""
    calls = []
    analyse_in_tiles = _ensemble_space.analyse_in_tiles

    def counted(*args, **kwargs):
        calls.append(kwargs["columns"])
        return analyse_in_tiles(*args, **kwargs)

    monkeypatch.setattr("torch_denkf.functional.analysis.analyse_in_tiles", counted)
    monkeypatch.setattr(_ensemble_space, "TILE_ELEMENTS", 64 * 6 * 2)
    return calls


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize(("dim", "count"), [(300, 300), (300, 70), (7, 290)])
@pytest.mark.parametrize("masked", [None, "one", "each", "nothing"])
def test_tiles_give_the_dense_solution(small_tiles, scheme, dim, count, masked):
    arguments = problem(scheme, 6, dim, count, batch=(2,))
    if masked is not None:
        observed = torch.rand(2, count) < 0.7
        observed = {"one": observed[:, :1] | True, "each": observed, "nothing": torch.zeros(2, 1) > 0}[masked]
        arguments["observed"] = observed
        hidden = ~observed.expand(2, count)
        arguments["noise"] = arguments["noise"].masked_fill(hidden, torch.nan)
        if scheme != "sensor":
            arguments["observation"] = arguments["observation"].masked_fill(hidden, torch.nan)
    tiled = analyse(**arguments)
    assert small_tiles == [64]
    dense = analyse(**arguments, space="observation")
    assert len(small_tiles) == 1
    for name in tiled._fields:
        torch.testing.assert_close(getattr(tiled, name), getattr(dense, name), **EXACT)


def test_perturbations_are_drawn_tile_by_tile(small_tiles):
    arguments = problem("perturbed", 12, 500, 500)
    torch.manual_seed(1)
    found = analyse(**{**arguments, "perturbation": None})
    torch.manual_seed(1)
    draws = torch.cat([torch.randn(12, len(part), dtype=torch.float64) for part in torch.arange(500).split(64)], -1)
    expected = analyse(**{**arguments, "perturbation": draws}, space="observation")
    assert small_tiles == [64]
    torch.testing.assert_close(found.ensemble, expected.ensemble, **EXACT)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("count", [10, 100, 5000])  # observation space; ensemble space, whole and in tiles
@pytest.mark.parametrize("noise", [1e-5, 1e-7])
def test_single_precision_keeps_its_digits(scheme, count, noise):
    """Relative error of the increment; measured 4e-7 at most, where the larger system loses all digits."""
    arguments = problem(scheme, 32, count, count, noise=noise, dtype=torch.float32)
    double = {name: value.double() if torch.is_tensor(value) else value for name, value in arguments.items()}
    space = "observation" if count == 10 else "ensemble"
    expected = analyse(**double, space=space).ensemble - double["forecast"]
    found = analyse(**arguments).ensemble
    assert found.dtype == torch.float32
    found = found.double() - double["forecast"]
    assert (found - expected).norm() / expected.norm() < 1.5e-6
