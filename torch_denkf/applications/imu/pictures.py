"""Figure of the orientation over a log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torch_denkf.applications.imu.log import Orientations
from torch_denkf.plots._axes import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["orientation_picture"]

_HALF = 1.645  # of a 90 % interval, in standard deviations


def euler_angles(quaternion: Tensor) -> Tensor:
    """Returns yaw, pitch and roll in degrees, ``[*, 3]``, of R = Rz(yaw) Ry(pitch) Rx(roll)."""
    w, x, y, z = quaternion.unbind(-1)
    yaw = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y.square() + z.square()))
    roll = torch.atan2(2 * (w * x + y * z), 1 - 2 * (x.square() + y.square()))
    return torch.stack([yaw, torch.asin((2 * (w * y - z * x)).clamp(-1, 1)), roll], -1).rad2deg()


def orientation_picture(found: Orientations, rate: float, *, points: int = 4000) -> Figure:
    """Draws yaw, pitch and roll over time, and below them half the 90 % intervals of heading and inclination.

    Args:
        found: of :func:`~torch_denkf.applications.imu.orientations`.
        rate: readings per second.
        points: maximum number of points drawn.
    """
    every = max(1, len(found.quaternion) // points)
    seconds = torch.arange(0, len(found.quaternion), every) / rate
    figure = new_figure((9.0, 5.0))
    above, below = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [3, 1]})
    for angle, name in zip(euler_angles(found.quaternion[::every]).unbind(-1), ("yaw", "pitch", "roll"), strict=True):
        above.plot(seconds, angle, ".", ms=1.5, label=name)
    half = _HALF * found.std[::every].rad2deg()
    below.plot(seconds, half[:, 2], label="heading")
    below.plot(seconds, half[:, :2].amax(-1), label="inclination")
    above.set_ylabel("degrees")
    below.set_ylabel("90 %, ± degrees")
    below.set_ylim(bottom=0)
    below.set_xlabel("s")
    above.legend(loc="upper right", markerscale=6)
    below.legend(loc="upper right")
    return figure
