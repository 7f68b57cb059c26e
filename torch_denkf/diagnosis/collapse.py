"""What a filtered sequence tells of an ensemble that has become too narrow for its readings."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf._checks import flag_value
from torch_denkf.diagnosis.messages import Messages
from torch_denkf.filters.structure import Structure
from torch_denkf.modules._ensemble import EnsembleUpdate
from torch_denkf.running import in_sequences
from torch_denkf.submodel import Entries

__all__ = ["say_collapse"]

#: Readings of the second half of a sequence that it takes, and how far the median one lies off, in standard deviations.
_READINGS, _FAR = 20, 4.0


def say_collapse(messages: Messages, structure: Structure, outputs: Entries) -> None:
    """Warns once of each update whose readings mostly lie far outside of what the ensemble expects.

    The median is looked at, which outliers do not move, and the second half of the steps, when a wrong start is over.

    Args:
        messages: of the filter.
        structure: of the filter.
        outputs: what it wrote on ``[*B, T]``; updates whose diagnostics are not kept are not looked at.
    """
    for place, module in structure.update:
        for part in in_sequences(module):
            if isinstance(part, EnsembleUpdate):
                keys = [(part.info_prefix, name) for name in ("nis", "innovation")]
                nis, innovation = (outputs.get(structure.own_info.get(place, {}).get(key, key)) for key in keys)
                if nis is not None and innovation is not None and not nis.is_cuda:
                    _say(messages, place, part, outputs, nis, innovation)


def _say(
    messages: Messages, place: str, module: EnsembleUpdate, outputs: Entries, nis: Tensor, innovation: Tensor
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
    messages.once(
        f"narrow at {place!r}",
        f"The ensemble is too narrow for the readings {module.in_keys[2]!r} at place {place!r}: half of them lie more "
        f"than {float(median):.1f} standard deviations from what it expects.{component} Chance correlations of "
        "few members shrink what fast sensors say nothing about: take "
        'EnsembleAnalysis(localisation="significance"). Else the noise of these readings, or that of the motion, is '
        "too small.",
    )
