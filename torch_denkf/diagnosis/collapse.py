"""Warns of ensemble collapse: a spread that is too narrow for the observations."""

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

#: Least number of readings in the second half of a sequence; the median innovation that warns, in standard deviations.
_READINGS, _FAR = 20, 4.0
#: Number of members from which spurious correlations are small.
_MANY = 100


class NarrowEnsemble(Once):
    """Warns once for each update whose median normalised innovation is far above one.

    It checks sequences without gradients. The median is robust to outliers, and the second half of the steps excludes
    the effect of a wrong initial belief.
    """

    ways = ("sequence",)

    def __call__(self, filter: Filter, record: Record) -> None:
        """Checks the innovations of each update whose diagnostics are kept."""
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
        component = f" Component {number} correlates most with state component {most}, whose spread is {spread:.2g}."
    messages.warn(
        f"narrow at {place!r}",
        f"The ensemble is too narrow for the readings {module.in_keys[2]!r} at place {place!r}: half of the "
        f"innovations exceed {float(median):.1f} predicted standard deviations.{component} {_causes(members)}",
    )


def _causes(members: Tensor | None) -> str:
    """Returns the possible causes of a narrow ensemble, each with its cure."""
    causes = [
        "The noise of these readings, or that of the motion, may be too small.",
        "Outliers, or a jump, may have displaced the belief: put a gate around the filter, Gated(filter), which "
        "rejects or down-weights outliers, and opens after patience= such readings.",
    ]
    if members is None or members.shape[-2] < _MANY:
        causes.append(
            "Spurious correlations of few members shrink the spread of unobserved components: use "
            'EnsembleAnalysis(localisation="significance").'
        )
    return " ".join(causes)
