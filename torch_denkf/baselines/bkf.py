"""The Backprop KF (Haarnoja et al. 2016): a Kalman filter with a learned sensor that also predicts its noise."""

from __future__ import annotations

from typing import Any, Unpack

import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf._checks import check_covariance, check_one_dtype, check_shape, check_square, check_values
from torch_denkf.filters import Filter
from torch_denkf.filters.parts import FilterParts, ReadingOptions, check_moments
from torch_denkf.modules.kalman import KalmanAnalysis, LinearTransition
from torch_denkf.modules.tensors import as_floating
from torch_denkf.submodel import Initial, role

__all__ = ["BackpropKF"]


class BackpropKF(Filter):
    r"""Linear-Gaussian filter of :math:`x_t = A x_{t-1} + B a + N(0, Q)`, :math:`z_t = C x_t + N(0, R_t)`.

    A sensor network reads :math:`z_t` from the frame and a noise network :math:`R_t`; both are trained through the
    filter's recursion. For a nonlinear motion, such as a vehicle's, give an :class:`~torch_denkf.filters.EKF` the same
    sensor and noise modules; likewise for orientations, for which no linear transition exists. The belief is that of
    :class:`~torch_denkf.filters.KalmanFilter`.

    Args:
        transition: A, ``[S, S]``.
        sensor: writes ``("sensor", "ensemble")`` ``[*B, E, O]``, whose mean is :math:`z_t`; ``None`` if the tensordict
            has it under ``observation_key``.
        observation: C, ``[O, S]``.
        noise: writes R: variances (:class:`~torch_denkf.modules.DiagonalNoise`) or a covariance
            (:class:`~torch_denkf.modules.CholeskyNoise`), usually from the sensor's encoding.
        process_noise_cov: Q, ``[S, S]``, or a module that writes it, e.g.
            :class:`~torch_denkf.modules.CholeskyNoise`.
        initial: the initial belief: :class:`~torch_denkf.modules.MomentPrior`,
            :class:`~torch_denkf.modules.GaussianAround`.
        control: B, ``[S, A]``; ``None`` for none.
        trainable: whether A and B are parameters.
        inflation: factor on the belief's standard deviations, in elements with an observation.
        **options: ``reading_space``, ``observation_key``, ``observed_key``, ``visibility`` and what every filter takes,
            see :class:`~torch_denkf.filters.parts.ReadingOptions`. Of ``control_keys`` the first drives the transition
            if ``control`` is given.

    Raises:
        ValueError: if the shapes do not fit, or the state or the reading lives in a space.

    Reference:
        Haarnoja, Ajay, Levine, Abbeel, "Backprop KF: learning discriminative deterministic state estimators", 2016,
        arXiv:1605.07148.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import CholeskyNoise, MomentPrior, VectorSensor
        >>> sensor = VectorSensor(4, 2, ensemble_size=1, layer="none", in_key="features")
        >>> r = CholeskyNoise(2, constant=False, in_features=4, in_key="features", out_key=("sensor", "noise"))
        >>> prior = MomentPrior(torch.zeros(2), torch.eye(2))
        >>> bkf = BackpropKF(torch.eye(2), sensor, torch.eye(2), r, process_noise_cov=0.1 * torch.eye(2), initial=prior)
        >>> bkf.sequence(TensorDict({"features": torch.randn(3, 5, 4)}, [3, 5]))["belief", "mean"].shape
        torch.Size([3, 5, 2])
    """

    def __init__(
        self,
        transition: torch.Tensor,
        sensor: TensorDictModuleBase | None,
        observation: torch.Tensor,
        noise: TensorDictModuleBase,
        *,
        process_noise_cov: torch.Tensor | TensorDictModuleBase,
        initial: TensorDictModuleBase,
        control: torch.Tensor | None = None,
        trainable: bool = False,
        inflation: float = 1.0,
        **options: Unpack[ReadingOptions],
    ):
        if options.get("sensor_error") is not None:
            raise TypeError("BackpropKF takes no sensor_error: KalmanFilter and EKF do.")
        a, c = as_floating(transition, "transition"), as_floating(observation, "observation")
        check_square("transition", a)
        check_shape("observation", c, (len(c) if c.ndim else 0, len(a)), "[O, S]")
        check_one_dtype(transition=a, observation=c)
        space = role(initial, Initial).space
        if space is not None:
            raise ValueError(
                f"BackpropKF moves plain numbers by a matrix, and the initial belief is of points of {space}. Give the "
                "same sensor and noise to an EKF, with a motion and an observation model of points."
            )
        check_values("transition", a)
        check_values("observation", c)
        if not isinstance(process_noise_cov, nn.Module):
            check_covariance("process_noise_cov", as_floating(process_noise_cov, "process_noise_cov"), len(a))
        action: dict[str, Any] = {}
        if control is not None:
            action = {"control": control, "action_key": options.get("control_keys", ("action",))[0]}
        forecast = LinearTransition(transition, process_noise_cov, trainable=trainable, **action)
        parts = FilterParts(forecast, sensor, None, noise, initial=initial, optional=["observation"], **options)
        check_moments(type(self).__name__, initial)
        update = KalmanAnalysis(observation, None, inflation=inflation, **parts.reading())
        super().__init__(parts.in_order(transition=forecast, analysis=update), initial=initial, **parts.options)
