"""Path of a drive with one point per metre, along which road, roadside and traffic are placed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BEFORE, AFTER = 20, 140  # m of straight road before the start and after the end
LONGEST = 50_000.0  # m: a scene is laid out metre by metre, which takes 0.2 GB and 4 s at this length


@dataclass
class Path:
    """A path in (x right, z ahead), in m.

    Attributes:
        line: one point per metre, ``[M, 2]``.
        heading: heading at these points in rad, to the left, unwrapped, ``[M]``.
        heights: y (down) of the ground at these points, ``[M]``.
        along: position of each frame on the line, in m from its first point, ``[N]``.
    """

    line: np.ndarray
    heading: np.ndarray
    heights: np.ndarray
    along: np.ndarray

    @classmethod
    def of(cls, state: np.ndarray, ground: np.ndarray) -> Path:
        """Returns the path of a car.

        Args:
            state: x and y in m and θ in rad in its first three columns, ``[N, 3]`` or more.
            ground: y (down) of the ground under the car in each row, ``[N]``.

        Raises:
            ValueError: if the path is longer than 50 km, or not finite.
        """
        check_length("the path", state[:, :2])
        points, theta = np.column_stack([-state[:, 1], state[:, 0]]), np.unwrap(state[:, 2])
        # Poses of a car at rest jitter by millimetres: a frame is kept once the car has moved 0.25 m.
        kept = [0]
        for k in range(1, len(points)):
            if np.hypot(*(points[k] - points[kept[-1]])) >= 0.25:
                kept.append(k)
        travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points[kept], axis=0), axis=-1))])
        along = np.interp(np.arange(len(points)), kept, travelled)
        before, after = np.arange(-BEFORE, 0.0), travelled[-1] + np.arange(1.0, AFTER + 1)
        out = np.stack([-np.sin(theta), np.cos(theta)], -1)
        columns = np.column_stack([points, theta, ground])[kept]
        slopes = np.zeros((2, 4))
        slopes[0, :2], slopes[1, :2] = out[0], out[-1]
        slopes[:, 3] = _end_slopes(travelled, columns[:, 3])
        columns = np.concatenate(
            [
                columns[0] + slopes[0] * before[:, None],
                columns,
                columns[-1] + slopes[1] * (after - travelled[-1])[:, None],
            ]
        )
        where = np.concatenate([before, travelled, after])
        metres = np.arange(-BEFORE, np.floor(after[-1]) + 1)
        x, z, heading, heights = (np.interp(metres, where, column) for column in columns.T)
        return cls(np.column_stack([x, z]), heading, heights, along + BEFORE)

    @property
    def ahead(self) -> np.ndarray:
        """Returns unit vectors along the line, (x, z), ``[M, 2]``."""
        return np.stack([-np.sin(self.heading), np.cos(self.heading)], -1)

    @property
    def left(self) -> np.ndarray:
        """Returns unit vectors to its left, (x, z), ``[M, 2]``."""
        return np.stack([-np.cos(self.heading), -np.sin(self.heading)], -1)

    def at(self, along: np.ndarray, aside: np.ndarray | float = 0.0) -> np.ndarray:
        """Returns positions at a distance along the line and an offset to the left.

        Args:
            along: m from the line's first point, ``[T]``.
            aside: offset to the left, m.

        Returns: x, z and the heading's (x, z), ``[T, 4]``.
        """
        metres = np.arange(len(self.line))
        x, z, heading = (np.interp(along, metres, column) for column in (*self.line.T, self.heading))
        ahead, up = -np.sin(heading), np.cos(heading)
        return np.column_stack([x - up * aside, z + ahead * aside, ahead, up])


def check_length(name: str, points: np.ndarray) -> None:
    """Checks that a path is short enough for a scene.

    Args:
        name: name of the path, for the message.
        points: positions in m, ``[N, 2]`` or ``[N, 3]``.

    Raises:
        ValueError: if the path is longer than 50 km, or not finite.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    length = float(steps.sum())
    if not length <= LONGEST:
        row = int(np.nanargmax(steps))
        raise ValueError(
            f"{name} is {length:g} m long, of which {steps[row]:g} m lie between rows {row + 1} and {row + 2}; the "
            f"terrain of a scene reaches over {LONGEST:g} m at most: split the drive, or correct the row to metres"
        )


def _end_slopes(travelled: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Returns the slope of the first and of the last 10 m."""
    if travelled[-1] < 10:
        return np.zeros(2)
    near = travelled < 10, travelled > travelled[-1] - 10
    return np.array([np.polyfit(travelled[part], heights[part], 1)[0] if part.sum() > 1 else 0.0 for part in near])
