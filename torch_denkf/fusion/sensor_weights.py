r"""Learned weights of sensors, computed from features and innovations of their readings."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from tensordict import NestedKey, unravel_key
from torch import Tensor, nn

from torch_denkf._checks import check_count, check_number
from torch_denkf.functional.linalg import semidefinite_root
from torch_denkf.functional.manifolds import Space
from torch_denkf.functional.moments import ensemble_mean, ensemble_var
from torch_denkf.fusion.parts import StateObservation
from torch_denkf.modules.spaces import narrowed_mask
from torch_denkf.modules.tensors import mean_of_members
from torch_denkf.running import reads
from torch_denkf.submodel import Sensor

__all__ = ["SensorAttention", "SensorWeights", "WeightedNoise"]


class SensorAttention(nn.Module):
    r"""Computes a weight in (0, 1) for each sensor by attention; before training it is 1 up to 2 %.

    The token of sensor m contains its innovation in standard deviations, :math:`e_m = (y_m - h_m(\bar x)) /
    \sqrt{\mathrm{Var}\,h_m(X) + R_m}`, and its features :math:`\varphi_m`. The tokens of observed sensors attend to
    each other; the weight is computed from a token and its context:

    .. math::
        z_m &= f_m(e_m, \log(1 + e_m^2), \varphi_m), \quad
        c_m = \sum_n \mathrm{softmax}_n\!\left(\frac{(W_q z_m)^T W_k z_n}{\sqrt D}\right) W_v z_n \\
        w_m &= w_0 + (1 - w_0)\,\sigma(g(z_m, c_m) + 4 - a_m \log(1 + \overline{e_m^2}))

    A sensor's weight thus depends on its agreement with the forecast, and on the other sensors' readings of the same
    time. The filter divides R by the weight: a weight of 0.01 means ten times the standard deviation.

    It learns only from failures in its recordings: add the expected ones. Leave a sensor out of some windows, so that
    the others learn to do without it. A window must contain several readings of the slowest sensor: for a GPS at 1 Hz
    one second is too short. The initial belief of a window must be consistent: a filter that starts with a large error
    learns to trust any reading that corrects it. Useful features are the spread of the sensor's last readings, in its
    standard deviations, and the number of equal readings.

    Args:
        observations: O of each sensor, by name, in the order of the filter's sensors.
        features: number of features of each sensor with features.
        size: D, size of a token.
        floor: :math:`w_0`, the smallest weight. A sensor with this weight still corrects the belief a little, so that
            it can recover. A thousand readings of weight 0.001 count as one of full weight: use a smaller floor if a
            sensor has a much higher rate or precision than the others.
        slope: a, before training; 0 leaves the term out. A filter that has followed a faulty sensor has small
            innovations, from which a loss cannot teach the weights. With a slope of 2, a reading with an innovation of
            three standard deviations has a weight of a third before training, one with ten has a weight of 0.005.

    Raises:
        ValueError: if a size is not positive, the floor is outside (0, 1), or features are of no sensor.

    Reference: Based on the attention gain of Liu, Zhou, Ikemoto, Ben Amor, "alpha-MDF: an attention-based multimodal
        differentiable filter for robot state estimation", CoRL 2023. There attention replaces the Kalman gain; here it
        scales the noise, and the filter's update does not change.

    Example:
        >>> attention = SensorAttention({"camera": 2, "wheel": 1})
        >>> innovations = {"camera": torch.zeros(4, 2), "wheel": torch.full((4, 1), 9.0)}
        >>> attention(innovations, torch.ones(4, 2, dtype=torch.bool), {}).shape
        torch.Size([4, 2])
    """

    def __init__(
        self,
        observations: Mapping[str, int],
        *,
        features: Mapping[str, int] | None = None,
        size: int = 16,
        floor: float = 1e-3,
        slope: float = 0.0,
    ):
        super().__init__()
        features = dict(features or {})
        unknown = [name for name in features if name not in observations]
        if unknown:
            raise ValueError(f"features names {unknown}; the sensors are {list(observations)}.")
        for name, count in {**observations, **features, "size": size}.items():
            check_count(name, count)
        check_number("floor", floor, above=0, below=1)
        check_number("slope", slope, least=0)
        self.names, self.floor = tuple(observations), floor
        self.slope = nn.Parameter(torch.full((len(self.names),), float(slope))) if slope else None
        self.embed = nn.ModuleDict(
            {
                name: nn.Sequential(nn.Linear(2 * count + features.get(name, 0), size), nn.ELU(), nn.Linear(size, size))
                for name, count in observations.items()
            }
        )
        self.query, self.key, self.value = (nn.Linear(size, size, bias=False) for _ in range(3))
        first, last = nn.Linear(2 * size, size), nn.Linear(size, 1)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.score = nn.Sequential(first, nn.ELU(), last)

    def forward(self, innovations: Mapping[str, Tensor], observed: Tensor, features: Mapping[str, Tensor]) -> Tensor:
        """Returns the weights.

        Args:
            innovations: innovation of each sensor in standard deviations, ``[*B, O]``; 0 if not observed.
            observed: mask of observed sensors, ``[*B, M]``.
            features: features of the sensors that have any, ``[*B, F]``.

        Returns:
            ``[*B, M]``, in the order of the sensors.
        """
        tokens = []
        for name in self.names:
            # asinh compresses instead of clamping, so that outliers have a gradient, too.
            value = innovations[name].asinh()
            parts = [value, innovations[name].square().log1p()]
            tokens.append(self.embed[name](torch.cat([*parts, *([features[name]] if name in features else [])], -1)))
        token = torch.stack(tokens, -2)
        match = self.query(token) @ self.key(token).mT / math.sqrt(token.shape[-1])
        # A sensor always attends to itself, so that the softmax is finite if nothing is observed.
        seen = observed.unsqueeze(-2) | torch.eye(len(self.names), dtype=torch.bool, device=observed.device)
        context = match.masked_fill(~seen, -torch.inf).softmax(-1) @ self.value(token)
        score = self.score(torch.cat([token, context], -1)).squeeze(-1)
        if self.slope is not None:
            wrong = torch.stack([innovations[name].square().mean(-1).log1p() for name in self.names], -1)
            score = score - self.slope * wrong
        return self.floor + (1 - self.floor) * (score + 4).sigmoid()


class SensorWeights(Sensor):
    """Computes the weights of all sensors from the forecast, before any update.

    :class:`torch_denkf.fusion.FusedFilter` adds it.

    Args:
        network: maps innovations, masks and features to weights, e.g. :class:`SensorAttention`.
        models: observation models of the sensors, by name.
        readings: readings ``[*B, O]``, or samples ``[*B, E, O]``.
        noises: variances ``[*B, O]`` or covariances ``[*B, O, O]``.
        features: entries ``[*B, F]`` of the sensors that have any.
        spaces: space of each reading, of vectors and angles; ``None`` for vectors.
        state_key: the forecast's ensemble; with ``moments``, key for its sigma points.
        moments: prefix of the forecast's ``mean`` and ``cov``; ``None`` for an ensemble.
        weight_key: prefix of the weights ``[*B, 1]``, by the sensors' names.
    """

    joins_readings = True  # a reading that is left out leaves out this module

    def __init__(
        self,
        network: nn.Module,
        models: Mapping[str, StateObservation],
        readings: Mapping[str, NestedKey],
        noises: Mapping[str, NestedKey],
        features: Mapping[str, NestedKey],
        spaces: Mapping[str, Space | None],
        *,
        state_key: NestedKey,
        moments: str | None = None,
        weight_key: str = "weight",
    ):
        given = {unravel_key(state_key)} if moments is not None else set()
        needed: dict[NestedKey, None] = {}
        optional: dict[NestedKey, None] = {}
        for model in models.values():
            must, may = reads(model)
            needed.update((key, None) for key in must if key not in given)
            optional.update((key, None) for key in may)
        keys = [(moments, "mean"), (moments, "cov")] if moments is not None else []
        keys += [*readings.values(), *noises.values(), *features.values()]
        super().__init__(
            nn.ModuleDict({"network": network, "models": nn.ModuleDict(models)}),
            list(dict.fromkeys([*map(unravel_key, keys), *needed])),
            [(weight_key, name) for name in models],
            optional_keys=list(optional),
        )
        self.readings, self.noises, self.features = (
            {name: unravel_key(key) for name, key in keys.items()} for keys in (readings, noises, features)
        )
        self.spaces, self.moments, self.state_key = dict(spaces), moments, unravel_key(state_key)

    def on_entries(self, entries, call):
        """Returns the weights."""
        if self.moments is not None:
            mean, cov = (self.required(entries, (self.moments, name)) for name in ("mean", "cov"))
            size = next((model.state_dim for model in self.module["models"].values()), None)
            points = _points(mean, cov, mean.shape[-1] if size is None else size)
            entries = {**entries, self.state_key: points}
        size, innovations, seen = len(call.batch_size), {}, []
        for name, model in self.module["models"].items():
            reading = self.required(entries, self.readings[name])
            noise = self.required(entries, self.noises[name])
            variance = noise if noise.ndim == size + 1 else noise.diagonal(dim1=-2, dim2=-1)
            predicted, observed = model.seen(entries, call._replace(sample=False).part(name))
            if (space := self.spaces[name]) is not None:
                observed = narrowed_mask(space, observed)
                predicted, reading = space.align(predicted, reading, observed)
            reading, mean = mean_of_members(reading, call.batch_size), ensemble_mean(predicted)
            observed = (
                torch.ones_like(reading, dtype=torch.bool) if observed is None else observed.expand(reading.shape)
            )
            spread = (ensemble_var(predicted, mean) + torch.where(observed, variance, 1)).sqrt()
            innovations[name] = torch.where(observed, reading - mean, 0) / spread
            seen.append(observed.any(-1))
        features = {name: self.required(entries, key) for name, key in self.features.items()}
        return self.by_key(self.module["network"](innovations, torch.stack(seen, -1), features).split(1, -1))


class WeightedNoise(Sensor):
    """Divides a sensor's noise by its weight.

    Args:
        noise_key: variances ``[*B, O]`` or a covariance ``[*B, O, O]``.
        weight_key: weight ``[*B, 1]``.
        out_key: scaled noise, of the same shape.
        observation_dim: O, if it is known.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"noise": torch.tensor([1.0, 4.0]), "weight": torch.tensor([0.5])})
        >>> WeightedNoise("noise", "weight", "more")(td)["more"]
        tensor([2., 8.])
    """

    def __init__(
        self, noise_key: NestedKey, weight_key: NestedKey, out_key: NestedKey, *, observation_dim: int | None = None
    ):
        super().__init__(nn.Identity(), [noise_key, weight_key], [out_key])
        self.observation_dim = observation_dim

    def compute(self, variance, weight):
        """Returns the scaled noise."""
        return variance / (weight if variance.ndim == weight.ndim else weight.unsqueeze(-1))


def _points(mean: Tensor, cov: Tensor, size: int) -> Tensor:
    """Returns sigma points ``[*B, 2 S, N S]`` with the given mean and the covariance of each of N states.

    Covariances between the states are ignored: each sensor observes one state, and the joint covariance may be almost
    singular.
    """
    blocks = cov.unflatten(-1, (-1, size)).unflatten(-3, (-1, size)).diagonal(dim1=-4, dim2=-2).movedim(-1, -3)
    roots = semidefinite_root(blocks).mT.movedim(-3, -2).flatten(-2) * math.sqrt(size - 0.5)
    return mean.unsqueeze(-2) + torch.cat([roots, -roots], -2)
