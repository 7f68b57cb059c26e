"""Runs DAPPER, if it is installed, on the same truth and the same readings."""

from __future__ import annotations

import importlib.util

import torch

from benchmarks.smoothing.cases import Case
from benchmarks.smoothing.systems import SYSTEMS, simulate


def installed() -> bool:
    """Returns whether DAPPER is installed."""
    return importlib.util.find_spec("dapper") is not None


def rows(case: Case, seed: int, cycles: int) -> list[dict]:
    """Returns DAPPER's row for one seed."""
    import dapper.da_methods as methods
    import dapper.mods as modelling
    from dapper.dpr_config import rc
    from dapper.mods.Lorenz63.sakov2012 import HMM as LORENZ63
    from dapper.mods.Lorenz96.raanes2016 import HMM as LORENZ96
    from dapper.tools import progressbar
    from dapper.tools.seeding import set_seed

    progressbar.disable_progbar = True
    rc.comps["error_only"] = True
    system = SYSTEMS[case.system]
    path, readings = simulate(system, [seed], cycles)
    burn_in = system.counts_from(cycles)
    model = {"lorenz63": LORENZ63, "lorenz96": LORENZ96}[case.system].copy()
    model.tseq = modelling.Chronology(0.01, dko=system.steps, Ko=cycles - 1, BurnIn=0)
    update, tuning = {"perturbed": "PertObs", "etkf": "Sqrt"}[case.scheme], {"infl": case.inflation}
    members = {"N": case.ensemble_size}
    if case.method == "EnKS":
        method = methods.EnKS(update, Lag=case.lag, **members, **tuning)
    elif case.method == "EnRTS":
        # DAPPER's own settings of Lorenz-96 multiply each of the many small steps' gains by 0.99.
        method = methods.EnRTS(update, DeCorr=0.99 if case.system == "lorenz96" else 1.0, **members, **tuning)
    elif case.method == "IEnKS":
        method = methods.iEnKS("Sqrt", rot=True, **members, **tuning)
    else:  # with the tuning that DAPPER suggests for it
        method = methods.PartFilt(reg=0.9, NER=case.ess_threshold, **members)
    set_seed(1000 + seed)
    method.assimilate(model, path[0].numpy(), readings[0].numpy())
    error, row = method.stats.err.rms, {**case.labels(), "seed": seed}
    row["dapper_rmse_filter"] = float(torch.as_tensor(error.a)[burn_in:].mean())
    if case.method != "particles":
        row["dapper_rmse_smoother"] = float(torch.as_tensor(error.s)[burn_in : cycles - (case.lag or 0)].mean())
    return [row]
