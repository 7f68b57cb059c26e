"""The extended Kalman filter's two steps, for any transition and any observation model of ensembles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Unpack

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_denkf.functional.gaussian import check_update, innovation_update, sandwich
from torch_denkf.functional.manifolds import Euclidean, Space, is_flat
from torch_denkf.modules.gaussian import GaussianAnalysis, GaussianTransition, GaussianTransitionKeys
from torch_denkf.running import linearise, reads
from torch_denkf.submodel import Call, Entries, Update, role

__all__ = ["EKFAnalysis", "EKFTransition"]


class EKFTransition(GaussianTransition):
    r"""Forecast :math:`f(m)` and :math:`F P F^T + Q` with the Jacobian F of the transition at the mean.

    The transition runs on ensembles of one member; its stochastic networks run their deterministic forward. Known
    motions and networks of linear layers compute F themselves (``jacobian``); for other transitions it comes from
    automatic differentiation. F can be differentiated. Rows of a batch must not depend on each other.

    Args:
        transition: forecasts ensembles ``[*B, E, S]``, e.g. :class:`~torch_denkf.modules.LearnedTransition`.
        process_noise: writes Q, variances ``[*B, S]`` or a covariance ``[*B, S, S]``, see
            :mod:`torch_denkf.modules.process_noise`; it may read the belief's mean and the forecast's.
        stop_jacobian_gradient: whether F is a constant to the gradient (as in Kloss et al. 2021).
        **keys: see :class:`GaussianTransitionKeys`.

    Raises:
        ValueError: if the transition has random layers outside a :class:`~torch_denkf.modules.StochasticMLP`, or
            draws its own noise.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import ConstantNoise, LearnedTransition
        >>> noise = ConstantNoise([1.0], in_key=("belief", "mean"), out_key=("forecast", "noise"))
        >>> square = EKFTransition(LearnedTransition(torch.nn.Tanh(), residual=False), noise)
        >>> square(TensorDict({"belief": {"mean": torch.zeros(1), "cov": torch.eye(1)}}))["forecast", "cov"]
        tensor([[2.]])
    """

    def __init__(
        self,
        transition: TensorDictModuleBase,
        process_noise: TensorDictModuleBase,
        *,
        stop_jacobian_gradient: bool = False,
        **keys: Unpack[GaussianTransitionKeys],
    ):
        super().__init__(transition, process_noise, **keys)
        self.stop_jacobian_gradient = stop_jacobian_gradient

    def _forecast(self, entries, mean, cov, call, wanted):
        def move(rows, states, call):
            return self._move(rows, states, call), None

        entries = {**entries, self.ensemble_key: mean.unsqueeze(-2)}
        sides = None if is_flat(self.space) else (self.space, self.space)
        forecast, jacobian, _ = _linearise(
            self, move, entries, call, mean, mean.shape[-1], self.forecast_ensemble_key, sides
        )
        if self.stop_jacobian_gradient:
            jacobian = jacobian.detach()
        moved = sandwich(jacobian, cov)
        link = (torch.eye(cov.shape[-1], dtype=cov.dtype, device=cov.device), cov, jacobian) if wanted else None
        return forecast, (moved + moved.mT) / 2, link


class EKFAnalysis(GaussianAnalysis):
    r"""The Kalman update with the Jacobian H of the observation model at the forecast's mean (Joseph form).

    Args:
        observation: observes ensembles ``[*B, E, S]``. Its other inputs and outputs, such as a mask, are read from and
            written to a copy of the tensordict.
        **options: see :class:`GaussianAnalysisOptions`.

    Raises:
        ValueError: if the model has random layers outside a :class:`~torch_denkf.modules.StochasticMLP`.
        KeyError: if an entry is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import Select
        >>> td = TensorDict({
        ...     "forecast": {"mean": torch.zeros(2), "cov": torch.eye(2)},
        ...     "sensor": {"ensemble": torch.ones(1), "noise": torch.ones(1)},
        ... })
        >>> EKFAnalysis(Select([1]))(td)["belief", "mean"]
        tensor([0.0000, 0.5000])
    """

    def _update(self, entries, mean, cov, observation, noise, call):
        size, sides = observation.shape[-1], None
        if not is_flat(self.space, self.reading_space):
            sides = self.space, self.reading_space
        entries = {**entries, self.ensemble_key: mean.unsqueeze(-2)}
        predicted, jacobian, observed = _linearise(
            self, self._observe, entries, call, mean, size, self.predicted_key, sides
        )
        innovation = self._innovation(observation, predicted, observed)
        check_update(mean if is_flat(self.space) else cov[..., 0], cov, innovation, jacobian, noise)
        update = innovation_update(cov, innovation, jacobian, noise, observed=observed)
        return self._moved(mean, update), observed


def _linearise(
    step: GaussianTransition | GaussianAnalysis,
    model: Callable[[Entries, Tensor, Call], tuple[Tensor, Tensor | None]],
    entries: Entries,
    call: Call,
    mean: Tensor,
    size: int,
    key: NestedKey,
    sides: tuple[Space | None, Space | None] | None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Returns output, Jacobian and mask of the model inside a step, by its own Jacobian or automatic differentiation.

    Args:
        step: the step around the model.
        model: see :func:`_differentiated`.
        entries: inputs of the model, including the mean ``[*B, 1, P]``.
        call: the model's call.
        mean: the mean, ``[*B, P]``.
        size: dimension of the output, N.
        key: key of the output.
        sides: spaces of mean and output, between whose tangents the Jacobian maps; ``None`` for plain numbers, of
            one or both.
    """
    found = linearise(step.module, entries, call)
    if found is None or found[0][key].shape[-1] != size or not _fit(found[2], sides):
        needed, optional = reads(step.module)
        keys = dict.fromkeys([*needed, *optional, role(step, Update).observed_key])
        image, jacobian, mask = _differentiated(
            model, {name: entries[name] for name in keys if name in entries}, call, mean, size
        )
        between = None
    else:
        written, jacobian, between = found
        image, mask = written[key].squeeze(-2), step.mask_of(entries, written)
        jacobian = jacobian if jacobian.ndim == 2 else jacobian.squeeze(-3)
    if sides is not None and between is None:
        space, image_space = sides[0] or Euclidean(mean.shape[-1]), sides[1] or Euclidean(size)
        space.check(point=mean)
        jacobian = image_space.dual_basis(image) @ jacobian @ space.basis(mean)
    return image, jacobian, mask


def _fit(known: tuple[Space, Space] | None, wanted: tuple[Space | None, Space | None] | None) -> bool:
    """Tells whether a Jacobian for the known spaces is also that for the wanted ones."""
    if known is None or known == wanted:
        return True
    pairs = zip(known, wanted or (None, None), strict=True)
    return all(one == other or is_flat(one, other) for one, other in pairs)


def _differentiated(
    model: Callable[[Entries, Tensor, Call], tuple[Tensor, Tensor | None]],
    entries: Entries,
    call: Call,
    mean: Tensor,
    size: int,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Returns output and Jacobian at ``mean`` ``[*B, S]`` of a model of ensembles, in one call of it.

    The model runs on N copies of the batch, and one backward pass starts at the n-th output of the n-th copy. This
    takes a quarter of the time of torch.func's forward mode, whose Python formulas dominate in small systems, and
    needs no vmap over a dimension that the model does not know. In a compiled graph Python costs nothing: there the
    model runs once under a vmap over backward passes, with half the products. Both results can be differentiated.

    Args:
        model: maps entries and an ensemble ``[*, 1, S]`` to outputs ``[*, 1, N]`` and a mask, with ``*`` any batch.
        entries: inputs of the model, ``[*B]``.
        call: the model's call.
        mean: the mean.
        size: N, the dimension of the outputs.

    Returns:
        The output ``[*B, N]``, the Jacobian ``[*B, N, S]``, and the mask.
    """
    copies = () if torch.compiler.is_compiling() else (size,)
    rows = {key: value.expand(*copies, *value.shape) for key, value in entries.items()}
    call = call._replace(batch_size=torch.Size((*copies, *call.batch_size)))

    def run(states: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        images, mask = model(rows, states, call)
        if images.shape[-1] != size:
            raise ValueError(
                f"the model of {mean.shape[-1]} states returns {images.shape[-1]} components instead of {size}: an "
                "observation returns one for each component of its reading, a motion one for each of the state. "
                "Earlier states that are kept for late readings count among the states."
            )
        return images, () if mask is None else (mask,)

    states = mean.unsqueeze(-2).expand(*copies, *mean.shape[:-1], 1, mean.shape[-1])
    result = torch.func.vjp(run, states, has_aux=True)
    images, pull_back, masks = result  # type: ignore[misc]  # torch's annotation lacks the third result of has_aux
    basis = torch.eye(size, dtype=images.dtype, device=images.device).reshape(size, *[1] * mean.ndim, size)
    if copies:
        (jacobian,) = pull_back(basis.expand_as(images))
        images, masks = images[0], tuple(mask[0] for mask in masks)
    else:
        (jacobian,) = torch.func.vmap(pull_back)(basis.expand(size, *images.shape))
    return images.squeeze(-2), jacobian.squeeze(-2).movedim(0, -2), masks[0] if masks else None
