r"""Learned Gaussian motion noise of an ensemble, where the transition has none or too little of its own."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf.functional import weighted_mean
from torch_denkf.modules._base import SubModel

__all__ = ["NoisyTransition"]


class NoisyTransition(SubModel):
    r"""A transition with learned Gaussian motion noise :math:`N(0, Q)` in some dimensions of the state.

    Args:
        transition: forecasts an ensemble, ``("belief", "ensemble")`` to ``("forecast", "ensemble")``; its keys are
            kept.
        noise: writes the diagonal of Q, variances ``[*B, len(dims)]``, e.g.
            ``DiagonalNoise(2, in_features=5, in_key=("belief", "mean"))`` or ``ConstantNoise``. It may read the
            belief's weighted mean at ``mean_key``, which is worked out for it.
        dims: state dimensions that the noise acts on, in the order of Q.
        before: True adds the noise to the state *before* it moves. What moves with these dimensions then moves with
            their noise, such as the pose of a :class:`torch_denkf.modules.UnicycleTransition` with its velocities.
        ensemble_size: E, needed only to draw noise for a whole sequence in bulk; a filter sets it.
        mean_key: the belief's mean ``[*B, S]``.
        log_weight_key: optional log-weights of the belief ``[*B, E]``.
        noise_key: optional standard-normal noise ``[*B, E, len(dims)]``.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if ``noise`` does not write one variance for each of ``dims``.

    Reference:
        Learned motion noise of a particle filter: Jonschkowski, Rastogi & Brock 2018, arXiv:1805.11122 (there a
        sampler); Kloss, Martius & Bohg 2021, arXiv:2012.14313 (the diagonal of Q).

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import ConstantNoise, LearnedTransition
        >>> still = LearnedTransition(nn.Linear(2, 2))
        >>> noisy = NoisyTransition(still, ConstantNoise([0.1], in_key=("belief", "ensemble")), dims=[1])
        >>> td = TensorDict({("belief", "ensemble"): torch.zeros(100, 2)})
        >>> noisy(td)["forecast", "ensemble"].std(0) > 0.05
        tensor([False,  True])
    """

    def __init__(
        self,
        transition: SubModel,
        noise: TensorDictModuleBase,
        dims: Sequence[int],
        *,
        before: bool = False,
        ensemble_size: int | None = None,
        mean_key: NestedKey = ("belief", "mean"),
        log_weight_key: NestedKey = ("belief", "log_weight"),
        noise_key: NestedKey = ("noise", "motion"),
    ):
        self_made = {unravel_key(mean_key)}
        keys = dict.fromkeys(map(unravel_key, [*transition.in_keys, *noise.in_keys]))
        super().__init__(
            nn.ModuleDict({"transition": transition, "noise": noise}),
            [key for key in keys if key not in self_made],
            transition.out_keys,
            optional_keys=[log_weight_key],
            noise_key=noise_key,
        )
        self.before, self.mean_key, self.ensemble_size = before, mean_key, ensemble_size
        self.register_buffer("dims", torch.tensor(list(dims)), persistent=False)

    def draw_noise(self, batch_size, *, device=None, dtype=None, generator=None):
        """Draws standard-normal values ``[*batch_size, E, len(dims)]``; needs ``ensemble_size``."""
        if self.ensemble_size is None:
            return None
        shape = (*batch_size, self.ensemble_size, len(self.dims))
        return torch.randn(shape, device=device, dtype=dtype, generator=generator)

    runs_on_rows = True

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the forecast ensemble."""
        key, out_key = self.in_keys[0], self.out_keys[0]
        state = self.read(tensordict, key)
        work = tensordict.copy().set(self.mean_key, self._mean(state, tensordict))
        noise_model = self.module["noise"]
        variance = noise_model(work).get(noise_model.out_keys[0])
        if variance.shape[-1] != len(self.dims):
            raise ValueError(
                f"The noise model writes {variance.shape[-1]} variances in {noise_model.out_keys[0]!r} for "
                f"{len(self.dims)} dims; give it an output for each of dims={self.dims.tolist()}."
            )
        normal = self.read_noise(tensordict)
        if normal is None:
            normal = torch.randn((*state.shape[:-1], len(self.dims)), device=state.device, dtype=state.dtype)
        noise = variance.sqrt().unsqueeze(-2) * normal
        if self.before:
            work.set(key, state.index_add(-1, self.dims, noise))
            return self._hand_over(self.module["transition"](work), tensordict)
        tensordict = self._hand_over(self.module["transition"](work.set(key, state)), tensordict)
        return tensordict.set(out_key, tensordict.get(out_key).index_add(-1, self.dims, noise))

    def _mean(self, state: torch.Tensor, tensordict: TensorDictBase) -> torch.Tensor:
        log_weights = tensordict.get(self.optional_keys[0], None)
        return state.mean(-2) if log_weights is None else weighted_mean(state, log_weights)

    def _hand_over(self, source: TensorDictBase, target: TensorDictBase) -> TensorDictBase:
        for key in self.out_keys:
            target.set(key, source.get(key))
        return target
