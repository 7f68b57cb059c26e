"""Warns where an ensemble has become too narrow for its observations."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf._checks import flag_value
from torch_denkf.diagnosis.once import Once
from torch_denkf.filters.base import Filter
from torch_denkf.filters.finish import Record
from torch_denkf.modules.ensemble import EnsembleUpdate
from torch_denkf.running import in_sequences
from torch_denkf.submodel import Entries

__all__ = ["NarrowEnsemble"]

#: Readings of the second half of a sequence that it takes, and how far the median one lies off, in standard deviations.
_READINGS, _FAR = 20, 4.0
#: Members of whom chance correlations are small.
_MANY = 100


class NarrowEnsemble(Once):
    """Warns once of each update whose observations mostly lie far outside of what the ensemble expects.

    It looks at sequences without gradients: at the median, which outliers do not move, of the second half of the
    steps, when a wrong start is over.
    """

    ways = ("sequence",)

    def __call__(self, filter: Filter, record: Record) -> None:
        """Looks at innovations; updates whose diagnostics are not kept are not looked at."""
        if torch.is_grad_enabled():
            return
        structure, outputs = filter.structure, record.written
        for place, module in structure.update:
            for part in in_sequences(module):
                if isinstance(part, EnsembleUpdate):
                    keys = [(part.info_prefix, name) for name in ("nis", "innovation")]
                    nis, innovation = (outputs.get(structure.own_info.get(place, {}).get(key, key)) for key in keys)
                    if nis is not None and innovation is not None and not nis.is_cuda:
                        _look(self, place, part, outputs, nis, innovation)


def _look(
    messages: Once, place: str, module: EnsembleUpdate, outputs: Entries, nis: Tensor, innovation: Tensor
) -> None:
    late = nis.shape[-2] // 2
    seen = (innovation != 0).sum(-1)[..., late:]
    far = torch.where(seen > 0, (nis.squeeze(-1)[..., late:] / seen).sqrt(), torch.nan)
    median = far.nanmedian()
    if not flag_value(((seen > 0).sum() >= _READINGS) & (median > _FAR)):
        return
    members, predicted = (outputs.get(key) for key in module.in_keys[:2])
    component = ""
    if members is not None and predicted is not None:
        members, predicted = (value.flatten(0, -3)[-1].double() for value in (members, predicted))  # [E, S], [E, O]
        number = int((innovation.flatten(0, -2).abs().mean(0) / predicted.std(0)).nan_to_num().argmax())
        told = torch.corrcoef(torch.cat([predicted[:, number : number + 1], members], -1).T)[0, 1:]
        most = int(told.abs().nan_to_num().argmax())
        spread = float(members.std(0)[most])
        component = f" Number {number} tells most of component {most} of the state, of standard deviation {spread:.2g}."
    messages.warn(
        f"narrow at {place!r}",
        f"The ensemble is too narrow for the readings {module.in_keys[2]!r} at place {place!r}: half of them lie more "
        f"than {float(median):.1f} standard deviations from what it expects.{component} {_causes(members)}",
    )


def _causes(members: Tensor | None) -> str:
    """Lists what makes an ensemble too narrow, and the cure of each."""
    causes = [
        "The noise of these readings, or that of the motion, may be too small.",
        "An outlier, or a jump, may have taken the belief away: put a gate around the filter, Gated(filter), which "
        "takes less of outliers, and opens after patience= such readings.",
    ]
    if members is None or members.shape[-2] < _MANY:
        causes.append(
            "Chance correlations of few members shrink what fast sensors say nothing about: take "
            'EnsembleAnalysis(localisation="significance").'
        )
    return " ".join(causes)
