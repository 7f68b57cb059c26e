"""A baseline: a plain, hand-written DEnKF step in torch, as in the code of a paper."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from benchmarks.speed.workload import RATE
from torch_denkf.filters import DEnKF


def network(layers: list[tuple], rate: float) -> nn.Sequential:
    """Returns linear layers with ReLU and, with a rate, dropout between them."""
    parts: list[nn.Module] = []
    for index, (weight, bias) in enumerate(layers):
        linear = nn.Linear(weight.shape[1], weight.shape[0])
        with torch.no_grad():
            linear.weight.copy_(torch.as_tensor(weight))
            linear.bias.copy_(torch.as_tensor(bias))
        parts.append(linear)
        if index < len(layers) - 1:
            parts.append(nn.ReLU())
            if rate:
                parts.append(AlwaysDropout(rate))
    return nn.Sequential(*parts)


class AlwaysDropout(nn.Module):
    """Dropout that is active in any mode."""

    def __init__(self, rate: float):
        super().__init__()
        self.rate = rate

    def forward(self, x: Tensor) -> Tensor:
        """Drops units and rescales the rest."""
        return F.dropout(x, self.rate, training=True)


class Textbook(nn.Module):
    """DEnKF step: forecast, predicted observation, noise, gain by Cholesky, update; ``[B, E, ...]``."""

    def __init__(self, layers: dict[str, list], variance: Tensor, floor: Tensor):
        super().__init__()
        self.transition = network(layers["transition"], RATE)
        self.observation = network(layers["observation"], 0.0)
        self.noise = network(layers["noise"], 0.0)
        self.variance, self.floor = nn.Buffer(variance), nn.Buffer(floor)

    @classmethod
    def of(cls, filter: DEnKF) -> Textbook:
        """Makes the step with the weights of a filter of :mod:`benchmarks.speed.workload`."""
        from benchmarks.speed.workload import noise_floor, weights

        return cls(weights(filter), *map(torch.as_tensor, noise_floor(filter)))

    def step(self, ensemble: Tensor, samples: Tensor) -> tuple[Tensor, Tensor]:
        """Maps the members at t-1 and the sensor's samples at t to the members and their mean at t."""
        forecast = ensemble + self.transition(ensemble)
        predicted = self.observation(forecast)
        r = self.variance * (1 + self.noise(samples.mean(-2))) ** 2 + self.floor
        anomalies = forecast - forecast.mean(-2, keepdim=True)
        observed = predicted - predicted.mean(-2, keepdim=True)
        count = ensemble.shape[-2] - 1
        innovation_cov = observed.mT @ observed / count + torch.diag_embed(r)
        gain = torch.cholesky_solve(observed.mT @ anomalies / count, torch.linalg.cholesky(innovation_cov))
        analysis = forecast + (samples - predicted) @ gain
        return analysis, analysis.mean(-2)

    def sequence(self, ensemble: Tensor, samples: Tensor) -> tuple[Tensor, Tensor]:
        """Steps over ``samples`` ``[B, T, E, O]``; returns ensembles ``[B, T, E, S]`` and means."""
        ensembles, means = [], []
        for frame in samples.unbind(1):
            ensemble, mean = self.step(ensemble, frame)
            ensembles.append(ensemble)
            means.append(mean)
        return torch.stack(ensembles, 1), torch.stack(means, 1)
