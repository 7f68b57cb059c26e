r"""State augmentation by fading biases for coloured errors of a sensor, in any filter.

Errors of a sensor are often correlated in time. A filter that assumes white noise is then overconfident. Here the state
is :math:`(x, b)`: S numbers of the system, then K biases of the sensor, each an Ornstein-Uhlenbeck process with its own
standard deviation and time constant; the reading is :math:`h(x) + b`. A component of the reading may have several
biases, with different time constants.

.. math:: b_t = \rho \circ b_{t-1} + \eta_t, \quad \rho = e^{-1 / \tau}, \quad \eta_t \sim N(0, \sigma^2 (1 - \rho^2))

The option ``sensor_error=FadingBias(...)`` of a filter does this. Otherwise, give transition, process noise and
observation the same :class:`FadingBias`, and the initial belief S + K dimensions: ``FadingBias.std`` for the biases.
For a linear system with such "coloured" reading errors the filter then is the optimal one: the Kalman filter of the
augmented state.

Source: Bryson & Henrikson 1968, J. Spacecraft Rockets 5 ("Estimation using sampled data containing sequentially
correlated noise"); Uhlenbeck & Ornstein 1930.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import torch
from tensordict import unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torch_denkf._checks import check_values
from torch_denkf.beliefs import Ensemble, Particles, is_samples
from torch_denkf.functional.draws import exact_draws
from torch_denkf.functional.manifolds import Space, is_flat
from torch_denkf.modules.around import AroundInitial, Wrapper
from torch_denkf.modules.process_noise import as_process_noise
from torch_denkf.modules.tensors import as_floating, as_standard_deviations
from torch_denkf.running import check_module, linearise
from torch_denkf.submodel import Call, Entries, Initial, Transition, role

__all__ = ["BiasedBelief", "BiasedNoise", "BiasedObservation", "BiasedTransition", "FadingBias"]


class FadingBias(nn.Module):
    """K fading biases: Ornstein-Uhlenbeck processes with learned standard deviations and time constants.

    Args:
        std: initial value of the stationary standard deviation of each bias ``[K]``, in the reading's units.
        time: initial value of the time constant of each bias in steps, ``[K]`` or one number for all.
        trainable: whether both are parameters; else buffers.
        factor: whether the errors are multiplicative: the reading is :math:`h(x) (1 + b)`, and ``std`` has no unit.

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
        self,
        std: Sequence[float] | Tensor,
        time: float | Sequence[float] | Tensor,
        *,
        trainable: bool = True,
        factor: bool = False,
    ):
        super().__init__()
        self.factor = factor
        std = as_standard_deviations("std", std)
        time = torch.as_tensor(time, dtype=std.dtype).expand_as(std)
        check_values("std, a standard deviation,", std, above=0)
        check_values("time, in steps,", time, above=0)
        for name, value in (("log_std", std.log()), ("log_time", time.log())):
            if trainable:
                self.register_parameter(name, nn.Parameter(value.clone()))
            else:
                self.register_buffer(name, value.clone())

    @classmethod
    def from_residuals(
        cls, residuals: Tensor, *, trainable: bool = True, per_run: bool = False
    ) -> tuple[FadingBias, Tensor]:
        r"""Fits biases to the autocorrelation of a sensor's errors, and returns them with the remaining white noise.

        The autocovariance of :math:`b + w` at lag k is :math:`\sigma^2 e^{-k / \tau}`, and at lag 0 it is more by the
        white variance. Standard deviation and time constant are fitted by least squares over lags from one step to
        three times :math:`\tau`, weighted by the number of pairs. The time constant is bounded by the length of the
        runs.

        Args:
            residuals: reading minus true value, ``[N, T, K]``, N runs of T steps, on held-out data; NaN for missing
                values. Their mean is not subtracted.
            trainable: see the class.
            per_run: whether the errors also have a constant part in each run, as for a learned sensor in new
                surroundings. There are then 2 K biases, K that last 100 times as long as a run and K that fade. It
                takes about ten runs. One time for both kinds fits neither.

        Returns:
            K biases, or 2 K; and the standard deviations of the white part ``[K]``, for the noise of the reading.

        Raises:
            ValueError: if the shape is another, a component has fewer than 100 pairs of neighbours, its errors do not
                last at all, or ``per_run`` is given one run.

        Example:
            >>> torch.manual_seed(0)
            <...>
            >>> true, error, readings = FadingBias([2.0], time=10.0, trainable=False), torch.zeros(500, 1), []
            >>> for _ in range(150):
            ...     error = true.decay * error + true.variance.sqrt() * torch.randn(500, 1)
            ...     readings.append(error + 0.5 * torch.randn(500, 1))
            >>> bias, white = FadingBias.from_residuals(torch.stack(readings[50:], 1), trainable=False)
            >>> [round(value.item(), 1) for value in (bias.std, bias.log_time.exp() / 10, white)]
            [2.0, 1.0, 0.5]
        """
        if residuals.ndim != 3 or residuals.shape[1] < 3:
            raise ValueError(f"residuals must be [N, T, K], T at least 3; got {list(residuals.shape)}")
        if per_run and len(residuals) < 2:
            raise ValueError("per_run=True tells errors of a whole run by how runs differ: give about ten; got one")
        values = residuals.detach().double()
        known = ~values.isnan()
        found = [_fit(*_autocovariance(values[..., k], known[..., k]), k, per_run) for k in range(values.shape[-1])]
        std, time, white, whole = (residuals.new_tensor(column) for column in zip(*found, strict=True))
        if per_run:
            std, time = torch.cat([whole, std]), torch.cat([torch.full_like(time, 100.0 * values.shape[1]), time])
        return cls(std, time, trainable=trainable), white

    def __len__(self) -> int:
        return len(self.log_std)

    @property
    def std(self) -> Tensor:
        """Returns stationary standard deviations ``[K]``, also those of the initial belief."""
        return self.log_std.exp()

    @property
    def decay(self) -> Tensor:
        """Returns the decay factor of a bias per step, ``[K]``."""
        return (-(-self.log_time).exp()).exp()

    @property
    def variance(self) -> Tensor:
        """Returns the variance of the process noise, ``[K]``, that keeps the biases stationary."""
        return (2 * self.log_std).exp() * -torch.expm1(-2 * (-self.log_time).exp())

    def augmented(
        self,
        transition: TensorDictModuleBase,
        observation: TensorDictModuleBase,
        process_noise: TensorDictModuleBase | Sequence[float] | float | None,
        initial: TensorDictModuleBase,
        reading_space: Space | None = None,
    ) -> tuple[BiasedTransition, BiasedObservation, BiasedNoise, BiasedBelief]:
        """Augments each part of a filter by the same biases.

        Args:
            transition: moves ensembles of the state.
            observation: observes them.
            process_noise: of the state; ``None`` for none, where the transition has its own.
            initial: the belief of the state.
            reading_space: in which the sensor's reading lives; ``None`` for plain numbers.

        Returns:
            Transition, observation, process noise and initial belief of the state with the biases behind it.

        Raises:
            ValueError: if the state or the reading lives in a space of other than numbers and angles.
        """
        start = role(initial, Initial)
        space = start.space
        if space is not None:
            raise ValueError(
                f"sensor_error is for states of plain numbers, not for {space}: put the biases into the state, "
                "Product(..., Euclidean(K))."
            )
        if not is_flat(reading_space):
            raise ValueError(
                f"sensor_error is added to readings of numbers and angles, not to points of {reading_space}."
            )
        nothing = torch.zeros_like(self.std[0]).detach()
        of_state = as_process_noise(nothing if process_noise is None else process_noise, start.state_dim)
        return (
            BiasedTransition(transition, self),
            BiasedObservation(observation, self),
            BiasedNoise(of_state, self),
            BiasedBelief(initial, self),
        )

    @torch.no_grad()
    def augmented_matrices(
        self, f: Tensor, h: Tensor, q: Tensor, mean: Tensor, cov: Tensor, control: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor | None]:
        """Returns F, H, Q, mean, covariance and B of a linear system with the biases behind its state, as they are now.

        Args:
            f: ``[S, S]``.
            h: ``[O, S]``.
            q: ``[S, S]``, or variances ``[S]``.
            mean: of the initial belief, ``[S]``.
            cov: of the initial belief, ``[S, S]``.
            control: B, ``[S, A]``; ``None`` for none.

        Raises:
            ValueError: if there are not as many biases for each component of the reading, or they are factors.
        """
        count = len(self)
        if self.factor or count % len(h):
            raise ValueError(
                f"A KalmanFilter takes as many biases for each of the {len(h)} components of the reading, and no "
                f"factors; sensor_error has {count}{' factors' if self.factor else ''}. Take an EKF."
            )
        decay, variance, std = (value.to(f.dtype) for value in (self.decay, self.variance, self.std))
        own = torch.eye(len(h), dtype=f.dtype, device=f.device).repeat(1, count // len(h))
        q = torch.block_diag(q.diag() if q.ndim == 1 else q, variance.diag())
        f, cov = torch.block_diag(f, decay.diag()), torch.block_diag(cov, std.square().diag())
        control = None if control is None else nn.functional.pad(as_floating(control), (0, 0, 0, count))
        return f, torch.cat([h, own], -1), q, torch.cat([mean, torch.zeros_like(decay)]), cov, control


class BiasedTransition(Wrapper, Transition):
    """Augments a transition of S components by fading biases.

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

    place = "transition"

    def __init__(self, transition: TensorDictModuleBase, bias: FadingBias):
        super().__init__(transition)
        self.bias = bias

    def on_entries(self, entries, call):
        """Returns the forecast of both, and whatever else the transition writes."""
        key, out_key = unravel_key(self.in_keys[0]), unravel_key(self.out_keys[0])
        state, slow = _split(self.required(entries, key), self.bias, self)
        written = self.run_inside({**entries, key: state}, call)
        return {**written, out_key: torch.cat([written[out_key], self.bias.decay * slow], -1)}

    def linearised(self, entries, call):
        """Returns the Jacobian of the transition, and behind it the decay."""
        found = _linearised(self, self.bias, entries, call.part(self.place))
        if found is None:
            return None
        (written, matrix, slow), count, out_key = found, len(self.bias), unravel_key(self.out_keys[0])
        decay = self.bias.decay.diag_embed().expand(*matrix.shape[:-2], count, count)
        rows = nn.functional.pad(matrix, (0, count)), nn.functional.pad(decay, (matrix.shape[-1], 0))
        moved = torch.cat([written[out_key], self.bias.decay * slow], -1)
        return {**written, out_key: moved}, torch.cat(rows, -2), None


class BiasedNoise(Wrapper):
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

    place = "noise"

    def __init__(self, noise: TensorDictModuleBase, bias: FadingBias):
        super().__init__(noise)
        self.bias = bias

    def on_entries(self, entries, call):
        """Returns Q of both."""
        out, key = self.run_inside(entries, call), unravel_key(self.out_keys[0])
        of_state, slow = out[key], self.bias.variance.to(out[key].dtype)
        if of_state.ndim == len(call.batch_size) + 1:
            return {**out, key: torch.cat([of_state, slow.expand(*of_state.shape[:-1], -1)], -1)}
        size, count = of_state.shape[-1], len(slow)
        corner = slow.diag_embed().expand(*of_state.shape[:-2], -1, -1)
        rows = nn.functional.pad(of_state, (0, count)), nn.functional.pad(corner, (size, 0))
        return {**out, key: torch.cat(rows, -2)}


class BiasedObservation(Wrapper):
    """Predicts the observation of the state, plus the biases of its sensor.

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

    place = "observation"

    def __init__(self, observation: TensorDictModuleBase, bias: FadingBias, dims: Sequence[int] | None = None):
        if dims is not None and len(dims) != len(bias):
            raise ValueError(f"dims names {len(dims)} components of the reading, and there are {len(bias)} biases")
        super().__init__(observation)
        self.bias = bias
        self.register_buffer("dims", None if dims is None else torch.tensor(list(dims)), persistent=False)

    def on_entries(self, entries, call):
        """Returns the predicted observations."""
        key, out_key = unravel_key(self.in_keys[0]), unravel_key(self.out_keys[0])
        state, slow = _split(self.required(entries, key), self.bias, self)
        written = self.run_inside({**entries, key: state}, call)
        read, own = written[out_key], self._own(slow, written[out_key])
        return {**written, out_key: read * (1 + own) if self.bias.factor else read + own}

    def linearised(self, entries, call):
        """Returns the Jacobian of the model, and behind it that by the biases."""
        found = _linearised(self, self.bias, entries, call.part(self.place))
        if found is None:
            return None
        (written, matrix, slow), count, out_key = found, len(self.bias), unravel_key(self.out_keys[0])
        read, own = written[out_key], self._own(slow, written[out_key])
        by_bias = self._own(torch.eye(count, dtype=read.dtype, device=read.device), read).mT
        if self.bias.factor:
            matrix, by_bias = (1 + own).unsqueeze(-1) * matrix, read.unsqueeze(-1) * by_bias
        by_bias = by_bias.expand(*matrix.shape[:-1], count)
        read = read * (1 + own) if self.bias.factor else read + own
        return {**written, out_key: read}, torch.cat([matrix, by_bias], -1), None

    def _own(self, slow: Tensor, read: Tensor) -> Tensor:
        """Sums up the biases ``[*, K]`` of each component of the reading, ``[*, O]``."""
        size = read.shape[-1]
        if self.dims is not None:
            return slow.new_zeros(*slow.shape[:-1], size).index_add(-1, self.dims, slow)
        if len(self.bias) % size:
            raise ValueError(
                f"{len(self.bias)} biases are not as many for each of the {size} components of the reading; "
                "say in dims which component each belongs to"
            )
        return slow.unflatten(-1, (-1, size)).sum(-2)


class BiasedBelief(AroundInitial):
    """The initial belief of a state, and of the biases behind it: independent, with mean 0 and ``FadingBias.std``.

    Args:
        initial: of the state: an ensemble, or a mean and a covariance; its keys are kept.
        bias: shared with the transition.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import MomentPrior
        >>> start = BiasedBelief(MomentPrior(torch.zeros(1), torch.eye(1)), FadingBias([2.0], time=5.0))
        >>> start(TensorDict({}))["belief", "cov"]
        tensor([[1., 0.],
                [0., 4.]], grad_fn=...)
    """

    place = "initial"
    derived = Initial.derived  # the module inside knows entries of another size

    def __init__(self, initial: TensorDictModuleBase, bias: FadingBias):
        check_module("initial", initial)
        super().__init__(initial)
        self.bias, told = bias, role(initial, Initial)
        self.input_dim = told.input_dim or told.state_dim
        self.state_dim = None if told.state_dim is None else told.state_dim + len(bias)

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Names the draws of an ensemble's biases."""
        return ("",) if any(map(is_samples, self.out_keys)) else ()

    def draw_noise(self, batch_size, *, members=None, device=None, dtype=None, generator=None, **_):
        """Draws standard-normal values ``[*batch_size, E, K]``."""
        members = self.ensemble_size if members is None else members
        if members is None:
            return None
        return torch.randn((*batch_size, members, len(self.bias)), device=device, dtype=dtype, generator=generator)

    def noise_sizes(self, ensemble, *_):
        """Returns E, from the ensemble of the state."""
        return {"members": ensemble.shape[-2]}

    def on_entries(self, entries, call):
        """Returns the belief of both."""
        written = dict(self.run_inside(entries, call))
        names = {key[-1]: key for key in map(unravel_key, self.out_keys)}
        std, size = self.bias.std, call.batch_size
        if "ensemble" in names:
            ensemble = written[names["ensemble"]]
            noise = cast(Tensor, self._noise(entries, [ensemble], call._replace(sample=True)))
            noise = noise.to(ensemble.dtype)
            noise = noise if "log_weight" in names else exact_draws(noise, ensemble)
            ensemble = torch.cat([ensemble, std.to(ensemble.dtype) * noise], -1)
            kind = Particles() if "log_weight" in names else Ensemble()
            now = {"ensemble": ensemble, **{name: written[key] for name, key in names.items() if name == "log_weight"}}
            now |= {name: cast(Tensor, kind.derived(name, *now.values())) for name in ("mean", "var")}
        else:
            mean, cov = (written[names[name]] for name in ("mean", "cov"))
            std, count = std.to(mean.dtype), len(std)
            corner = std.square().diag_embed().expand(*size, count, count)
            rows = nn.functional.pad(cov, (0, count)), nn.functional.pad(corner, (cov.shape[-1], 0))
            cov = torch.cat(rows, -2)
            now = {"mean": nn.functional.pad(mean, (0, count)), "cov": cov, "var": cov.diagonal(dim1=-2, dim2=-1)}
        return {**written, **{names[name]: value for name, value in now.items() if name in names}}


def _autocovariance(values: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Returns means of products of values ``[N, T]`` at lags 0, 1, ... and their counts."""
    values, steps = torch.where(known, values, 0), values.shape[1]
    products, counts = [], []
    for lag in range(min(steps, 1000)):
        both = known[:, lag:] & known[:, : steps - lag]
        products.append((values[:, lag:] * values[:, : steps - lag]).sum())
        counts.append(both.sum())
    count = torch.stack(counts)
    return torch.stack(products) / count.clamp_min(1), count


def _fit(covariance: Tensor, count: Tensor, component: int, per_run: bool) -> tuple[float, float, float, float]:
    """Fits standard deviation and time of the fading part, standard deviations of the white and of a run's part."""
    if count[1] < 100:
        raise ValueError(f"component {component} has {int(count[1])} pairs of neighbouring residuals; it takes 100")
    longest = len(covariance)
    # What fades more slowly than half a run cannot be told from what is the same for all of it.
    slowest = longest / 2 if per_run else 100 * longest
    times = torch.logspace(math.log10(0.5), math.log10(slowest), 2000, dtype=torch.double)
    lags, size, whole, last = torch.arange(longest, dtype=torch.double), 0.0, 0.0, longest
    for _ in range(1 if per_run else 3):
        shape = torch.exp(-lags[1:last] / times.unsqueeze(-1))
        weight = count[1:last] / count[1:last].sum()
        level, seen = torch.zeros_like(times), covariance[1:last].expand(len(times), -1)
        if per_run:  # the least squares of both parts, or of what fades alone where the other would be negative
            middle, mean = (weight * shape).sum(-1), (weight * seen).sum(-1)
            centred = shape - middle.unsqueeze(-1)
            sizes = ((weight * centred * seen).sum(-1) / (weight * centred.square()).sum(-1)).clamp_min(0)
            level = (mean - sizes * middle).clamp_min(0)
            seen = seen - level.unsqueeze(-1)
        sizes = ((weight * shape * seen).sum(-1) / (weight * shape.square()).sum(-1)).clamp_min(0)
        best = (weight * (seen - sizes.unsqueeze(-1) * shape).square()).sum(-1).argmin()
        size, time, whole = float(sizes[best]), float(times[best]), float(level[best])
        last = min(longest, max(4, math.ceil(3 * time) + 1))  # later lags are of chance alone
    # Within three standard errors of what white noise shows from one step to the next there is nothing to estimate.
    if not size * math.exp(-1 / time) + whole > 3 * float(covariance[0]) / math.sqrt(float(count[1])):
        raise ValueError(f"the residuals of component {component} do not last: take them for white noise")
    least, white = 1e-6 * (size + whole), float(covariance[0]) - size - whole
    return math.sqrt(max(size, least)), time, math.sqrt(max(white, least)), math.sqrt(max(whole, least))


def _linearised(
    wrapper: Wrapper, bias: FadingBias, entries: Entries, inside: Call
) -> tuple[Entries, Tensor, Tensor] | None:
    """Returns the inside module's outputs, its Jacobian by the state, and the biases; ``None`` if not known."""
    key = unravel_key(wrapper.in_keys[0])
    state, slow = _split(wrapper.required(entries, key), bias, wrapper)
    found = linearise(wrapper.module, {**entries, key: state}, inside)
    return None if found is None or not is_flat(*found[2] or ()) else (found[0], found[1], slow)


def _split(state: Tensor, bias: FadingBias, module: nn.Module) -> tuple[Tensor, Tensor]:
    """Returns the system's part of a state, and the biases."""
    count = len(bias)
    if state.shape[-1] <= count:
        raise ValueError(
            f"{type(module).__name__} splits a state of {state.shape[-1]} into the system's and {count} biases: "
            "the initial belief must hold both"
        )
    return state[..., :-count], state[..., -count:]
