"""The differentiable ensemble Kalman filter."""

from __future__ import annotations

from collections import OrderedDict

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from benchmarks.g1.recipes._base import G1Recipe, register
from torch_denkf.modules import AroundState, EnsembleAnalysis, NoisyTransition, SubModel

TAPER = 0.5  # factor on the covariances of different joints


def localisation(size: int, target: int, encoders: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Factors on the covariances of a state of ``size`` and the readings, and of the readings.

    An ensemble shows correlations of joints that are not there. Rates and biases go with their joint.
    """
    whose = [*range(target), *encoders]
    same = torch.tensor(whose).unsqueeze(-1) == torch.tensor(whose)
    readings = torch.where(same, 1.0, TAPER)
    return readings[:target].repeat(size // target, 1), readings


class WithEncoders(SubModel):
    """The camera's and the encoders' readings, one behind the other, with their noise and what was observed.

    Args:
        target: numbers that the camera reads.
        std: of the encoders' noise.
        encoders: how many there are.
    """

    def __init__(self, target: int, std: float, encoders: int):
        keys: list[NestedKey] = [("sensor", "ensemble"), ("sensor", "noise"), "encoders", "observed"]
        outs: list[NestedKey] = [("both", "ensemble"), ("both", "noise"), ("both", "observed")]
        super().__init__(nn.Identity(), keys, outs)
        self.target, self.variance, self.count = target, std**2, encoders

    def compute(self, samples, variance, encoders, observed, *, batch_size):
        """Samples ``[*B, E, O]``, variances ``[*B, O]`` and the mask ``[*B, O]``."""
        fixed = torch.full_like(variance[..., : self.count], self.variance)
        seen = observed.expand(*observed.shape[:-1], self.target)
        always = torch.ones_like(fixed, dtype=torch.bool)
        both = torch.cat([samples, encoders], -1), torch.cat([variance, fixed], -1), torch.cat([seen, always], -1)
        return both


@register
class DEnKF(G1Recipe):
    """The differentiable ensemble Kalman filter; innovations are those of the sensor's samples."""

    def modules(self):
        encoders = tuple(self.target.encoders) if self.encoders else ()
        keys = {}
        parts = OrderedDict(noise=self.noise())
        if encoders:
            parts["both"] = WithEncoders(self.target.size, self.target.encoder_std, len(encoders))
            keys = {
                "observation_key": ("both", "ensemble"),
                "noise_variance_key": ("both", "noise"),
                "observed_key": ("both", "observed"),
            }
        parts["transition"] = NoisyTransition(self.transition(), self.process_noise(), self.noisy, before=True)
        parts["observation"] = self.observation()
        parts["analysis"] = EnsembleAnalysis(
            "sensor", taper=localisation(self.size, self.target.size, encoders), **keys
        )
        return parts

    def belief(self, std):
        return AroundState(std, ensemble_size=self.members, state_key="start")

    def loss(self, model):
        loss = self.ensemble_loss(model)
        loss.set_keys(state="padded")
        return loss


@register
class DEnKFActions(DEnKF):
    """The same, told the commands."""

    actions = True


@register
class DEnKFEncoders(DEnKF):
    """The same, with noisy encoders of two joints."""

    encoders = True


@register
class ADEnKF(DEnKF):
    """Chen, Sanz-Alonso & Willett 2022: the same filter, trained by its readings' likelihood, without the truth."""

    fitted = False  # to the truth

    def loss(self, model):
        return self.likelihood_loss(model)
