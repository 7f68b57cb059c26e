"""Two processes that hold half of the columns each, against one that holds all of them."""

import pytest
import torch
from torch.multiprocessing import start_processes

from tests.functional.kernels.two_shards import SHARES, analyse_shares, problem
from torch_denkf.functional import analyse
from torch_denkf.modules import EnsembleAnalysis

# Sums in another order. The forecast's members reach 5, where single precision has steps of 5e-7: ten of them.
TOLERANCE = {torch.float64: 1e-12, torch.float32: 5e-6}


@pytest.fixture(scope="module")
def ranks(tmp_path_factory):
    out = tmp_path_factory.mktemp("shards")
    start_processes(analyse_shares, (out,), nprocs=2, start_method="fork")
    return [torch.load(out / f"rank_{rank}.pt", weights_only=False) for rank in (0, 1)]


def joined(ranks, case):
    """Returns the processes' columns side by side; what all of them hold, once."""
    first, second = (rank[case] for rank in ranks)
    columns = ("ensemble", "innovation", "mean", "var")
    for name in first.keys() - set(columns):
        assert torch.equal(first[name], second[name])
    return {key: torch.cat([first[key], second[key]], -1) if key in columns else first[key] for key in first}


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
@pytest.mark.parametrize("name", SHARES)
def test_two_processes_are_one(ranks, name, dtype):
    forecast, predicted, given, noise, perturbation, observed = problem(dtype)
    for scheme, reading in given.items():
        for masked in (False, True):
            extra = {"perturbation": perturbation} if scheme == "perturbed" else {}
            mask = observed if masked else None
            whole = analyse(
                forecast, predicted, reading, noise, scheme=scheme, observed=mask, space="ensemble", **extra
            )
            found = joined(ranks, (dtype, name, scheme, masked))
            for key, value in whole._asdict().items():
                scale = float(value.abs().max().clamp_min(1))
                torch.testing.assert_close(found[key], value, rtol=0, atol=TOLERANCE[dtype] * scale)
            assert not torch.allclose(found["ensemble"][0], forecast[0], atol=1e-3)


def test_the_module_inflates_where_another_process_observes(ranks):
    forecast, predicted, given, noise, _, observed = problem()
    whole = EnsembleAnalysis("etkf", inflation=1.1, relaxation=0.3)
    expected = whole.compute(forecast, predicted, given["etkf"], noise, observed, noise=None)
    for key, value in zip(joined(ranks, "module").items(), expected, strict=True):
        torch.testing.assert_close(key[1], value, rtol=1e-9, atol=1e-12)
