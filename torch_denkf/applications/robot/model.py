"""A filter of robot_localization's fifteen states, as its YAML says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from torch_denkf.applications.robot.config import PLANE, Config, read_config
from torch_denkf.applications.robot.motion import ANGLES, STATES, Drifts, RobotMotion, RobotNoise, state_space
from torch_denkf.functional.manifolds import Circle, Euclidean, Product
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.modules import MomentPrior, UKFTransition
from torch_denkf.submodel import SubModel

__all__ = ["Drifted", "LearnedScale", "RobotModel", "robot_model"]

PLANE_VARIANCE = 1e-6  # of the zeros that are read in the plane


@dataclass(frozen=True)
class RobotModel:
    """A filter and its inputs.

    Attributes:
        filter: of the fifteen states; its rows have ``"dt"``, and for each sensor its readings, their mask and their
            covariance under NAME_noise, see :func:`torch_denkf.fusion.message_rows`.
        config: the settings.
        reads: by the name of each sensor of the filter, such as ``odom0_pose``: the states that it reads, in order.
        unheeded: what of the settings is not honoured, and why.
        drifts: the slow errors of readings, behind the fifteen states; ``None`` without any.
    """

    filter: FusedFilter
    config: Config
    reads: Mapping[str, tuple[int, ...]]
    unheeded: tuple[str, ...] = field(default=())
    drifts: Drifts | None = None

    def started(self, mean: Tensor, cov: Tensor) -> RobotModel:
        """Returns this model with another initial belief, ``[15]`` and ``[15, 15]``; drifts are as large as ever."""
        return replace(self, filter=self.filter.with_modules(initial=_initial(mean, cov, self.drifts)))

    def reading(self, name: str) -> Drifted:
        """Returns the observation model of a sensor."""
        return next(part for part in self.filter.modules() if isinstance(part, Drifted) and part.name == name)


class Drifted(SubModel):
    """The states that a sensor reads, each with its slow error: added to it, or a share of the forward speed as read.

    Args:
        name: of the sensor, and of its readings ``[*B, O]``.
        dims: the states, ``[O]``.
        slow: places of their errors in the state; ``None`` for none.
    """

    def __init__(self, name: str, dims: Sequence[int], slow: Sequence[int | None]):
        super().__init__(nn.Identity(), [("forecast", "ensemble"), name], [("forecast", "observation")])
        self.name, self.slow = name, tuple(slow)
        self.register_buffer("dims", torch.tensor(list(dims)), persistent=False)
        self.register_buffer("places", torch.tensor([0 if at is None else at for at in slow]), persistent=False)
        self.register_buffer("has", torch.tensor([at is not None for at in slow]), persistent=False)
        shares = [place == STATES.index("vx") and at is not None for place, at in zip(dims, slow, strict=True)]
        self.register_buffer("shares", torch.tensor(shares), persistent=False)

    def compute(self, ensemble, reading):
        """Returns the predicted reading."""
        return self.jacobian(ensemble, reading)[0]

    def jacobian(self, ensemble, reading):
        """Returns both: the Jacobian is linear, since a share is one of what was read, not of the state."""
        factor = torch.where(self.shares, reading.nan_to_num(), 1.0).to(ensemble.dtype) * self.has
        predicted = ensemble[..., self.dims] + factor.unsqueeze(-2) * ensemble[..., self.places]
        every = torch.arange(ensemble.shape[-1], device=ensemble.device)
        own, other = ((each.unsqueeze(-1) == every).to(ensemble.dtype) for each in (self.dims, self.places))
        return predicted, (own + factor.unsqueeze(-1) * other).unsqueeze(-3).expand(*predicted.shape, -1)


def _initial(mean: Tensor, cov: Tensor, drifts: Drifts | None) -> MomentPrior:
    if drifts is None:
        return MomentPrior(mean, cov, space=state_space())
    mean = nn.functional.pad(mean, (0, len(drifts)))
    return MomentPrior(mean, torch.block_diag(cov, drifts.variance.detach().diag()), space=state_space(len(drifts)))


class LearnedScale(SubModel):
    """Covariances of the messages, with learned factors on the standard deviations.

    Args:
        in_key: covariances of the data ``[*B, O, O]``.
        kept: how many readings, the last ones, are not scaled.
        size: O.
        dtype: of the scales.
    """

    def __init__(self, in_key: str, size: int, kept: int, dtype: torch.dtype):
        super().__init__(nn.Identity(), [in_key], [("sensor", "noise")])
        self.kept = kept
        self.log_scale = nn.Parameter(torch.zeros(size - kept, dtype=dtype))

    def compute(self, covariance):
        """Returns the scaled covariances."""
        scale = nn.functional.pad(self.log_scale, (0, self.kept)).exp().to(covariance.dtype)
        return covariance * scale * scale.unsqueeze(-1)


def robot_model(
    config: Mapping[str, Any] | str | Path,
    *,
    kind: Literal["ekf", "ukf"] = "ekf",
    dtype: torch.dtype = torch.float64,
) -> RobotModel:
    """Makes the filter that a configuration of robot_localization describes.

    Messages of an odometry are two sensors, its pose and its twist, and those of an inertial sensor three; each is
    weighted by the covariance in its row, and by its drifts. With ``two_d_mode`` each reads also zeros, of
    variance 1e-6, of what does not move in the plane. Poses of ``..._differential`` and ``..._relative`` sensors are
    those of the rows.

    Args:
        config: a YAML file, or its content. Four parameters of a sensor are this library's own: ``odom0_delay``, in s;
            ``odom0_variances``, fifteen, where messages bring no covariance; ``odom0_drifts``, fifteen standard
            deviations of coloured noise (that of a forward speed is a share of it), and ``odom0_drift_time``, in s, a
            number or fifteen.
        kind: the extended filter, or the unscented one, with ``alpha``, ``kappa`` and ``beta`` of the configuration.
        dtype: of all constants; float64, in which robot_localization calculates.

    Returns:
        The filter, and what of the configuration it does not honour.

    Raises:
        FileNotFoundError: without the file.
        ImportError: for a file, without PyYAML.
        ValueError: for settings that are none, or without a sensor.

    Example:
        >>> flags = [False] * 6 + [True, True] + [False] * 3 + [True] + [False] * 3
        >>> model = robot_model({"two_d_mode": True, "odom0": "/odom", "odom0_config": flags, "use_control": True})
        >>> model.reads["odom0_twist"][:3], model.unheeded
        ((6, 7, 11), ('use_control: there is no control here',))
    """
    settings = read_config(config)
    sensors, reads = {}, {}
    sizes: list[float] = []
    times: list[float] = []
    for sensor in settings.sensors:
        for group, places in sensor.groups.items():
            if settings.two_d:
                places = tuple(place for place in places if place not in PLANE)
            slow: list[int | None] = []
            for place in places:
                size = sensor.drifts[place] if sensor.drifts else 0.0
                slow.append(len(STATES) + len(sizes) if size > 0 else None)
                if size > 0:
                    sizes.append(size)
                    times.append(sensor.drift_time[place])
            if sensor.differential and group == "pose":
                places = tuple(place + 6 for place in places)
            kept = len(PLANE) if settings.two_d else 0
            places, slow = (*places, *PLANE[:kept]), slow + [None] * kept
            name = f"{sensor.name}_{group}"
            space = Product(*(Circle() if place in ANGLES else Euclidean(1) for place in places))
            noise = LearnedScale(f"{name}_noise", len(places), kept, dtype)
            sensors[name] = FusedSensor(Drifted(name, places, slow), noise, reading_space=space)
            reads[name] = places
    drifts = Drifts(torch.tensor(sizes, dtype=dtype), torch.tensor(times, dtype=dtype)) if sizes else None
    motion = RobotMotion("dt", drifts, settings.held)
    cov = torch.as_tensor(settings.process_noise, dtype=dtype)
    noise_of_step = RobotNoise(cov, "dt", settings.dynamic, drifts)
    transition: Any = motion
    if kind == "ukf":
        alpha, kappa, beta = settings.sigma
        transition = UKFTransition(motion, noise_of_step, alpha=alpha, beta=beta, kappa=kappa, space=motion.space)
    elif kind != "ekf":
        raise ValueError(f"kind is 'ekf' or 'ukf', got {kind!r}")
    initial = _initial(
        torch.as_tensor(settings.initial_state, dtype=dtype), torch.as_tensor(settings.initial_cov, dtype=dtype), drifts
    )
    options = {} if kind == "ukf" else {"process_noise": noise_of_step}
    filter = FusedFilter(transition, sensors, initial=initial, **options)
    return RobotModel(filter, settings, reads, settings.unheeded, drifts)
