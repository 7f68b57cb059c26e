r"""A sensor's slow errors as part of the state: biases that fade, in any filter.

A sensor that reads wrongly often reads wrongly in the next frame, too. A filter that takes such errors for white noise
believes them more with each frame, and its intervals become too narrow. Here the state is :math:`(x, b)`: S numbers of
the system, then K biases of the sensor, each an Ornstein-Uhlenbeck process with its own standard deviation and its own
time; the reading is :math:`h(x) + b`. With several times for each component of the reading the errors may be slow and
slower.

.. math:: b_t = \rho \circ b_{t-1} + \eta_t, \quad \rho = e^{-1 / \tau}, \quad \eta_t \sim N(0, \sigma^2 (1 - \rho^2))

Give the transition, the process noise and the observation the same :class:`FadingBias`, and the initial belief S +
K dimensions: ``FadingBias.std`` for the biases. For a linear system with such "coloured" reading errors the filter
then is the optimal one: the Kalman filter of the augmented state.

Source: Bryson & Henrikson 1968, J. Spacecraft Rockets 5 ("Estimation using sampled data containing sequentially
correlated noise"); Uhlenbeck & Ornstein 1930.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torch_denkf._checks import check_values
from torch_denkf.modules._base import SubModel
from torch_denkf.modules._running import check_module, reads, run_module
from torch_denkf.modules._tensors import as_standard_deviations

__all__ = ["BiasedNoise", "BiasedObservation", "BiasedTransition", "FadingBias"]


class FadingBias(nn.Module):
    """K biases that fade: Ornstein-Uhlenbeck processes, whose size and time are learned.

    Args:
        std: standard deviation of each bias in the long run ``[K]``, in the reading's units, before training.
        time: steps in which each bias fades to 1/e, ``[K]`` or one number for all, before training.
        trainable: whether both are parameters; else buffers.

    Raises:
        ValueError: if a standard deviation or a time is not positive.

    Example:
        >>> bias = FadingBias([2.0], time=10.0)
        >>> bias.decay.item(), bias.variance.item()  # after one step; new in one step
        (0.904..., 0.725...)
    """

    log_std: Tensor
    log_time: Tensor

    def __init__(
        self, std: Sequence[float] | Tensor, time: float | Sequence[float] | Tensor, *, trainable: bool = True
    ):
        super().__init__()
        std = as_standard_deviations("std", std)
        time = torch.as_tensor(time, dtype=std.dtype).expand_as(std)
        check_values("std, a standard deviation,", std, above=0)
        check_values("time, in steps,", time, above=0)
        for name, value in (("log_std", std.log()), ("log_time", time.log())):
            if trainable:
                self.register_parameter(name, nn.Parameter(value.clone()))
            else:
                self.register_buffer(name, value.clone())

    def __len__(self) -> int:
        return len(self.log_std)

    @property
    def std(self) -> Tensor:
        """Standard deviations in the long run ``[K]``: of the biases in an initial belief."""
        return self.log_std.exp()

    @property
    def decay(self) -> Tensor:
        """What is left of a bias after a step, ``[K]``."""
        return (-(-self.log_time).exp()).exp()

    @property
    def variance(self) -> Tensor:
        """Variance of what is new in a step, ``[K]``: with it the biases stay as large as they are."""
        return (2 * self.log_std).exp() * -torch.expm1(-2 * (-self.log_time).exp())


class BiasedTransition(SubModel):
    """A transition of S numbers, and behind them biases that fade.

    Args:
        transition: moves ensembles ``[*B, E, S]``; its keys are kept, its noise too.
        bias: shared with the noise and the observation.

    Raises:
        KeyError: if an entry is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import LearnedTransition
        >>> still = LearnedTransition(nn.Identity(), residual=False)
        >>> move = BiasedTransition(still, FadingBias([1.0], time=1.0))
        >>> move(TensorDict({("belief", "ensemble"): torch.ones(1, 2)}))["forecast", "ensemble"]
        tensor([[1.0000, 0.3679]], grad_fn=...)
    """

    def __init__(self, transition: TensorDictModuleBase, bias: FadingBias):
        check_module("transition", transition)
        needed, optional = reads(transition)
        super().__init__(transition, needed, transition.out_keys, optional_keys=optional)
        self.bias = bias

    def parts(self):
        """The transition."""
        return {"transition": self.module}

    def on_entries(self, entries, call):
        """The forecast of both, and whatever else the transition writes."""
        key, out_key = unravel_key(self.in_keys[0]), unravel_key(self.out_keys[0])
        state, slow = _split(self.required(entries, key), self.bias, self)
        written = run_module(self.module, {**entries, key: state}, call.part("transition"))
        return {**written, out_key: torch.cat([written[out_key], self.bias.decay * slow], -1)}


class BiasedNoise(SubModel):
    """The process noise of a state and of the biases behind it: variances ``[*B, N + K]`` or a covariance.

    Args:
        noise: of the state: writes variances ``[*B, N]`` or a covariance ``[*B, N, N]``; its keys are kept.
        bias: shared with the transition.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import ConstantNoise
        >>> q = ConstantNoise([0.5], in_key=("belief", "mean"), out_key=("forecast", "noise"))
        >>> both = BiasedNoise(q, FadingBias([1.0], time=10.0))
        >>> both(TensorDict({("belief", "mean"): torch.zeros(2)}))["forecast", "noise"]
        tensor([0.2500, 0.1813], grad_fn=...)
    """

    def __init__(self, noise: TensorDictModuleBase, bias: FadingBias):
        check_module("noise", noise)
        needed, optional = reads(noise)
        super().__init__(noise, needed, noise.out_keys, optional_keys=optional)
        self.bias = bias

    def parts(self):
        """The noise module."""
        return {"noise": self.module}

    def on_entries(self, entries, call):
        """Q of both."""
        out, key = run_module(self.module, entries, call.part("noise")), unravel_key(self.out_keys[0])
        of_state, slow = out[key], self.bias.variance.to(out[key].dtype)
        if of_state.ndim == len(call.batch_size) + 1:
            return {**out, key: torch.cat([of_state, slow.expand(*of_state.shape[:-1], -1)], -1)}
        size, count = of_state.shape[-1], len(slow)
        corner = slow.diag_embed().expand(*of_state.shape[:-2], -1, -1)
        rows = nn.functional.pad(of_state, (0, count)), nn.functional.pad(corner, (size, 0))
        return {**out, key: torch.cat(rows, -2)}


class BiasedObservation(SubModel):
    """What the sensor reads of the state, plus its biases.

    With K = G O biases each component of the reading has G of them: the first O belong to components 1 to O, and so do
    the next O.

    Args:
        observation: observes ensembles ``[*B, E, S]``, writes ``[*B, E, O]``; its keys are kept.
        bias: shared with the transition.
        dims: components of the reading that biases belong to, ``[K]``; by default all O, as often as K holds them.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if there are not as many ``dims`` as biases, or without ``dims`` if K is no multiple of O.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import Select
        >>> read = BiasedObservation(Select([0, 1]), FadingBias([1.0], time=10.0), dims=[1])
        >>> read(TensorDict({("forecast", "ensemble"): torch.tensor([[3.0, 4.0, 0.5]])}))["forecast", "observation"]
        tensor([[3.0000, 4.5000]])
    """

    def __init__(self, observation: TensorDictModuleBase, bias: FadingBias, dims: Sequence[int] | None = None):
        check_module("observation", observation)
        if dims is not None and len(dims) != len(bias):
            raise ValueError(f"dims names {len(dims)} components of the reading, and there are {len(bias)} biases")
        needed, optional = reads(observation)
        super().__init__(observation, needed, observation.out_keys, optional_keys=optional)
        self.bias = bias
        self.register_buffer("dims", None if dims is None else torch.tensor(list(dims)), persistent=False)

    def parts(self):
        """The observation model."""
        return {"observation": self.module}

    def on_entries(self, entries, call):
        """The predicted observations."""
        key, out_key = unravel_key(self.in_keys[0]), unravel_key(self.out_keys[0])
        state, slow = _split(self.required(entries, key), self.bias, self)
        written = run_module(self.module, {**entries, key: state}, call.part("observation"))
        read = written[out_key]
        if self.dims is not None:
            return {**written, out_key: read.index_add(-1, self.dims, slow)}
        if len(self.bias) % read.shape[-1]:
            raise ValueError(
                f"{len(self.bias)} biases are not as many for each of the {read.shape[-1]} components of the reading; "
                "say in dims which component each belongs to"
            )
        return {**written, out_key: read + slow.unflatten(-1, (-1, read.shape[-1])).sum(-2)}


def _split(state: Tensor, bias: FadingBias, module: nn.Module) -> tuple[Tensor, Tensor]:
    """The system's part of a state, and the biases."""
    count = len(bias)
    if state.shape[-1] <= count:
        raise ValueError(
            f"{type(module).__name__} splits a state of {state.shape[-1]} into the system's and {count} biases: "
            "the initial belief must hold both"
        )
    return state[..., :-count], state[..., -count:]
