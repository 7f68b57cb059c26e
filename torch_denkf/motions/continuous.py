r"""Motion in continuous time: steps of any length, whose seconds stand in an entry of the data."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf._checks import check_covariance, check_square, check_values
from torch_denkf.modules.around import Wrapper
from torch_denkf.modules.tensors import as_floating, register_constant
from torch_denkf.motions.discretisation import discretise
from torch_denkf.submodel import SubModel, Transition

__all__ = ["ContinuousMotion", "ContinuousNoise", "NoisePerSecond"]


class ContinuousMotion(Transition):
    r"""A linear motion :math:`dx = A x\,dt` over the seconds since the last step.

    Args:
        drift: A, ``[S, S]``, per second.
        trainable: whether A is a parameter.
        dt_key: seconds since the last step, ``[*B, 1]``.
        in_key: ensemble ``[*B, E, S]``.
        out_key: forecast ensemble ``[*B, E, S]``.

    Raises:
        ValueError: if A is not square, or not finite.

    Example:
        >>> from tensordict import TensorDict
        >>> glide = ContinuousMotion(torch.tensor([[0.0, 1.0], [0.0, 0.0]]))
        >>> td = TensorDict({"belief": {"ensemble": torch.tensor([[0.0, 3.0]])}, "dt": torch.tensor([0.5])})
        >>> glide(td)["forecast", "ensemble"]
        tensor([[1.5000, 3.0000]])
    """

    def __init__(
        self,
        drift: torch.Tensor,
        *,
        trainable: bool = False,
        dt_key: NestedKey = "dt",
        in_key: NestedKey = ("belief", "ensemble"),
        out_key: NestedKey = ("forecast", "ensemble"),
    ):
        super().__init__(nn.Identity(), [in_key, dt_key], [out_key])
        drift = as_floating(drift, "drift")
        check_square("drift", drift)
        check_values("drift", drift)
        register_constant(self, "drift", drift, trainable=trainable)

    def compute(self, ensemble, dt):
        """Returns the forecast ensemble."""
        motion, _ = discretise(self.drift, torch.zeros_like(self.drift), dt.to(self.drift.dtype))
        return ensemble @ motion.mT


class ContinuousNoise(SubModel):
    r"""Process noise of a :class:`ContinuousMotion`: Q of :math:`dx = A x\,dt + d\beta` over the step's seconds.

    Args:
        motion: A.
        density: spectral density of the Brownian motion :math:`\beta`, ``[S, S]``: a covariance per second.
        dt_key: seconds since the last step, ``[*B, 1]``.
        out_key: Q, ``[*B, S, S]``.

    Raises:
        ValueError: if ``density`` is no covariance of the motion's size.

    Example:
        >>> from tensordict import TensorDict
        >>> glide = ContinuousMotion(torch.tensor([[0.0, 1.0], [0.0, 0.0]]))
        >>> push = ContinuousNoise(glide, torch.diag(torch.tensor([0.0, 3.0])))
        >>> push(TensorDict({"dt": torch.tensor([1.0])}))["forecast", "noise"]
        tensor([[1.0000, 1.5000],
                [1.5000, 3.0000]])
    """

    def __init__(
        self,
        motion: ContinuousMotion,
        density: torch.Tensor,
        *,
        dt_key: NestedKey = "dt",
        out_key: NestedKey = ("forecast", "noise"),
    ):
        super().__init__(motion, [dt_key], [out_key])
        density = as_floating(density, "density")
        check_covariance("density", density, len(motion.drift))
        register_constant(self, "density", density)

    def compute(self, dt):
        """Returns the covariance."""
        drift = self.module.drift
        return discretise(drift, self.density, dt.to(drift.dtype))[1]


class NoisePerSecond(Wrapper):
    r"""Multiplies the variances of another process noise, which are per second, by the seconds since the last step.

    It is the noise of a random walk, for motions that read their own ``dt``. Put it inside of a module that maps the
    noise of velocities to that of the state.

    Args:
        noise: writes variances ``[*B, N]`` or a covariance ``[*B, N, N]`` per second; its keys are kept.
        dt_key: seconds since the last step, ``[*B, 1]``.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import ConstantNoise
        >>> noise = NoisePerSecond(ConstantNoise([2.0], in_key="dt"))
        >>> noise(TensorDict({"dt": torch.tensor([0.5])}))["sensor", "noise"]
        tensor([2.])
    """

    place = "noise"

    def __init__(self, noise: TensorDictModuleBase, *, dt_key: NestedKey = "dt"):
        super().__init__(noise, further_keys=[dt_key])
        self.dt_key = dt_key

    def on_entries(self, entries, call):
        """Returns the variances or the covariance of the step."""
        written, key = self.run_inside(entries, call), self.out_keys[0]
        noise, dt = written[key], self.required(entries, self.dt_key)
        return {**written, key: noise * (dt if noise.ndim == dt.ndim else dt.unsqueeze(-1)).to(noise.dtype)}
