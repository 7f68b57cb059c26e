"""A cycle on Lorenz-96 against DAPPER: same truth, same observations, same scheme, about the same error."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

from benchmarks.common.lorenz96 import lorenz96_step
from benchmarks.speed.pairs import Row, against
from torch_denkf.functional import analyse
from torch_denkf.functional.inflation import inflate
from torch_denkf.functional.moments import ensemble_mean, ensemble_var

CYCLES, SETTLED = 400, 100  # the error is averaged over the cycles after these
SCHEMES = {"perturbed": ("PertObs", 40, 1.06), "sakov": ("DEnKF", 40, 1.01)}


def make_cycle(scheme: str, inflation: float) -> Callable:
    """Returns a cycle of forecast, analysis and inflation, with error of the mean and spread."""

    def cycle(ensemble, state, observation, noise, draws):
        ensemble = lorenz96_step(ensemble)
        perturbation = draws if scheme == "perturbed" else None
        analysis = analyse(ensemble, ensemble, observation, noise, scheme=scheme, perturbation=perturbation).ensemble
        analysis = inflate(analysis, inflation)
        mean = ensemble_mean(analysis)
        return analysis, (mean - state).square().mean().sqrt(), ensemble_var(analysis, mean).mean().sqrt()

    return cycle


def our_run(cycle: Callable, size: int, truth: torch.Tensor, observations: torch.Tensor):
    """Runs all cycles, and returns error and spread, both ``[cycles]``; in double precision, as theirs."""
    ensemble = truth[0] + 0.03 * torch.randn(size, truth.shape[-1], dtype=truth.dtype)
    noise = torch.ones_like(truth[0])
    draws = torch.randn(len(observations), *ensemble.shape, dtype=truth.dtype)
    errors, spreads = [], []
    for now in zip(truth[1:].unbind(), observations.unbind(), draws.unbind(), strict=True):
        ensemble, error, spread = cycle(ensemble, *now[:2], noise, now[2])
        errors.append(error)
        spreads.append(spread)
    return torch.stack(errors), torch.stack(spreads)


def rows(seconds: float) -> list[Row]:
    import dapper.da_methods as methods
    import numpy as np
    from dapper.dpr_config import rc
    from dapper.mods.Lorenz96.sakov2008 import HMM
    from dapper.tools import progressbar
    from dapper.tools.seeding import set_seed

    progressbar.disable_progbar = True
    rc.comps["error_only"] = True
    HMM.tseq.Ko = CYCLES - 1
    set_seed(3)
    xx, yy = HMM.simulate()
    truth, observations = torch.from_numpy(np.asarray(xx)), torch.from_numpy(np.stack(list(yy)))
    out = []
    for scheme, (name, size, inflation) in SCHEMES.items():
        theirs, ours_error = methods.EnKF(name, N=size, infl=inflation), []
        cycles = {"eager": make_cycle(scheme, inflation)}
        if os.environ.get("SPEED_COMPILE") != "0":
            cycles["compiled"] = torch.compile(
                make_cycle(scheme, inflation), fullgraph=True, dynamic=False, options={"cpp_wrapper": True}
            )

        def dapper_call(theirs=theirs):
            theirs.assimilate(HMM, xx, yy)

        def our_call(cycle, size=size, ours_error=ours_error):
            with torch.no_grad():
                error, _ = our_run(cycle, size, truth, observations)
            ours_error.append(float(error[SETTLED:].mean()))

        candidates = {kind: partial(our_call, cycle) for kind, cycle in cycles.items()}
        title, how = f"Lorenz-96 cycle / DAPPER {name}, E={size}", {"seconds": seconds, "rounds": 7}
        found = against(candidates, "dapper", dapper_call, title, how=how, per=len(observations), target=0.4)
        their_error = float(theirs.stats.err.rms.a[SETTLED:].mean())
        note = (
            f"E={size}, inflation {inflation}, float64; RMSE {sum(ours_error) / len(ours_error):.3f} and "
            f"{their_error:.3f}; theirs keeps errors alone (its least), ours errors and spread"
        )
        out += [replace(row, note=note) for row in found]
    return out
