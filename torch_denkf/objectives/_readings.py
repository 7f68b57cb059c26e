"""Terms of what is read of the true state: the sensor's samples, its noise, and the observation model."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_denkf.objectives._base import FilterLoss
from torch_denkf.objectives._scores import score_members


class ReadingsLoss(FilterLoss):
    """Has the terms ``sensor`` and ``observation``, for the whole filter and for parts of it."""

    def _sensor(self, tensordict, out):
        errors, mask = self._reading_errors(tensordict, out)
        # Samples have no density: what scores the state by one scores them by their CRPS.
        return score_members(errors, self.score if self.score in ("mse", "energy") else "crps"), mask

    def _observation(self, tensordict, out):
        model = self._observation_model()
        if model is None:
            raise KeyError(
                "loss_observation is of a model with an observe() method, and the filter has no observation model with "
                "one. Set the weight observation=0."
            )
        target = self._entry(tensordict, self.tensor_keys.target_observation)
        error = self._observation_error(model.observe(self._true_state(tensordict)), target)
        return error.square().mean(-1), torch.ones_like(error[..., 0], dtype=torch.bool)

    def _has(self, term: str) -> bool:
        """There is a sensor if a module writes its samples, or if the user has named where they are."""
        if term != "sensor":
            return True
        key = unravel_key(self.tensor_keys.sensor)
        return key in self.filter.out_keys or key != self._AcceptedKeys.sensor

    def _reading_errors(self, tensordict: TensorDictBase, out: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Scaled errors of the sensor's samples, ``[*B, E, O]``, and where it observed all, ``[*B]``."""
        observed = tensordict.get(self.tensor_keys.observed, None)
        target, key = self._true_observation(tensordict), self.tensor_keys.sensor
        cure = "" if key in self.filter.out_keys else "No module of the filter writes it: set the weight sensor=0.0. "
        samples = self._entry(out, key, cure)
        if samples.ndim == target.ndim:
            samples = samples.unsqueeze(-2)
        mask = torch.ones_like(target[..., 0], dtype=torch.bool) if observed is None else observed.all(-1)
        return self._observation_error(samples, target.unsqueeze(-2)), mask

    def _true_observation(self, tensordict: TensorDictBase) -> Tensor:
        key = self.tensor_keys.target_observation
        target = tensordict.get(key, None)
        if target is not None:
            return target
        model = self._observation_model()
        if model is None or any(True for _ in model.parameters()):
            why = (
                "has no observation model with an observe() method" if model is None else "learns its observation model"
            )
            raise KeyError(
                f"loss_sensor needs the true observation in {key!r}, because the filter {why}. Add the entry, rename "
                "it with set_keys(target_observation=...), or set the weight sensor=0.0."
            )
        return model.observe(self._true_state(tensordict))

    def _observation_model(self) -> TensorDictModuleBase | None:
        """The filter's model of what it observes in a state, which may be a part of its analysis."""
        parts = (part for module in self.filter.update_modules for part in module.modules())
        return next((part for part in parts if hasattr(part, "observe")), None)
