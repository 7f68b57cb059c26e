"""Runs a car filter on a stream of images without poses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import count, pairwise
from statistics import median
from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf._checks import check_number
from torch_denkf.applications.car.odometry.camera import CarCamera, check_frame
from torch_denkf.applications.car.odometry.filter import VELOCITIES, CarFilter
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.applications.car.vision.shapes import FLOW_SHAPE, ROAD_SHAPE, TWO_VIEW_SHAPE
from torch_denkf.diagnosis.logs import warn_of_log

__all__ = ["TrackedBelief", "track"]

_LONGEST_GAP = 100  # steps without a frame that are bridged by prediction
_EARLY = 0.25  # steps by which a frame may be early


class TrackedBelief(NamedTuple):
    """Belief of :func:`track` after a frame.

    Attributes:
        frame: index of the frame in the input, from 0.
        time: time of the frame, in s.
        observed: whether the frame forms a pair with an earlier one.
        mean: mean of (x m forward, y m to the left of the first pose, theta rad to the left, v m/s, theta_dot rad/s),
            ``[5]``.
        var: variances, ``[5]``.
        ensemble: members, ``[E, 5]``.
        reading: sensor's mean reading (v m/s, theta_dot rad/s) over the steps of the pair, ``[2]``; ``None`` without a
            pair.
        hidden: share of the image with a static occlusion, such as dirt or a box, 0 to 1.
    """

    frame: int
    time: float
    observed: bool
    mean: Tensor
    var: Tensor
    ensemble: Tensor
    reading: Tensor | None = None
    hidden: float = 0.0


def track(
    car: CarFilter,
    frames: Iterable[np.ndarray | None],
    calibration: Sequence[float],
    *,
    times: Iterable[float] | None = None,
    fps: float | None = None,
    height: float = KITTI_HEIGHT,
    pitch: float = 0.0,
    black_level: int | None = 8,
    repair: bool = True,
    seed: int = 0,
) -> Iterator[TrackedBelief]:
    """Tracks a car by its camera's images, frame by frame, with constant memory.

    The path begins at the origin, heading forwards, with the velocities of the first frame pair; nothing is returned
    before that pair. If the camera is faster than the filter's steps (0.103 s), only every n-th frame is used. After
    missing frames, the next one is compared with the last existing one, at most three steps back, and the path between
    is corrected.

    **One camera cannot estimate its own height**: a height that is 10 % too large makes the path 10 % too long, and
    nothing in the images contradicts it. Measure it. A focal length that is too short also makes the path too long.
    Warnings report detectable errors: a focal length that is too long for the images, a large pitch of the camera, a
    road that is no plane, speeds beyond the sensor's range.

    Args:
        car: the filter, see :func:`torch_denkf.pretrained.from_pretrained`.
        frames: rectified images: grey ``[H, W]``, or in colour ``[H, W, 3]`` in OpenCV's order, uint8, all of one size;
            ``None`` for a missing frame.
        calibration: focal lengths and principal point (fx, fy, cx, cy) in pixels of the images.
        times: times of the frames in s, one for each.
        fps: frames per second, instead of ``times``. Without both, frames are one filter step apart.
        height: height of the camera over the road, in m.
        pitch: upward pitch of the camera relative to the road, in rad; the sensor estimates -0.04 to 0.02 itself.
        black_level: a frame counts as missing if it is entirely black: at most a thousandth of its pixels is brighter
            than this grey value, of 255. No street looks like that, not even at night. The same holds for any other
            uniform colour: at most a thousandth differs from the median by more than half of this. ``None`` checks
            nothing.
        repair: whether to extrapolate the flow over static occlusions, see ``vision.signs.static_region``.
        seed: seed of the filter's noise.

    Returns:
        Beliefs, one for each used frame, from the first pair on.

    Raises:
        ValueError: if calibration, height, times or images are invalid.

    Example:
        >>> from torch_denkf.applications.car.odometry.filter import car_filter
        >>> images = (np.random.default_rng(n).integers(0, 255, (50, 150)).astype(np.uint8) for n in range(4))
        >>> beliefs = list(track(car_filter(ensemble_size=8), images, (87.0, 86.5, 73.4, 24.8)))
        >>> [belief.frame for belief in beliefs], beliefs[0].mean[:3].tolist()
        ([0, 1, 2, 3], [0.0, 0.0, 0.0])
    """
    try:
        calibration = [float(value) for value in calibration]
    except (TypeError, ValueError) as error:
        raise ValueError(f"calibration is (fx, fy, cx, cy) in pixels, four numbers; got {calibration!r}") from error
    if len(calibration) != 4 or not all(np.isfinite(calibration)) or min(calibration[:2]) <= 0:
        raise ValueError(f"calibration is (fx, fy, cx, cy) in pixels, fx and fy positive; got {calibration}")
    check_number("height", height, least=0.3, most=5, cure="It is that of the camera over the road, in m")
    check_number("pitch", pitch, least=-0.5, most=0.5, cure="It is how far the camera looks up, in rad")
    if times is not None and fps is not None:
        raise ValueError("pass times or fps, not both")
    if fps is not None:
        check_number("fps", fps, above=0, cure="It is the number of frames in a second")
    if black_level is not None:
        check_number("black_level", black_level, least=0, most=255, cure="It is a grey value")
    return _track(car, _seen(frames, black_level), calibration, times, fps, height, pitch, repair, seed)


def _seen(frames: Iterable[np.ndarray | None], black_level: int | None) -> Iterator[np.ndarray | None]:
    """Yields the frames; ``None`` for missing, black or uniform ones."""
    for number, frame in enumerate(frames):
        if frame is not None:
            check_frame(frame, number)
        yield None if frame is None or (black_level is not None and _is_blank(frame, black_level)) else frame


def _is_blank(frame: np.ndarray, level: int) -> bool:
    """Returns True for an entirely black or uniform frame."""
    if float((frame > level).mean()) <= 1e-3:
        return True
    middle = np.median(frame[::8, ::8].reshape(-1, *frame.shape[2:]), 0)
    other = (frame < middle - level / 2) | (frame > middle + level / 2)
    return float(other.mean()) <= 1e-3


def _track(car, frames, calibration, times, fps, height, pitch, repair, seed) -> Iterator[TrackedBelief]:
    settings, run, camera, done = car.settings, None, None, 0
    clock, stamps = _clock(times, fps, settings.dt)
    last: _Seen | None = None
    number = -1
    for number, frame in enumerate(frames):
        time = next(stamps, None)
        if time is None:
            raise ValueError(f"there are more frames than times: frame {number} has none; pass a time for each")
        step = clock(time)
        if step is None:
            continue
        image, reading, between, hidden = None, None, 0, 0.0
        if frame is not None:
            camera = camera or CarCamera(frame, calibration, height, pitch, settings.focal, settings.two_view, repair)
            image = camera.image(frame, number)
            if last is not None and step - last.step <= settings.longest:
                (reading, hidden), between = camera.motion(last.image, image), step - last.step
                if run is None:
                    run, done = _Run(car, reading, between, settings.dt / clock.step, seed), last.step
                    yield run.belief(last.number, last.time, False)
            last = _Seen(step, number, clock.time, image)
        if run is None:
            continue
        if step - done > _LONGEST_GAP:
            told = "" if times is None else f". Its time is {time:.10g}: times are in s"
            raise ValueError(
                f"{step - done} steps without a frame before frame {number}; track what comes after the gap apart{told}"
            )
        for _ in range(step - done - 1):
            run.step(None, 0)
        run.step(reading, between)
        done = step
        yield run.belief(number, clock.time, reading is not None, between)._replace(hidden=hidden)
    if times is not None and (left := sum(1 for _ in stamps)):
        warn_of_log("the track", "times", f"has {left} more than the {number + 1} frames", "pass a time for each frame")
    if run is None:
        raise ValueError(
            f"there are no two frames at most {settings.longest} steps apart, which a path needs; those that are black "
            "or of one colour all over do not count, see black_level"
            + ("" if times is None else f"; of times, in s, a step is {clock.step:.4g} s")
        )


class _Seen(NamedTuple):
    """Last existing frame."""

    step: int
    number: int
    time: float
    image: np.ndarray


def _clock(times: Iterable[float] | None, fps: float | None, dt: float) -> tuple[_Clock, Iterator[float]]:
    """Returns a clock, and the times for it."""
    if times is None:
        period = dt if fps is None else 1 / fps
        return _Clock(dt, period), (number * period for number in count())
    try:
        known = [float(time) for time in times]  # memory is small: 7 MB for a day at 10 Hz
    except (TypeError, ValueError) as error:
        raise ValueError(f"times are those of the frames in s, a number each ({error})") from error
    period = median(after - before for before, after in pairwise(known)) if len(known) > 1 else dt
    if not all(after > before for before, after in pairwise(known)):
        at = next(n for n, (before, after) in enumerate(pairwise(known), start=1) if not after > before)
        raise ValueError(f"times must increase; that of frame {at} is {known[at]} s, after {known[at - 1]} s")
    return _Clock(dt, period), iter(known)


class _Clock:
    """Maps the time of a frame to the filter's step; ``None`` for a frame between two steps.

    A filter has the step length of its training. Of a faster camera only every n-th frame is a step; missing frames
    skip steps.

    Args:
        dt: the filter's step, in s.
        period: time between two frames, in s.

    Raises:
        ValueError: if no multiple of the period is close to a step.

    Example:
        >>> clock = _Clock(dt=0.103, period=1 / 30)
        >>> [clock(time) for time in (0.0, 0.033, 0.067, 0.1, 0.133, 0.3)]
        [0, None, None, 1, None, 3]
    """

    def __init__(self, dt: float, period: float):
        self.step = max(round(dt / period), 1) * period if period > 0 else 0.0
        if not 0.6 * dt <= self.step <= 1.6 * dt:
            raise ValueError(
                f"frames are {period:.3g} s apart, but the filter moves in steps of {dt:.3g} s; pass at least "
                f"{1 / (1.6 * dt):.0f} frames a second, and their right times"
            )
        self.time, self._taken = 0.0, -1
        self._first: float | None = None

    def __call__(self, time: float) -> int | None:
        """Returns the step of a frame."""
        self._first = time if self._first is None else self._first
        reached = int((time - self._first) / self.step + _EARLY)
        if reached <= self._taken:
            return None
        self.time, self._taken = time, reached
        return reached


class _Run:
    """The filter's state from step to step.

    Args:
        car: the filter.
        reading: flow and road of the first pair.
        between: steps of that pair.
        speed_up: ratio of the filter's step to its real duration, a factor on velocities.
        seed: seed of the noise.
    """

    def __init__(self, car: CarFilter, reading: dict[str, Tensor], between: int, speed_up: float, seed: int):
        self.car, self.generator = car, torch.Generator().manual_seed(seed)
        self.units = torch.tensor([1.0, 1.0, 1.0, speed_up, speed_up])
        self.carry = TensorDict({"start": torch.zeros(5)})
        with torch.no_grad():
            noise = self._noisy(TensorDict(reading))["noise", "sensor"]
            read = car.sensor(TensorDict({**reading, "noise": {"self": noise}}))["sensor", "ensemble"]
            self.carry["start"][VELOCITIES] = read.mean(0) / between
            self.carry = car.initialise(self._noisy(self.carry))

    def step(self, reading: dict[str, Tensor] | None, between: int) -> None:
        """Runs one step of the filter; without a reading the belief is the forecast."""
        blank = {"flow": torch.zeros(FLOW_SHAPE), "road": torch.zeros(ROAD_SHAPE)}
        if self.car.settings.two_view:
            blank["two_view"] = torch.zeros(TWO_VIEW_SHAPE)
        frame = TensorDict(blank if reading is None else reading)
        frame["observed"], frame["steps"] = torch.tensor([reading is not None]), torch.tensor([between])
        frame.update(self.carry.select(*self.car.carry_keys))
        with torch.no_grad():
            self.carry = self.car.step(self._noisy(frame))

    def belief(self, frame: int, time: float, observed: bool, between: int = 1) -> TrackedBelief:
        """Returns the belief, in the units of real time."""
        belief = self.carry["belief"]
        mean, var, ensemble = (belief[name] for name in ("mean", "var", "ensemble"))
        reading = None
        if observed:  # the sensor reads the sum over the steps of a pair
            reading = self.carry["sensor", "ensemble"].mean(0) / between * self.units[VELOCITIES]
        return TrackedBelief(
            frame, time, observed, mean * self.units, var * self.units**2, ensemble * self.units, reading
        )

    def _noisy(self, frame: TensorDict) -> TensorDict:
        return self.car.draw_noise(frame, generator=self.generator)
