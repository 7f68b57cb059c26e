"""Camera of a car: scales images to the training's resolution, computes their optical flow, and checks plausibility."""

from __future__ import annotations

import math
import warnings
from collections import deque
from statistics import median

import cv2
import numpy as np
import torch
from torch import Tensor

from torch_denkf.applications.car.vision.camera import CanonicalCamera
from torch_denkf.applications.car.vision.epipolar import two_view_motion
from torch_denkf.applications.car.vision.expansion import focus_of_expansion
from torch_denkf.applications.car.vision.motion import image_motion
from torch_denkf.applications.car.vision.shapes import ROAD_PITCHES, ROAD_SHIFTS
from torch_denkf.applications.car.vision.signs import static_region

__all__ = ["CarCamera", "check_frame"]

_WATCHED = 40  # number of moving pairs for the checks of camera and calibration
_MOVING = 0.012  # mean flow, in tangents, below which the car counts as standing
_LEAST_CORRELATION = 0.95  # of the road, median; 0.97 to 0.99 on KITTI, 0.94 and less with a wrong calibration
_LEAST_VIEW = 0.85  # share of the field of view that the sensor was trained with
_FASTEST = 3.0  # m per frame pair: range of the sensor
_PITCH_MARGIN = 0.01  # rad


def check_frame(frame: object, number: int) -> None:
    """Checks that a frame is an image in OpenCV's layout.

    Raises:
        ValueError: if it is no array, or has another shape or dtype; the message names the frame.
    """
    if not isinstance(frame, np.ndarray):
        raise ValueError(f"frame {number} is a {type(frame).__name__}; pass an array, uint8 [H, W] or [H, W, 3]")
    if frame.dtype != np.uint8 or frame.ndim not in (2, 3) or (frame.ndim == 3 and frame.shape[2] != 3):
        raise ValueError(f"frame {number} is {frame.dtype} {list(frame.shape)}; pass uint8 [H, W] or [H, W, 3]")


class CarCamera:
    """Scales images to the training's resolution, computes their motion, and warns if it is implausible.

    Args:
        frame: the first image, ``[H, W]`` or ``[H, W, 3]``.
        calibration: (fx, fy, cx, cy) in pixels.
        height: height over the road, in m.
        pitch: upward pitch of the camera relative to the road, in rad.
        focal: focal length of the training images in pixels; ``None`` leaves images as they are.
        two_view: whether corners are tracked, too.
        repair: whether the flow is continued over static occlusions.

    Raises:
        ValueError: if the principal point does not belong to images of this size.
    """

    def __init__(
        self,
        frame: np.ndarray,
        calibration: list[float],
        height: float,
        pitch: float,
        focal: float | None,
        two_view: bool = False,
        repair: bool = False,
    ):
        fx, fy, cx, cy = calibration
        rows, columns = frame.shape[:2]
        if not (0.2 * columns <= cx <= 0.8 * columns and -0.2 * rows <= cy <= 1.2 * rows):
            raise ValueError(
                f"the principal point ({cx:g}, {cy:g}) does not belong to images of {columns} x {rows} pixels; "
                "scale fx, fy, cx and cy by the factor that the images were scaled by"
            )
        self.shape, factor = frame.shape[:2], 1.0 if focal is None else min(focal / fx, 1.0)
        self.size = round(columns * factor), round(rows * factor)
        across, down = self.size[0] / columns, self.size[1] / rows
        # Pixel centres are at whole numbers.
        self.calibration = [fx * across, fy * down, (cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5]
        self.calibration[3] += pitch * self.calibration[1]
        self.height, self.two_view, self.repair, self.watch = height, two_view, repair, _Watch(pitch)
        # The sensor's field of view against the camera's: to the sides, and down to the near road.
        canonical = CanonicalCamera(240.0)
        wanted = [side / 2 / canonical.focal for side in (canonical.width, canonical.height)]
        shown = [min(cx, columns - cx) / fx, (rows - cy) / fy]
        if any(a < _LEAST_VIEW * b for a, b in zip(shown, wanted, strict=True)):
            across, down = (math.degrees(math.atan(value)) for value in shown)
            self.watch.say(
                f"with these focal lengths the images show {across:.0f} degrees to the sides and {down:.0f} down, "
                "where the sensor looks at 41 and 15: the focal lengths are too long for these images, or their field "
                "of view is narrower than that of the training"
            )

    def image(self, frame: np.ndarray, number: int) -> np.ndarray:
        """Returns the grey image at the training's resolution."""
        if frame.shape[:2] != self.shape:
            raise ValueError(f"frame {number} is {list(frame.shape[:2])}, the first one {list(self.shape)}")
        grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        return grey if self.size == grey.shape[::-1] else cv2.resize(grey, self.size, interpolation=cv2.INTER_AREA)

    def motion(self, previous: np.ndarray, current: np.ndarray) -> tuple[dict[str, Tensor], float]:
        """Returns flow, road correlation and corner motion (if tracked) of a pair, rounded as in the training.

        It also returns the static share of the image.
        """
        static = static_region(previous, current)
        hidden = {"hidden": static} if self.repair and static.any() else {}
        arrays = image_motion(previous, current, self.calibration, height=self.height, **hidden)
        flow, road = (torch.from_numpy(array).half().float() for array in arrays)
        self.watch(flow, road)
        reading = {"flow": flow, "road": road}
        if self.two_view:
            reading["two_view"] = torch.from_numpy(two_view_motion(previous, current, self.calibration, **hidden))
        return reading, float(static.mean())


class _Watch:
    """Warns once for each contradiction between readings and calibration."""

    def __init__(self, pitch: float):
        self.pitch, self.said = pitch, False
        self.seen: deque[tuple[float, float, float]] = deque(maxlen=_WATCHED)

    def __call__(self, flow: Tensor, road: Tensor) -> None:
        """Checks one pair."""
        if self.said:
            return
        if float(flow[:2].norm(dim=0).mean()) < _MOVING:
            return
        moved = float(ROAD_SHIFTS[int(road.amax(0).argmax())])
        up = float(focus_of_expansion(flow.unsqueeze(0)).focus[0, 1])
        self.seen.append((float(road.max()), up, moved))
        if len(self.seen) < _WATCHED:
            return
        correlation, up, moved = (median(values) for values in zip(*self.seen, strict=True))
        low, high = float(ROAD_PITCHES[0]), float(ROAD_PITCHES[-1])
        if not low - _PITCH_MARGIN <= up <= high + _PITCH_MARGIN:
            self.say(
                f"the camera looks {self.pitch + up:+.3f} rad up from the direction of travel; with pitch="
                f"{self.pitch:g} the sensor reads {self.pitch + low:g} to {self.pitch + high:g}. Pass "
                f"pitch={self.pitch + up:.3f}, or correct cy"
            )
        elif moved >= _FASTEST:
            self.say(
                f"the car seems to move {moved:.1f} m between two frames, where the sensor's range ends. Check the "
                "camera's height, the focal lengths, and the times of the frames"
            )
        elif correlation < _LEAST_CORRELATION:
            self.say(
                f"the road does not look like a plane under this camera (correlation {correlation:.2f}; "
                f"{_LEAST_CORRELATION} or more is usual). Check the calibration, that the images are rectified, and "
                "that they show the road below their middle"
            )

    def say(self, text: str) -> None:
        """Warns once."""
        self.said = True
        warnings.warn(text, UserWarning, stacklevel=6)
