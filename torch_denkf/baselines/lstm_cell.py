r"""A recurrent network in place of a filter, with a hidden state as memory and a Gaussian belief.

This baseline has no models and no gain. It uses the keys of the filters with a mean and a covariance, so that
objectives, metrics and environments work unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torch.nn import functional as F
from torchrl.modules import LSTMCell

from torch_denkf._checks import check_count, check_number
from torch_denkf.modules.around import AugmentedBelief
from torch_denkf.modules.tensors import as_vector, mean_of_members
from torch_denkf.submodel import Entries, Transition, Update

__all__ = ["LSTMTransition", "LSTMUpdate", "with_memory"]

_MEMORY = ("hidden", "cell")
_MOMENTS = ("mean", "cov")
_MOST_LAYERS = 1000  # more are a mistake, and would exhaust the memory


def with_memory(
    initial: TensorDictModuleBase, hidden_size: int, *, num_layers: int = 1, belief_prefix: str = "belief"
) -> AugmentedBelief:
    """Returns an initial belief with an empty memory: hidden and cell states of zero, as in ``torch.nn.LSTM``.

    Args:
        initial: the initial belief with a mean: :class:`MomentPrior`, :class:`GaussianAround`.
        hidden_size: H.
        num_layers: L.
        belief_prefix: prefix of the outputs of ``initial``, and of ``hidden`` and ``cell`` ``[*B, L, H]``.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import MomentPrior
        >>> start = with_memory(MomentPrior(torch.zeros(2), torch.eye(2)), hidden_size=8)
        >>> start(TensorDict({}, [3]))["belief", "hidden"].shape
        torch.Size([3, 1, 8])
    """
    check_count("hidden_size", hidden_size)
    check_count("num_layers", num_layers)
    begin = partial(_empty, (belief_prefix, "mean"), (num_layers, hidden_size))
    return AugmentedBelief(initial, [(belief_prefix, name) for name in _MEMORY], begin, nested=True)


def _empty(key: NestedKey, shape: tuple[int, int], belief: Entries, batch_size: torch.Size) -> list[torch.Tensor]:
    return [belief[key].new_zeros(*batch_size, *shape)] * len(_MEMORY)


class LSTMTransition(Transition):
    """Returns memory, mean and covariance of the last belief unchanged, as an LSTM has no forecast.

    Args:
        belief_prefix: prefix of ``hidden``, ``cell``, ``mean`` and ``cov`` of the last belief.
        forecast_prefix: prefix of the same, unchanged.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import MomentPrior
        >>> td = with_memory(MomentPrior(torch.ones(2), torch.eye(2)), hidden_size=8)(TensorDict({}))
        >>> LSTMTransition()(td)["forecast", "mean"]
        tensor([1., 1.])
    """

    def __init__(self, *, belief_prefix: str = "belief", forecast_prefix: str = "forecast"):
        names = (*_MEMORY, *_MOMENTS)
        in_keys, out_keys = ([(key, name) for name in names] for key in (belief_prefix, forecast_prefix))
        super().__init__(nn.Identity(), in_keys, out_keys)

    def compute(self, *values):
        """Returns the forecast."""
        return values


class LSTMUpdate(Update):
    r"""Updates the memory; the belief is :math:`N(m + s \circ W h_t, s^2 \circ (\mathrm{softplus}(U h_t) + c))`.

    The LSTM reads, in this order: the sensor's encoding, its reading in units of ``observation_scale``, a flag for each
    component of the reading (or one for the frame) that is 1 where it was observed, and the entries of ``extra_keys``.
    Missing components are zero. U is initialised to zero, for an initial standard deviation of ``scale``.

    Args:
        state_dim: S, the number of outputs.
        features: size of the encoding, with ``encoding_key``.
        observation_dim: O, size of the reading, with ``observation_key``.
        extra_features: size of all entries of ``extra_keys`` together.
        hidden_size: H.
        num_layers: L, number of layers; each reads the hidden state of the previous one.
        loc: mean of each output ``[S]``, in the state's units; zero by default.
        scale: standard deviation of each output ``[S]``; one by default.
        floor: smallest variance c, in units of ``scale`` squared.
        inflation: factor on the belief's standard deviations; 1 for none.
        observation_loc: mean of each component of the reading ``[O]``; zero by default.
        observation_scale: standard deviation of each component ``[O]``; one by default.
        encoding_key: the sensor's encoding ``[*B, features]``; ``None`` for none.
        observation_key: readings ``[*B, O]``, or learned observations ``[*B, E, O]``, whose mean is used; ``None`` for
            none.
        extra_keys: further inputs ``[*B, n]``, which are not masked, e.g. ``"steps"`` or ``"action"``.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``; missing readings may be NaN. The encoding is observed if
            any component is.
        forecast_prefix: prefix of ``hidden`` and ``cell`` of the last step.
        memory_prefix: prefix of ``hidden`` and ``cell`` ``[*B, L, H]``, written.
        belief_prefix: prefix of ``mean`` ``[*B, S]``, ``cov`` ``[*B, S, S]`` (diagonal) and ``var`` ``[*B, S]``,
            written.

    Raises:
        ValueError: if there is nothing to read, or an input has another size than given.
        KeyError: if an entry is missing.

    Reference:
        Hochreiter & Schmidhuber 1997; as a baseline of differentiable filters: Haarnoja et al. 2016, arXiv:1605.07148,
        and Kloss, Martius & Bohg 2021, arXiv:2012.14313.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import MomentPrior
        >>> td = TensorDict({("sensor", "encoding"): torch.randn(3, 16)}, [3])
        >>> td = LSTMTransition()(with_memory(MomentPrior(torch.zeros(2), torch.eye(2)), hidden_size=8)(td))
        >>> LSTMUpdate(2, features=16, hidden_size=8)(td)["belief", "mean"].shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        state_dim: int,
        *,
        features: int = 0,
        observation_dim: int = 0,
        extra_features: int = 0,
        hidden_size: int = 128,
        num_layers: int = 1,
        loc: Sequence[float] | torch.Tensor | None = None,
        scale: Sequence[float] | torch.Tensor | None = None,
        floor: float = 1e-4,
        inflation: float = 1.0,
        observation_loc: Sequence[float] | torch.Tensor | None = None,
        observation_scale: Sequence[float] | torch.Tensor | None = None,
        encoding_key: NestedKey | None = ("sensor", "encoding"),
        observation_key: NestedKey | None = None,
        extra_keys: Sequence[NestedKey] = (),
        observed_key: NestedKey = "observed",
        forecast_prefix: str = "forecast",
        memory_prefix: str = "belief",
        belief_prefix: str = "belief",
    ):
        for name, size in (
            ("features", features),
            ("observation_dim", observation_dim),
            ("extra_features", extra_features),
        ):
            check_count(name, size, least=0)
        for key, size, name in (
            (encoding_key, features, "features"),
            (observation_key, observation_dim, "observation_dim"),
            (tuple(extra_keys) or None, extra_features, "extra_features"),
        ):
            if (key is None) != (size == 0):
                raise ValueError(f"{name}={size} is the size of what {key!r} holds; give both, or 0 and no key.")
        if encoding_key is None and observation_key is None:
            raise ValueError("An LSTM needs something to read: give encoding_key and features, or observation_key.")
        in_size = features + observation_dim + (observation_dim or 1) + extra_features
        check_count("state_dim", state_dim)
        check_count("hidden_size", hidden_size)
        check_count("num_layers", num_layers, most=_MOST_LAYERS)
        check_number("floor", floor, least=0)
        check_number("inflation", inflation, above=0)
        cells = [LSTMCell(hidden_size if layer else in_size, hidden_size) for layer in range(num_layers)]
        heads = {"mean": nn.Linear(hidden_size, state_dim), "var": nn.Linear(hidden_size, state_dim)}
        nn.init.zeros_(heads["var"].weight)
        nn.init.constant_(heads["var"].bias, torch.tensor(1.0).expm1().log().item())  # softplus of it is 1
        inputs = [key for key in (encoding_key, observation_key) if key is not None]
        super().__init__(
            nn.ModuleDict({"cells": nn.ModuleList(cells), **heads}),
            [(forecast_prefix, name) for name in _MEMORY] + [*inputs, *extra_keys],
            [(memory_prefix, name) for name in _MEMORY] + [(belief_prefix, name) for name in (*_MOMENTS, "var")],
            optional_keys=[observed_key],
        )
        self.encoding_key, self.observation_key, self.extra_keys = encoding_key, observation_key, list(extra_keys)
        self.in_size, self.num_layers, self.hidden_size = in_size, num_layers, hidden_size
        self.floor, self.inflation, self.observation_dim = floor, inflation, observation_dim or None
        self.reading_keys, self.observed_key = inputs, unravel_key(observed_key)
        for name, value, size, default in (
            ("loc", loc, state_dim, 0.0),
            ("scale", scale, state_dim, 1.0),
            ("observation_loc", observation_loc, observation_dim, 0.0),
            ("observation_scale", observation_scale, observation_dim, 1.0),
        ):
            limit = 0 if name.endswith("scale") else None
            self.register_buffer(name, as_vector(name, default if value is None else value, size, above=limit))
        self.feature_sizes = [size for size in (features, observation_dim) if size]

    def reading_dims(self, entries, call):
        """Returns the sizes of the encoding and of the reading."""
        return self.feature_sizes

    def compute(self, hidden, cell, *rest, batch_size):
        """Returns the memory and the belief."""
        *inputs, observed = rest
        features = self._features(inputs, observed, batch_size)
        # A cell takes one batch dimension; the tensordict may have none or many.
        output = features.reshape(-1, self.in_size)
        states = [part.reshape(-1, self.num_layers, self.hidden_size).unbind(-2) for part in (hidden, cell)]
        memory = []
        for layer, *state in zip(self.module["cells"], *states, strict=True):
            memory.append(layer(output, tuple(state)))
            output = memory[-1][0]
        size = (*batch_size, self.num_layers, self.hidden_size)
        kept = [torch.stack(parts, -2).reshape(size) for parts in zip(*memory, strict=True)]
        output = output.reshape(*batch_size, self.hidden_size)
        mean = self.loc + self.scale * self.module["mean"](output)
        variance = (self.inflation * self.scale).square() * (F.softplus(self.module["var"](output)) + self.floor)
        return *kept, mean, variance.diag_embed(), variance

    def _features(self, inputs: list[torch.Tensor], observed: torch.Tensor | None, batch_size) -> torch.Tensor:
        """Concatenates the inputs of the LSTM, ``[*B, in_size]``."""
        dtype, parts = self.loc.dtype, []
        if self.encoding_key is not None:
            encoding, *inputs = inputs
            parts.append(encoding if observed is None else torch.where(observed.any(-1, keepdim=True), encoding, 0.0))
        if self.observation_key is not None:
            reading, *inputs = inputs
            if reading.shape[-1] != len(self.observation_loc):
                raise ValueError(
                    f"{self.observation_key!r} has {reading.shape[-1]} components; observation_dim is "
                    f"{len(self.observation_loc)}."
                )
            reading = (mean_of_members(reading, batch_size) - self.observation_loc) / self.observation_scale
            parts.append(reading if observed is None else torch.where(observed, reading, 0.0))
            flag = torch.ones_like(reading) if observed is None else observed.expand_as(reading)
        else:
            flag = torch.ones_like(parts[0][..., :1]) if observed is None else observed.any(-1, keepdim=True)
        parts += [flag, *inputs]
        features = torch.cat([part.to(dtype) for part in parts], -1)
        if features.shape[-1] != self.in_size:
            sizes = [part.shape[-1] for part in parts]
            raise ValueError(
                f"LSTMUpdate was built for {self.in_size} inputs, flags included, and reads {sizes} (encoding, "
                "reading, flags, extra inputs, as far as there are any). Correct features=, observation_dim= or "
                "extra_features=."
            )
        return features
