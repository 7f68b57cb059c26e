"""What follows from a belief that is carried on: mean, variance, covariance."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensordict import TensorDictBase

from torch_denkf.filters._entries import own, write
from torch_denkf.functional import ensemble_mean, ensemble_var
from torch_denkf.functional.moments import ensemble_cov
from torch_denkf.functional.weighted import weighted_mean, weighted_var
from torch_denkf.modules._base import SubModel
from torch_denkf.modules._call import Entries

if TYPE_CHECKING:
    from torch_denkf.filters.base import Filter

__all__ = ["summaries", "summarise"]

_OF_ENSEMBLE = {"mean": ensemble_mean, "var": ensemble_var, "cov": ensemble_cov}
_OF_PARTICLES = {"mean": weighted_mean, "var": weighted_var}


def summarise(filter: Filter, tensordict: TensorDictBase) -> TensorDictBase:
    """See :meth:`Filter.summarise`."""
    belief = filter.structure.belief
    stored = {key: tensordict.get(filter.outer(key), None) for key in belief}
    stored = {key: value for key, value in stored.items() if value is not None}
    carry = {key: tensordict.get(filter.outer(key)) for key in filter.structure.carry}
    write(filter, tensordict, own(summaries(filter, carry, stored)))
    return tensordict


def summaries(filter: Filter, entries: Entries, stored: Entries | None = None) -> Entries:
    """The entries, and those of the filter's belief that are missing and follow from them.

    Args:
        filter: the filter.
        entries: e.g. ``("belief", "ensemble")`` ``[*B, E, S]``, perhaps with ``("belief", "log_weight")`` ``[*B, E]``,
            or ``("belief", "mean")`` ``[*B, S]`` and ``("belief", "cov")`` ``[*B, S, S]``.
        stored: where what does not follow is looked for.

    Raises:
        KeyError: if an entry of the belief neither follows from what is there nor is stored.
    """
    out = dict(entries)
    missing = [key for key in filter.structure.belief if key not in out]
    initial = filter.initial
    of_past = initial.of_carry(out) if missing and isinstance(initial, SubModel) else {}
    for key in missing:
        prefix, name = key[:-1], key[-1]
        ensemble, weights = out.get((*prefix, "ensemble")), out.get((*prefix, "log_weight"))
        cov = out.get((*prefix, "cov"))
        if key in of_past:
            out[key] = of_past[key]
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
