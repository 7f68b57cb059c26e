"""Ground under a path with climbs and descents.

Along the path the ground is the camera's height below the (smoothed) camera, so that the road follows hills; to the
sides it is level. Recorded drives return to a place metres higher or lower than before, because the altitude drifts.
The ground is therefore no function of the position: :meth:`Terrain.around` computes it for one section of the path,
from that section only. Neighbouring sections agree on shared ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

CELL = 4.0  # m: grid on which heights are kept
REACH = 160.0  # m: half the side of the grid
BEHIND, AHEAD = 40, 220  # m of the path that determine the ground of a section
SMOOTH = 4.0  # m: standard deviation of the smoothing along the path, which removes the car's pitching


@dataclass
class Relief:
    """Heights (y, down, in m) on a grid from ``origin`` (x, z) on; between the nodes it is bilinear."""

    origin: np.ndarray
    grid: np.ndarray

    def at(self, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Returns the height of the ground at (x, z), any shape; outside the grid that of its edge."""
        rows, columns = self.grid.shape
        u = np.clip((x - self.origin[0]) / CELL, 0, columns - 1.001)
        v = np.clip((z - self.origin[1]) / CELL, 0, rows - 1.001)
        column, row = u.astype(np.int32), v.astype(np.int32)
        u, v = u - column, v - row
        first = row * columns + column
        near = self.grid.take(first) * (1 - u) + self.grid.take(first + 1) * u
        far = self.grid.take(first + columns) * (1 - u) + self.grid.take(first + columns + 1) * u
        return near * (1 - v) + far * v


class Terrain:
    """Ground along a path.

    Args:
        line: (x, z) of the path, one point per metre, ``[M, 2]``.
        heights: y of the ground (down) at these points in m, ``[M]``.
    """

    def __init__(self, line: np.ndarray, heights: np.ndarray):
        self.line = line
        reach = round(4 * SMOOTH)
        kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SMOOTH) ** 2)
        padded = np.pad(heights, reach, mode="reflect", reflect_type="odd")  # continues with its slope
        self.heights = np.convolve(padded, kernel / kernel.sum(), mode="valid")

    def around(self, metre: int) -> Relief:
        """Returns the ground from 40 m behind to 220 m ahead of a point of the path.

        Args:
            metre: number of the point.
        """
        origin = np.floor(self.line[metre] / CELL) * CELL - REACH
        nodes = round(2 * REACH / CELL) + 1
        piece = slice(max(metre - BEHIND, 0), metre + AHEAD)
        heights = self.heights[piece]
        if np.ptp(heights) < 1e-9:
            return Relief(origin, np.full((nodes, nodes), heights[0]))
        ticks = CELL * np.arange(nodes)
        x, z = ((origin[k] + ticks)[:, None] - self.line[piece, k] for k in (0, 1))
        x, z = x.astype(np.float32) ** 2, z.astype(np.float32) ** 2
        # Weights fall with the twelfth power of the distance: heights equal the path's on it, and the nearest points'
        # next to it, without steps.
        weight = z[:, None] + (x + 6.0)
        weight *= weight * weight
        weight = 1 / (weight * weight)
        base = heights.mean()
        return Relief(origin, base + (weight @ (heights - base).astype(np.float32)) / weight.sum(-1))
