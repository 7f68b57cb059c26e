"""Runs the two processes of test_sharded: each analyses its components, and leaves the results."""

from pathlib import Path

import torch
import torch.distributed as dist

from torch_denkf.deployment import ShardedEnsembleAnalysis
from torch_denkf.functional.kernels.sharded import analyse_sharded

SHARES = {"uneven": (17_500, 7_500), "blind": (25_000, 0)}  # of the observations
STATES = (15_000, 10_000)  # several tiles in each process
MEMBERS = 8


def problem(dtype=torch.float64, observations=25_000, batch=2):
    """Returns all components of a forecast, readings of noise and mask; and draws for the schemes that need any."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(batch, *shape, generator=generator, dtype=torch.float64).to(dtype)

    forecast, predicted = draw(MEMBERS, sum(STATES)), draw(MEMBERS, observations) + 1
    given = {"sensor": draw(MEMBERS, observations), "etkf": draw(observations)}
    given["sakov"] = given["perturbed"] = given["etkf"]
    noise, perturbation = draw(observations).square() + 100, draw(MEMBERS, observations)
    observed = draw(observations) > -0.5
    observed[1] = False  # in the second row nothing is observed
    return forecast, predicted, given, noise, perturbation, observed


def share(sizes, rank):
    """Returns the columns of a process."""
    return slice(sum(sizes[:rank]), sum(sizes[: rank + 1]))


def analyse_shares(rank: int, out: Path) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{out}/meeting", rank=rank, world_size=2)
    results = {}
    for dtype in (torch.float64, torch.float32):
        forecast, predicted, given, noise, perturbation, observed = problem(dtype)
        for name, sizes in SHARES.items():
            here, there = share(sizes, rank), share(STATES, rank)
            for scheme, reading in given.items():
                for masked in (False, True):
                    results[dtype, name, scheme, masked] = analyse_sharded(
                        forecast[..., there],
                        predicted[..., here],
                        reading[..., here],
                        noise[..., here],
                        scheme=scheme,
                        observed=observed[..., here] if masked else None,
                        perturbation=perturbation[..., here] if scheme == "perturbed" else None,
                    )._asdict()
    forecast, predicted, given, noise, _, observed = problem()
    here, there = share(SHARES["blind"], rank), share(STATES, rank)
    module = ShardedEnsembleAnalysis("etkf", inflation=1.1, relaxation=0.3)
    names = ("ensemble", "mean", "var", "innovation", "nis", "log_likelihood")
    parts = (forecast[..., there], *(part[..., here] for part in (predicted, given["etkf"], noise, observed)))
    results["module"] = dict(zip(names, module.compute(*parts, noise=None), strict=True))
    torch.save(results, out / f"rank_{rank}.pt")
    dist.destroy_process_group()
