"""What follows from a belief that is carried on: mean, variance, covariance."""

from __future__ import annotations

from collections.abc import Iterable

from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase

from torch_denkf.functional import ensemble_mean, ensemble_var
from torch_denkf.functional.moments import ensemble_cov
from torch_denkf.functional.weighted import weighted_mean, weighted_var
from torch_denkf.modules._spaces import moments_on
from torch_denkf.submodel import Entries, Initial, role

__all__ = ["summaries"]

_OF_ENSEMBLE = {"mean": ensemble_mean, "var": ensemble_var, "cov": ensemble_cov}
_OF_PARTICLES = {"mean": weighted_mean, "var": weighted_var}


def summaries(
    belief: Iterable[NestedKey], initial: TensorDictModuleBase, entries: Entries, stored: Entries | None = None
) -> Entries:
    """The entries, and those of a belief that are missing and follow from them.

    Args:
        belief: keys of the belief.
        initial: the initial belief, which may know what follows.
        entries: e.g. ``("belief", "ensemble")`` ``[*B, E, S]``, perhaps with ``("belief", "log_weight")`` ``[*B, E]``,
            or ``("belief", "mean")`` ``[*B, S]`` and ``("belief", "cov")`` ``[*B, S, S]``.
        stored: where what does not follow is looked for.

    Raises:
        KeyError: if an entry of the belief neither follows from what is there nor is stored.
    """
    out = dict(entries)
    missing = [key for key in belief if key not in out]
    derived = role(initial, Initial).derived(out) if missing else {}
    for key in missing:
        prefix, name = key[:-1], key[-1]
        ensemble, weights = out.get((*prefix, "ensemble")), out.get((*prefix, "log_weight"))
        cov = out.get((*prefix, "cov"))
        space = role(initial, Initial).space
        if key in derived:
            out[key] = derived[key]
        elif ensemble is not None and space is not None and name in _OF_PARTICLES:
            out[key] = moments_on(space, ensemble, weights)[name == "var"]
        elif ensemble is not None and weights is not None and name in _OF_PARTICLES:
            out[key] = _OF_PARTICLES[name](ensemble, weights)
        elif ensemble is not None and weights is None and name in _OF_ENSEMBLE:
            out[key] = _OF_ENSEMBLE[name](ensemble)
        elif cov is not None and name == "var":
            out[key] = cov.diagonal(dim1=-2, dim2=-1)
        elif stored is not None and key in stored:
            out[key] = stored[key]
        else:
            raise KeyError(
                f"{key!r} does not follow from {list(entries)}: let the initial belief write it, or store it beside "
                "the belief."
            )
    return out
