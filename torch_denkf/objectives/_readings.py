"""Terms of what is read of the true state: the sensor's samples, its noise, and the observation model."""

from __future__ import annotations

from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_denkf.objectives._base import FilterLoss
from torch_denkf.objectives._labels import Labels, check_row_mask
from torch_denkf.objectives._scores import mean_of, score_members


class ReadingsLoss(FilterLoss):
    """Has the terms ``sensor`` and ``observation``, for the whole filter and for parts of it."""

    def _sensor(self, tensordict, out):
        samples, labels = self._samples(tensordict, out)
        # Samples have no density: what scores the state by one scores them by their CRPS.
        score = self.score if self.score in ("mse", "energy") else "crps"
        return score_members(labels.errors(samples, self.observation_angles), labels.mask, score), labels.rows

    def _observation(self, tensordict, out):
        model = self._observation_model()
        if model is None:
            raise KeyError(
                "loss_observation is of a model with an observe() method, and the filter has no observation model with "
                "one. Set the weight observation=0."
            )
        state = self._whole_state(tensordict, out)
        observation = model.observe(state.values)
        target = self._entry(tensordict, self.tensor_keys.target_observation)
        labels = self._observation_labels(tensordict, target, observation.shape[-1])
        labels = labels._replace(mask=labels.mask & state.mask)
        return mean_of(labels.errors(observation, self.observation_angles).square(), labels.mask), labels.rows

    def _has(self, term: str) -> bool:
        """There is a sensor if a module writes its samples, or if the user has named where they are."""
        if term != "sensor":
            return True
        key = unravel_key(self.tensor_keys.sensor)
        return key in self._written or key != self._AcceptedKeys.sensor

    def _samples(self, tensordict: TensorDictBase, out: TensorDictBase) -> tuple[Tensor, Labels]:
        """The sensor's samples ``[*B, E, O]``, and what they should be where it observed all."""
        key = self.tensor_keys.sensor
        cure = "" if key in self._written else "No module of the filter writes it: set the weight sensor=0.0. "
        target, samples = self._true_observation(tensordict, out), self._entry(out, key, cure)
        if samples.ndim == tensordict.ndim + 1:
            samples = samples.unsqueeze(-2)
        labels = self._observation_labels(tensordict, target, samples.shape[-1])
        observed = tensordict.get(self.tensor_keys.observed, None)
        if observed is not None:
            check_row_mask(self.tensor_keys.observed, observed, labels.values)
            labels = labels._replace(mask=labels.mask & observed.all(-1, keepdim=True))
        return samples, labels

    def _true_observation(self, tensordict: TensorDictBase, out: TensorDictBase) -> Tensor:
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
        given = self._entry(tensordict, self.tensor_keys.state).shape[-1]
        size = max(self._state_dim(out) or 0, given, 1 + max(self.dims or [0]))
        # What the model makes of NaN is NaN: no label.
        return model.observe(self._true_state(tensordict, size)[0])

    def _observation_model(self) -> TensorDictModuleBase | None:
        """The filter's model of what it observes in a state, which may be a part of its analysis."""
        parts = (part for module in self.filter.update_modules for part in module.modules())
        return next((part for part in parts if hasattr(part, "observe")), None)
