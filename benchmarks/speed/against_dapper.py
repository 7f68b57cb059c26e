"""A cycle on Lorenz-96 against DAPPER: same truth, same observations, same scheme, about the same error."""

from __future__ import annotations

import torch

from benchmarks.speed.pairs import Row, interleave
from torch_denkf.data.lorenz96 import lorenz96_step
from torch_denkf.functional import analyse, inflate

CYCLES, SETTLED = 400, 100  # the error is averaged over the cycles after these
SCHEMES = {"perturbed": ("PertObs", 40, 1.06), "sakov": ("DEnKF", 40, 1.01)}


def our_run(scheme: str, size: int, inflation: float, truth: torch.Tensor, observations: torch.Tensor):
    """Cycles with their error and spread, both ``[cycles]``; double precision, as theirs."""
    ensemble = truth[0] + 0.03 * torch.randn(size, truth.shape[-1], dtype=truth.dtype)
    noise = torch.ones_like(truth[0])
    errors, spreads = [], []
    for state, observation in zip(truth[1:], observations, strict=True):
        ensemble = lorenz96_step(ensemble)
        ensemble = inflate(analyse(ensemble, ensemble, observation, noise, scheme=scheme).ensemble, inflation)
        errors.append((ensemble.mean(0) - state).square().mean().sqrt())
        spreads.append(ensemble.var(0).mean().sqrt())
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

        def dapper_call(theirs=theirs):
            theirs.assimilate(HMM, xx, yy)

        def our_call(scheme=scheme, size=size, inflation=inflation, ours_error=ours_error):
            with torch.no_grad():
                error, _ = our_run(scheme, size, inflation, truth, observations)
            ours_error.append(float(error[SETTLED:].mean()))

        timings = interleave({"ours": our_call, "dapper": dapper_call}, seconds=seconds, rounds=7)
        their_error = float(theirs.stats.err.rms.a[SETTLED:].mean())
        note = (
            f"E={size}, inflation {inflation}, float64; RMSE {sum(ours_error) / len(ours_error):.3f} and "
            f"{their_error:.3f}; theirs keeps errors alone (its least), ours errors and spread"
        )
        fields = {"per": len(observations), "target": 0.4, "note": note}
        out.append(timings.row(f"Lorenz-96 cycle / DAPPER {name}, E={size}", "ours", "dapper", **fields))
    return out
