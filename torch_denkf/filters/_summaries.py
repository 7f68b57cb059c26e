"""What follows from a belief that is carried on: mean, variance, covariance."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from tensordict import NestedKey, TensorDictBase

from torch_denkf.filters._entries import write
from torch_denkf.functional import ensemble_cov, ensemble_mean, ensemble_var, weighted_mean, weighted_var
from torch_denkf.modules._call import Entries

if TYPE_CHECKING:
    from torch_denkf.filters.base import Filter

__all__ = ["summaries", "summarise"]

_OF_ENSEMBLE = {"mean": ensemble_mean, "var": ensemble_var, "cov": ensemble_cov}
_OF_PARTICLES = {"mean": weighted_mean, "var": weighted_var}


def summarise(filter: Filter, tensordict: TensorDictBase) -> TensorDictBase:
    """See :meth:`Filter.summarise`."""
    carry = {key: tensordict.get(key) for key in filter.structure.carry}
    write(tensordict, summaries(carry, filter.structure.belief))
    return tensordict


def summaries(entries: Entries, keys: Iterable[NestedKey]) -> Entries:
    """The entries, and those of ``keys`` that are missing and follow from them.

    Args:
        entries: e.g. ``("belief", "ensemble")`` ``[*B, E, S]``, perhaps with ``("belief", "log_weight")`` ``[*B, E]``,
            or ``("belief", "mean")`` ``[*B, S]`` and ``("belief", "cov")`` ``[*B, S, S]``.
        keys: e.g. ``("belief", "mean")`` and ``("belief", "var")`` ``[*B, S]``.

    Raises:
        KeyError: if a key does not follow from what is there.
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
        else:
            raise KeyError(f"{key!r} does not follow from {list(entries)}; let the initial belief write it.")
    return out
