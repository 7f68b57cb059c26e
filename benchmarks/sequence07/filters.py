"""The filters: a car's pose, its twist and a gyro's bias, from motions of corners and from turn rates."""

from __future__ import annotations

import math
from functools import partial
from typing import Literal

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.sequence07.chosen import FILTER, HALVES, LENS, SLIP_KEPT
from torch_denkf import Filter, FusedFilter, FusedSensor
from torch_denkf.functional.manifolds import SE3, Euclidean, Product
from torch_denkf.modules import AroundState, EnsembleAnalysis, GaussianAround, MappedNoise, SubModel, UKFTransition
from torch_denkf.motions.motion import Motion
from torch_denkf.submodel import Sensor

__all__ = ["DT", "POSE", "SPACE", "car_filter", "pose_of", "prepared"]

Kind = Literal["EKF", "UKF", "DEnKF"]
DT = 0.1037  # s, of a typical row; the length of each is read
#: Pose of the row before; twist in rad/s and m/s; change of turn rates and speed since the row before; the gyro's bias
#: in rad/s; the slip in rad/m and m/m.
SPACE = Product(SE3(), Euclidean(6), Euclidean(4), Euclidean(3), Euclidean(6))
WITHOUT_SLIP = Product(SE3(), Euclidean(6), Euclidean(4), Euclidean(3))
POSE, TWIST, BIAS = slice(0, 7), slice(7, 13), slice(17, 20)
SLIP = [math.hypot(*both) for both in zip(HALVES, LENS, strict=True)]
SWAYS = [0, 1, 2, 5]  # components of the twist whose change continues
SLOW, STILL = 2.0, (0.2, 1.0)  # m/s below which the turn noise is reduced, and the range of the factor
#: Initial standard deviations, of all but the slip: from rest, and from a belief.
START = [1e-4] * 6 + [0.2] * 3 + [1.0, 1.0, 10.0] + [0.02] * 3 + [0.1] + [0.01] * 3
RESTART = [1e-4] * 6 + [0.01] * 3 + [0.05] * 3 + [0.01] * 3 + [0.05] + [0.003] * 3


class CarMotion(Motion):
    """Motion of pose and twist, with a decaying twist whose changes continue: a car sways, and accelerates for a while.

    The twist is the mean over a row. The pose has a delay of one row, so that the row's readings correct the twist
    before it moves the pose.

    The pose also moves by the slip, the error of the corners' motion per metre, which lasts until the tracker finds new
    corners. No sensor observes it, so that it changes the filter's covariance and not its mean.

    Args:
        slip: whether the state has the slip.
    """

    def __init__(self, slip: bool = True):
        keys = {"kept": 6, "swing": 4, "slip_kept": 1}
        super().__init__(
            SPACE if slip else WITHOUT_SLIP, "dt_before", keys, ("belief", "ensemble"), ("forecast", "ensemble")
        )

    def move(self, state, kept, swing, slip_kept, *, dt):
        """Returns the next states: the pose moved by twist and slip, the decayed twist, and its change."""
        pose, twist, change, bias, *slips = self.space.points(state)
        change = swing * change
        after = kept * twist + torch.cat([change[..., :3], torch.zeros_like(twist[..., 3:5]), change[..., 3:]], -1)
        moved = SE3().plus(pose, (twist + sum(slip * twist[..., 5:] for slip in slips)) * dt)
        return torch.cat([moved, after, (after - twist)[..., SWAYS], bias, *(slip_kept * slip for slip in slips)], -1)


class LastMotion(SubModel):
    """Measurement model of the motion since the row before, ``[*B, E, 7]``: a point of SE3."""

    def __init__(self):
        super().__init__(nn.Identity(), [("forecast", "ensemble"), "dt"], [("forecast", "observation")])

    def compute(self, ensemble, dt):
        """Returns the motion by the twist over a row."""
        return SE3().exp(ensemble[..., TWIST] * dt.unsqueeze(-2))


class WhitenedMotion(SubModel):
    """Measurement model of the whitened difference between a member's motion and the reading, ``[*B, E, 6]``.

    An ensemble's update takes variances, not a covariance. The reading of this model is zero, with unit variances.
    """

    def __init__(self):
        keys = [("forecast", "ensemble"), "dt", "motion", "motion_noise"]
        super().__init__(nn.Identity(), keys, [("forecast", "observation")])

    def compute(self, ensemble, dt, motion, cov):
        """Returns the tangent between both motions, whitened by the Cholesky factor of its covariance."""
        moved = SE3().exp(ensemble[..., TWIST] * dt.unsqueeze(-2))
        away = SE3().minus(moved, motion.unsqueeze(-2).expand_as(moved))
        return torch.linalg.solve_triangular(torch.linalg.cholesky(cov), away.mT, upper=False).mT


class TurnRate(SubModel):
    """Measurement model of the gyro, ``[*B, E, 3]`` in rad/s."""

    def __init__(self):
        super().__init__(nn.Identity(), [("forecast", "ensemble")], [("forecast", "observation")])

    def compute(self, ensemble):
        """Returns the angular velocity plus the gyro bias."""
        return ensemble[..., TWIST][..., :3] + ensemble[..., BIAS]


class Given(Sensor):
    """Copies the first components of an entry to another key."""

    def __init__(self, in_key, out_key, size: int):
        super().__init__(nn.Identity(), [in_key], [out_key])
        self.observation_dim = size

    def compute(self, value):
        """Returns the first components."""
        return value[..., : self.observation_dim]


def pose_of(out: TensorDict, prefix: str = "belief") -> tuple[Tensor, Tensor]:
    """Returns poses ``[*B, T - 1, 7]`` and their variances ``[*B, T - 1, 6]``, of each row but the last.

    Args:
        out: of a filter's sequence, ``[*B, T]``. The pose has a delay of one row, so it is read from the next forecast.
        prefix: ``"belief"`` or ``"smoothed"``.
    """
    prefix = "forecast" if prefix == "belief" else prefix
    if (prefix, "ensemble") in out.keys(True):
        members = out[prefix, "ensemble"][..., 1:, :, POSE]
        first = members[..., :1, :]
        away = SE3().minus(members, first.expand_as(members))
        mean = SE3().plus(first.squeeze(-2), away.mean(-2))
        return mean, SE3().minus(members, mean.unsqueeze(-2).expand_as(members)).var(-2)
    var = out[prefix, "cov"].diagonal(dim1=-2, dim2=-1) if (prefix, "cov") in out.keys(True) else out[prefix, "var"]
    return out[prefix, "mean"][..., 1:, POSE], var[..., 1:, :6]


def noise_paths(slip: bool = True) -> Tensor:
    """Returns the matrix ``[D, q]`` from the noises of twist, bias and slip to the tangent."""
    size = 15 if slip else 9
    through = torch.zeros(size + 10, size, dtype=torch.float64)
    through[6:12, :6], through[12:16, :6] = torch.eye(6), torch.eye(6)[SWAYS]
    through[16:, 6:] = torch.eye(size - 6)
    return through


def speed_before(data: TensorDict) -> Tensor:
    """Returns the last speed from corners before each row, ``[*B, T, 1]`` in m/s."""
    rows = torch.arange(data.shape[-1]).unsqueeze(-1)
    last = torch.where(data["motion_observed"], rows, 0).cummax(-2).values
    last = torch.cat([last[..., :1, :], last[..., :-1, :]], -2)
    return (data["motion"][..., 6:] / data["dt"]).gather(-2, last).abs()


def prepared(readings: TensorDict, values: dict | None = None, start: Tensor | None = None) -> TensorDict:
    """Returns readings with the noise covariances of the filter.

    Args:
        readings: ``[*B, T]``.
        values: as ``chosen.FILTER``; each value may be ``[B]``, so that a batch tries several.
        start: state of the first row, with its own pose, ``[*B, 26]``; by default at rest at the origin.
    """
    values = FILTER if values is None else values
    data = readings.clone()
    before = data["dt"].roll(1, -2)
    before[..., :2, :] = 0  # the first row's pose is known
    data["dt_before"] = before

    def several(*names: str) -> Tensor:
        numbers = torch.stack([torch.as_tensor(values[name], dtype=torch.float64) for name in names], -1)
        return (numbers.unsqueeze(-2) if numbers.ndim > 1 else numbers).expand(*data.shape, len(names))

    walks = several("pitch", "yaw", "roll", "side", "down", "ahead").clone()
    walks[..., :5] *= (speed_before(data) / SLOW).clamp(*STILL)  # a car at rest does not turn
    bias = torch.full_like(walks[..., :3], 1e-5)
    seen_before = data["motion_observed"].roll(1, -2)
    data["slip_kept"] = torch.where(seen_before, SLIP_KEPT, 0.0)  # the tracker has found new corners
    slip = (1 - data["slip_kept"].square()).sqrt() * torch.tensor(SLIP, dtype=torch.float64)
    data["process"] = torch.cat([walks, bias, slip], -1).square()
    data["swing"] = several("swing_pitch", "swing_yaw", "swing_roll", "swing_ahead")
    share = several("kept_pitch", "kept_yaw", "kept_roll", "kept_side", "kept_side")
    data["kept"] = torch.cat([share, torch.ones_like(share[..., :1])], -1)
    floor = several("floor_turn", "floor_turn", "floor_turn", "floor_move", "floor_move", "floor_move").square()
    scale = several("scale").square().unsqueeze(-1)
    data["motion_noise"] = scale * data["motion_cov"] + torch.diag_embed(floor)
    data["whitened"] = torch.zeros_like(data["motion"][..., :6])
    data["gyro_noise"] = several("gyro", "gyro", "gyro").square()
    origin = SPACE.neutral(data["motion"]) if start is None else start.unsqueeze(-2)
    data["start"] = origin.expand(*data.shape, 26).contiguous()
    data["start_without_slip"] = data["start"][..., : WITHOUT_SLIP.point_dim]
    return data


def car_filter(kind: Kind, members: int = 64, *, again: bool = False, slip: bool = True, **analysis) -> Filter:
    """Returns a filter of the whole state.

    Args:
        kind: of filter.
        members: of the ensemble.
        again: whether the initial state is a belief of a filter that has run before.
        slip: whether the state of an ensemble has the slip.
        **analysis: options of the ensemble's analyses.
    """
    seen = {"observed_key": "motion_observed"}
    sensors = {
        "gyro": FusedSensor(TurnRate(), Given("gyro_noise", ("sensor", "noise"), 3)),
        "motion": FusedSensor(LastMotion(), Given("motion_noise", ("sensor", "noise"), 6), reading_space=SE3(), **seen),
    }
    std = [*(RESTART if again else START), *(SLIP if slip else [])]
    motion, through = CarMotion(slip), noise_paths(slip)
    noise = MappedNoise(Given("process", ("forecast", "noise"), through.shape[1]), through)
    if kind == "DEnKF":
        key = "start" if slip else "start_without_slip"
        initial = AroundState(std, ensemble_size=members, state_key=key, space=motion.space)
        sensors["motion"] = FusedSensor(WhitenedMotion(), [1.0] * 6, observation_key="whitened", **seen)
        made = partial(EnsembleAnalysis, "etkf", **analysis)
        return FusedFilter(motion, sensors, initial=initial, process_noise=noise, analysis=made)
    initial = GaussianAround(std, state_key="start", space=SPACE)
    if kind == "UKF":
        return FusedFilter(UKFTransition(motion, noise, space=SPACE), sensors, initial=initial)
    return FusedFilter(motion, sensors, initial=initial, process_noise=noise)
