"""The training objective of an observation model alone, on true states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Unpack

from tensordict import NestedKey, TensorDictBase

from torch_denkf.filters import Filter
from torch_denkf.objectives._options import ReadingsOptions
from torch_denkf.objectives._part import PartLoss
from torch_denkf.objectives._readings import ReadingsLoss

__all__ = ["ObservationLoss"]


class ObservationLoss(PartLoss, ReadingsLoss):
    r"""Scores what a filter's observation model reads of true states, ``[*B]``.

    Its term ``loss_observation`` is the squared error of :math:`h_\psi(x_t)` against the true observation, the term of
    that name in :class:`~torch_denkf.objectives.DEnKFLoss`. The parameters of the loss are those of the model.

    Args:
        filter: the filter whose observation model is trained; a module with an ``observe()`` method.
        **options: ``observation_scale``, ``observation_angles`` and ``reduction``, see :class:`ReadingsOptions`.

    Raises:
        ValueError: if a scale is not positive, or labels have another shape.
        KeyError: if the filter has no such model, or an entry is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> loss = ObservationLoss(KalmanFilter(one, one, 3 * one, one, mean=torch.zeros(1), cov=one))
        >>> td = TensorDict({"state": torch.ones(8, 1), "target_observation": torch.ones(8, 1)}, [8])
        >>> loss(td)["loss_observation"]
        tensor(4.)
    """

    @dataclass
    class _AcceptedKeys(ReadingsLoss._AcceptedKeys):
        """The entries that the loss reads.

        Attributes:
            state: true state ``[*B, S]``; elements count where all of it is known.
            state_observed: where it is, ``[*B, 1]`` or ``[*B, S]``.
            target_observation: true observation ``[*B, O]``.
            target_observed: where it is known, ``[*B, 1]`` or ``[*B, O]``.
        """

    default_keys = _AcceptedKeys
    SCORES = ("mse",)

    def __init__(self, filter: Filter, **options: Unpack[ReadingsOptions]):
        super().__init__(filter, {"observation": 1.0}, score="mse", **options)

    def _trained(self):
        model = self._observation_model()
        return [] if model is None else [model]

    def _needed(self) -> list[NestedKey]:
        return [self.tensor_keys.state, self.tensor_keys.target_observation]

    def _run(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict
