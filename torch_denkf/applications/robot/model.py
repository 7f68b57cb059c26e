"""A filter of robot_localization's fifteen states, as its YAML says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

from torch_denkf.applications.robot.config import PLANE, Config, read_config
from torch_denkf.applications.robot.motion import ANGLES, STATE_SPACE, RobotMotion, RobotNoise
from torch_denkf.functional.manifolds import Circle, Euclidean, Product
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.modules import MomentPrior, Select, UKFTransition
from torch_denkf.submodel import SubModel

__all__ = ["LearnedScale", "RobotModel", "robot_model"]

PLANE_VARIANCE = 1e-6  # of the zeros that are read in the plane


@dataclass(frozen=True)
class RobotModel:
    """A filter, and what it reads.

    Attributes:
        filter: of the fifteen states; its rows have ``"dt"``, and for each sensor its readings, their mask and their
            covariance under NAME_noise, see :func:`torch_denkf.fusion.message_rows`.
        config: the settings.
        reads: by the name of each sensor of the filter, such as ``odom0_pose``: the states that it reads, in order.
        unheeded: what of the settings is not honoured, and why.
    """

    filter: FusedFilter
    config: Config
    reads: Mapping[str, tuple[int, ...]]
    unheeded: tuple[str, ...] = field(default=())

    def started(self, mean: Tensor, cov: Tensor) -> RobotModel:
        """The same model, that starts from another belief: ``[15]`` and ``[15, 15]``."""
        initial = MomentPrior(mean, cov, space=STATE_SPACE)
        return RobotModel(self.filter.with_modules(initial=initial), self.config, self.reads, self.unheeded)


class LearnedScale(SubModel):
    """The covariances that messages bring, with standard deviations scaled by what is learned.

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
        """The scaled covariances."""
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
    believed by the covariance that stands in its row. With ``two_d_mode`` each reads also zeros, of variance 1e-6, of
    what does not move in the plane. Poses of ``..._differential`` and ``..._relative`` sensors are those of the rows.

    Args:
        config: a YAML file, or its content. Two parameters of a sensor are this library's own: ``odom0_delay``, in s,
            and ``odom0_variances``, fifteen, where messages bring no covariance.
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
    for sensor in settings.sensors:
        for group, places in sensor.groups.items():
            if sensor.differential and group == "pose":
                places = tuple(place + 6 for place in places)
            if settings.two_d:
                places = (*(place for place in places if place not in PLANE), *PLANE)
            name = f"{sensor.name}_{group}"
            kept = len(PLANE) if settings.two_d else 0
            space = Product(*(Circle() if place in ANGLES else Euclidean(1) for place in places))
            noise = LearnedScale(f"{name}_noise", len(places), kept, dtype)
            sensors[name] = FusedSensor(Select(list(places)), noise, reading_space=space)
            reads[name] = places
    motion = RobotMotion("dt")
    cov = torch.as_tensor(settings.process_noise, dtype=dtype)
    noise_of_step = RobotNoise(cov, "dt", settings.dynamic)
    transition: Any = motion
    if kind == "ukf":
        alpha, kappa, beta = settings.sigma
        transition = UKFTransition(motion, noise_of_step, alpha=alpha, beta=beta, kappa=kappa, space=STATE_SPACE)
    elif kind != "ekf":
        raise ValueError(f"kind is 'ekf' or 'ukf', got {kind!r}")
    initial = MomentPrior(
        torch.as_tensor(settings.initial_state, dtype=dtype),
        torch.as_tensor(settings.initial_cov, dtype=dtype),
        space=STATE_SPACE,
    )
    options = {} if kind == "ukf" else {"process_noise": noise_of_step}
    filter = FusedFilter(transition, sensors, initial=initial, **options)
    return RobotModel(filter, settings, reads, settings.unheeded)
