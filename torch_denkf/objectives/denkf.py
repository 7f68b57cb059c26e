"""The training objective of ensemble filters on sequences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import dispatch
from torchrl.objectives import LossModule

from torch_denkf.filters import Filter
from torch_denkf.functional import crps_ensemble, energy_score
from torch_denkf.modules import StochasticMLP

__all__ = ["DEnKFLoss"]


class DEnKFLoss(LossModule):
    r"""Scores a filter on sequences ``[*B, T]`` against the true states.

    The default score of an ensemble is the fair CRPS, a proper score: it teaches the mean *and* the spread. The
    paper's loss, the squared error of the mean, says nothing about the spread, and a filter with a wrong spread can
    be worse than its own sensor. ``DEnKFLoss.paper(filter)`` is the paper's.

    ========================  =====================================================================================
    ``loss_state``            score of the belief, :math:`X_{t|t}` against :math:`x_t`
    ``loss_transition``       score of the forecast, :math:`X_{t|t-1}` against :math:`x_t` (the paper's
                              :math:`L_{f_\theta}`)
    ``loss_sensor``           score of the sensor's samples against the true observation (:math:`L_{s_\xi}`)
    ``loss_observation``      squared error of :math:`h_\psi(x_t)` against the true observation
    ``loss_nll``              negative log-likelihood of the innovation, nats; needs no true state
    ``loss_kl``               KL divergence of flipout weights from their prior, nats
    ========================  =====================================================================================

    Terms with weight zero are neither computed nor returned; the others are returned with their weight applied, so
    that their sum is the objective. Only elements that were stepped to count for state, transition and nll: the first
    of a sequence and those with ``is_init`` hold an initial belief. The sensor counts where it observed.

    Args:
        filter: the filter to train; its parameters are the loss's.
        score: ``"crps"`` (fair), ``"energy"`` (fair energy score, multivariate) or ``"mse"`` (of the mean).
        state: weight of ``loss_state``.
        transition: weight of ``loss_transition``.
        sensor: weight of ``loss_sensor``.
        observation: weight of ``loss_observation``.
        nll: weight of ``loss_nll``.
        kl: weight of ``loss_kl``.
        state_scale: ``[S]``; errors of the state are divided by it, so that dimensions with different units count
            alike. A dimension with infinite scale does not count.
        observation_scale: ``[O]``, likewise.
        angles: state dimensions that are angles in radians; their errors are wrapped to [-pi, pi).
        detach_every: truncated back-propagation: steps after which the belief is detached.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (``[*B, T]``, zero where an element does not count).

    Raises:
        ValueError: on an unknown score.
        KeyError: if an entry that a term needs is missing.

    Reference:
        Fair CRPS: Ferro, "Fair scores for ensemble forecasts", Q. J. R. Meteorol. Soc. 140, 2014.

    Example:
        >>> from torch_denkf.filters import DEnKF
        >>> loss = DEnKFLoss(DEnKF.paper(5, 2, ensemble_size=4), sensor=0.0)
        >>> batch = TensorDict({"pixels": torch.rand(2, 3, 6, 50, 150), "state": torch.randn(2, 3, 5)}, [2, 3])
        >>> sorted(loss(batch).keys())
        ['loss_state', 'loss_transition']
    """

    @dataclass
    class _AcceptedKeys:
        """The entries that the loss reads.

        Attributes:
            state: true state ``[*B, T, S]``.
            target_observation: true observation ``[*B, T, O]``; where it is missing and the filter's observation
                model has no parameters, it is that model's observation of the true state.
            observed: mask ``[*B, T, 1]`` or ``[*B, T, O]``.
            belief: ensemble of the belief.
            forecast: ensemble of the forecast.
            sensor: the sensor's samples.
            log_likelihood: of the innovation.
        """

        state: NestedKey = "state"
        target_observation: NestedKey = "target_observation"
        observed: NestedKey = "observed"
        belief: NestedKey = ("belief", "ensemble")
        forecast: NestedKey = ("forecast", "ensemble")
        sensor: NestedKey = ("sensor", "ensemble")
        log_likelihood: NestedKey = ("info", "log_likelihood")

    default_keys = _AcceptedKeys
    TERMS = ("state", "transition", "sensor", "observation", "nll", "kl")

    def __init__(
        self,
        filter: Filter,
        *,
        score: Literal["crps", "energy", "mse"] = "crps",
        state: float = 1.0,
        transition: float = 1.0,
        sensor: float = 1.0,
        observation: float = 0.0,
        nll: float = 0.0,
        kl: float = 0.0,
        state_scale: Sequence[float] | torch.Tensor | None = None,
        observation_scale: Sequence[float] | torch.Tensor | None = None,
        angles: Sequence[int] = (),
        detach_every: int | None = None,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ):
        if score not in ("crps", "energy", "mse"):
            raise ValueError(f'score is "crps", "energy" or "mse"; got {score!r}.')
        super().__init__()
        self.filter, self.score, self.reduction = filter, score, reduction
        weights = dict(zip(self.TERMS, (state, transition, sensor, observation, nll, kl), strict=True))
        self.weights = {name: weight for name, weight in weights.items() if weight}
        self.angles, self.detach_every = list(angles), detach_every
        dtype = torch.get_default_dtype()
        for name, scale in (("state_scale", state_scale), ("observation_scale", observation_scale)):
            self.register_buffer(name, None if scale is None else torch.as_tensor(scale, dtype=dtype))
        self.out_keys = [f"loss_{name}" for name in self.weights]

    @classmethod
    def paper(cls, filter: Filter, **kwargs) -> DEnKFLoss:
        """The paper's loss: squared errors of the means of belief, forecast and sensor, equally weighted."""
        return cls(filter, **{"score": "mse", **kwargs})

    @property
    def functional(self) -> bool:
        """The filter keeps its parameters."""
        return False

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the filter reads beside its belief, and the true state."""
        reads = [key for key in map(unravel_key, self.filter.in_keys) if key not in self.filter.carry_keys]
        needs_state = not {"state", "transition", "sensor", "observation"}.isdisjoint(self.weights)
        return reads + [self.tensor_keys.state] * needs_state

    @in_keys.setter
    def in_keys(self, value) -> None:
        raise AttributeError("in_keys follow from the filter; rename the state with set_keys(state=...).")

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        pass

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Filters the sequence and returns the weighted terms; ``tensordict`` is left as it is."""
        out = self.filter.sequence(tensordict.copy(), detach_every=self.detach_every)
        counts = self._stepped(tensordict)
        losses = TensorDict({}, batch_size=[])
        for name, weight in self.weights.items():
            if name == "kl":
                losses["loss_kl"] = weight * self._kl()
                continue
            term, mask = getattr(self, f"_{name}")(tensordict, out)
            mask = counts if mask is None else mask
            losses[f"loss_{name}"] = weight * self._reduce_term(term, mask, tensordict)
        return losses

    # ------------------------------------------------------------------------------- terms: value and mask [*B, T]

    def _state(self, tensordict, out):
        return self._score(out, self.tensor_keys.belief, self._true_state(tensordict), "state"), None

    def _transition(self, tensordict, out):
        return self._score(out, self.tensor_keys.forecast, self._true_state(tensordict), "state"), None

    def _sensor(self, tensordict, out):
        observed = tensordict.get(self.tensor_keys.observed, None)
        target = self._true_observation(tensordict)
        mask = torch.ones_like(target[..., 0], dtype=torch.bool) if observed is None else observed.all(-1)
        return self._score(out, self.tensor_keys.sensor, target, "observation"), mask

    def _observation(self, tensordict, out):
        model = self._observation_model()
        error = model.observe(self._true_state(tensordict)) - self._entry(
            tensordict, self.tensor_keys.target_observation
        )
        error = error if self.observation_scale is None else error / self.observation_scale
        return error.square().mean(-1), torch.ones_like(error[..., 0], dtype=torch.bool)

    def _nll(self, tensordict, out):
        return -self._entry(out, self.tensor_keys.log_likelihood).squeeze(-1), None

    def _kl(self) -> torch.Tensor:
        return sum(part.kl() for part in self.filter.modules() if isinstance(part, StochasticMLP))

    # ------------------------------------------------------------------------------------------------------ helpers

    def _score(self, out: TensorDictBase, key: NestedKey, target: torch.Tensor, kind: str) -> torch.Tensor:
        errors = self._entry(out, key) - target.unsqueeze(-2)
        if kind == "state" and self.angles:
            wrapped = torch.remainder(errors + pi, 2 * pi) - pi
            is_angle = torch.zeros(errors.shape[-1], dtype=torch.bool, device=errors.device)
            is_angle[self.angles] = True
            errors = torch.where(is_angle, wrapped, errors)
        scale = self.state_scale if kind == "state" else self.observation_scale
        if scale is not None:
            errors = errors / scale
        zero = torch.zeros_like(errors[..., 0, :])
        if self.score == "mse":
            return errors.mean(-2).square().mean(-1)
        if self.score == "energy":
            return energy_score(errors, zero)
        return crps_ensemble(errors, zero).mean(-1)

    def _stepped(self, tensordict: TensorDictBase) -> torch.Tensor:
        """``False`` for the first element and for those that start anew, ``[*B, T]``."""
        stepped = torch.ones(tensordict.batch_size, dtype=torch.bool, device=tensordict.device)
        stepped[..., 0] = False
        starts = self.filter._starts(tensordict)
        return stepped if starts is None else stepped & ~starts.reshape(tensordict.batch_size)

    def _reduce_term(self, term: torch.Tensor, mask: torch.Tensor, tensordict: TensorDictBase) -> torch.Tensor:
        if self.reduction == "none":
            return self._reduce_loss(torch.where(mask, term, torch.zeros_like(term)), tensordict)
        return self._reduce_loss(term, tensordict, mask=mask)

    def _true_state(self, tensordict: TensorDictBase) -> torch.Tensor:
        return self._entry(tensordict, self.tensor_keys.state)

    def _observation_model(self):
        models = [module for module in self.filter.update_modules if hasattr(module, "observe")]
        if not models:
            raise KeyError(
                "The filter has no observation model with an observe() method; give the true observation in "
                f"{self.tensor_keys.target_observation!r}, or set the weights sensor and observation to zero."
            )
        return models[0]

    def _true_observation(self, tensordict: TensorDictBase) -> torch.Tensor:
        target = tensordict.get(self.tensor_keys.target_observation, None)
        if target is not None:
            return target
        model = self._observation_model()
        if any(True for _ in model.parameters()):
            raise KeyError(
                f"loss_sensor needs the true observation in {self.tensor_keys.target_observation!r}, because the "
                "observation model is learned. Add the entry, rename it with set_keys(target_observation=...), or "
                "set the weight sensor=0."
            )
        return model.observe(self._true_state(tensordict))

    @staticmethod
    def _entry(tensordict: TensorDictBase, key: NestedKey) -> torch.Tensor:
        value = tensordict.get(key, None)
        if value is None:
            present = ", ".join(sorted(map(str, tensordict.keys(True, True))))
            raise KeyError(
                f"DEnKFLoss reads {key!r}, which is missing; there are {present}. Rename it with loss.set_keys(...)."
            )
        return value
