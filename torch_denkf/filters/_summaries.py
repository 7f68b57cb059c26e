"""What follows from a belief that is carried on: mean, variance, covariance."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from tensordict import NestedKey, TensorDictBase

from torch_denkf.filters._entries import own, write
from torch_denkf.functional import ensemble_cov, ensemble_mean, ensemble_var, weighted_mean, weighted_var
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
    write(filter, tensordict, own(summaries(carry, belief, stored)))
    return tensordict


def summaries(entries: Entries, keys: Iterable[NestedKey], stored: Entries | None = None) -> Entries:
    """The entries, and those of ``keys`` that are missing and follow from them.

    Args:
        entries: e.g. ``("belief", "ensemble")`` ``[*B, E, S]``, perhaps with ``("belief", "log_weight")`` ``[*B, E]``,
            or ``("belief", "mean")`` ``[*B, S]`` and ``("belief", "cov")`` ``[*B, S, S]``.
        keys: e.g. ``("belief", "mean")`` and ``("belief", "var")`` ``[*B, S]``.
        stored: where what does not follow is looked for, such as what was smoothed.

    Raises:
        KeyError: if a key neither follows from what is there nor is stored.
    """
    out = dict(entries)
    for key in keys:
        if key in out:
            continue
        prefix, name = key[:-1], key[-1]
        ensemble, weights = out.get((*prefix, "ensemble")), out.get((*prefix, "log_weight"))
        cov = out.get((*prefix, "cov"))
        if ensemble is not None and weights is not None and name in _OF_PARTICLES:
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
