"""Tracks a drive with known poses during camera failures: belief, ground truth and dead reckoning."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.applications.car.metrics.odometry import dead_reckoning
from torch_denkf.applications.car.odometry.failures import CameraFailure, fail_frames
from torch_denkf.applications.car.odometry.filter import VELOCITIES, CarFilter
from torch_denkf.applications.car.odometry.tracking import track
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.metrics import interval_coverage

__all__ = ["drive_scores", "track_failing_drive", "usual_failures"]


def usual_failures(frames: int) -> list[CameraFailure]:
    """Returns the failures of the demo: a span of missing frames, one of black frames and one with a box.

    Example:
        >>> [(failure.kind, failure.first, failure.last) for failure in usual_failures(100)]
        [('missing', 24, 29), ('black', 50, 55), ('box', 74, 87)]
    """
    spans = {"missing": (0.24, 0.3), "black": (0.5, 0.56), "box": (0.74, 0.88)}
    return [
        CameraFailure(kind, round(first * frames), round(last * frames) - 1)  # type: ignore[arg-type]
        for kind, (first, last) in spans.items()
    ]


def track_failing_drive(
    car: CarFilter,
    drive: TensorDict,
    failures: Sequence[CameraFailure] = (),
    *,
    height: float = KITTI_HEIGHT,
    black_level: int | None = 8,
    repair: bool = True,
    seed: int = 0,
    progress: Callable[[int], object] | None = None,
) -> TensorDict:
    """Tracks a drive whose camera fails.

    Args:
        car: the filter.
        drive: drive with ``"image"``, ``"state"``, ``"calibration"`` and ``"dt"``, see
            :func:`torch_denkf.applications.car.read_kitti_drive`.
        failures: failures of the camera.
        height: height of the camera over the road, in m.
        black_level: see :func:`torch_denkf.applications.car.track`.
        repair: see there, too.
        seed: seed of the filter's noise.
        progress: called with the number of frames since the last call.

    Returns:
        ``[T]``: ``"belief"``; ``"state"`` ``[T, 5]``, the ground truth relative to the first pose; ``"dead_reckoning"``
        ``[T, 3]``, the integrated readings with a zero-order hold; ``"observed"`` ``[T, 1]``; ``"time"`` ``[T, 1]`` in
        s.

    Raises:
        ValueError: if the drive does not fit the filter, see :func:`torch_denkf.applications.car.track`.

    Example:
        >>> import tempfile
        >>> from torch_denkf.applications.car.kitti.drive import read_kitti_drive
        >>> from torch_denkf.applications.car.kitti.render import write_drives
        >>> from torch_denkf.applications.car.odometry.filter import car_filter
        >>> folder = tempfile.mkdtemp()
        >>> names = write_drives(folder, "town", frames=8)
        >>> drive = read_kitti_drive(folder, "town", cache=None)
        >>> tracked = track_failing_drive(car_filter(ensemble_size=8), drive, [CameraFailure("black", 4, 5)])
        >>> tracked["observed"].flatten().tolist()
        [False, True, True, True, False, False, True, True]
    """
    frames = _counted(fail_frames(map(_for_opencv, drive["image"]), failures), progress)
    dt = float(drive["dt"][0, 0])
    beliefs = list(
        track(
            car,
            frames,
            drive["calibration"][0].tolist(),
            fps=1 / dt,
            height=height,
            black_level=black_level,
            repair=repair,
            seed=seed,
        )
    )
    truth = _from_first_pose(drive["state"][[belief.frame for belief in beliefs]])
    velocity, held = [], next(belief.reading for belief in beliefs if belief.reading is not None)
    for belief in beliefs:
        held = held if belief.reading is None else belief.reading
        velocity.append(held)
    entries = {name: torch.stack([getattr(b, name) for b in beliefs]) for name in ("mean", "var", "ensemble")}
    count = len(beliefs)
    return TensorDict(
        {
            "belief": TensorDict(entries, [count]),
            "state": truth,
            "dead_reckoning": dead_reckoning(torch.stack(velocity).double(), torch.zeros(3).double(), dt).float(),
            "observed": torch.tensor([[belief.observed] for belief in beliefs]),
            "time": torch.tensor([[belief.time] for belief in beliefs], dtype=torch.float64),
        },
        [count],
    )


def drive_scores(tracked: TensorDict, level: float = 0.9) -> dict[str, float]:
    """Returns the scores of a result of :func:`track_failing_drive`.

    Returns:
        ``way_m``, the distance travelled; ``filter_end_m`` and ``reckoned_end_m``, position errors at the end, and
        ``filter_mean_m`` and ``reckoned_mean_m``, their means over all frames; ``held_v`` and ``held_theta_dot``, the
        coverage of the filter's intervals of the velocities.
    """
    truth, mean, var = tracked["state"], tracked["belief", "mean"], tracked["belief", "var"]
    errors = {
        name: (path[:, :2] - truth[:, :2]).norm(dim=-1)
        for name, path in (("filter", mean), ("reckoned", tracked["dead_reckoning"]))
    }
    parts = (part[1:, VELOCITIES].double() for part in (mean, var.clamp_min(1e-12), truth))
    held = interval_coverage(*parts, level=level)
    scores = {f"{name}_end_m": float(error[-1]) for name, error in errors.items()}
    scores |= {f"{name}_mean_m": float(error.mean()) for name, error in errors.items()}
    way = float(truth[:, :2].diff(dim=0).norm(dim=-1).sum())
    return {"way_m": way, **scores, "held_v": float(held[0]), "held_theta_dot": float(held[1])}


def _for_opencv(image: Tensor) -> np.ndarray:
    """Returns a grey image ``[H, W]``, or ``[H, W, 3]`` in OpenCV's order."""
    array = image.permute(1, 2, 0).numpy()
    return array[..., 0] if array.shape[-1] == 1 else np.ascontiguousarray(array[..., ::-1])


def _counted(frames, progress):
    for frame in frames:
        yield frame
        if progress is not None:
            progress(1)


def _from_first_pose(state: Tensor) -> Tensor:
    """Returns states relative to the first pose."""
    state = state.double()
    x, y = (state[:, :2] - state[0, :2]).unbind(-1)
    cos, sin = state[0, 2].cos(), state[0, 2].sin()
    parts = [cos * x + sin * y, cos * y - sin * x, state[:, 2] - state[0, 2], state[:, 3], state[:, 4]]
    return torch.stack(parts, -1).float()
