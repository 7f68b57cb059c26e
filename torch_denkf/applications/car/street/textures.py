"""Random textures of the rendered drives: ground, facades, trees, poles, cars, sky; BGR uint8."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

TILE = 512  # pixels after which ground textures repeat


def noise(rng: np.random.Generator, shape: tuple[int, int], cells: dict[int, float]) -> np.ndarray:
    """Returns smooth noise of several scales that repeats at its edges.

    Args:
        rng: source of randomness.
        shape: (rows, columns), multiples of all cells.
        cells: standard deviation by cell size in pixels.

    Returns:
        ``shape`` float32, mean 0.
    """
    total = np.zeros(shape, np.float32)
    for cell, deviation in cells.items():
        coarse: np.ndarray = rng.standard_normal((shape[0] // cell, shape[1] // cell), dtype=np.float32)
        if cell > 1:
            padded = np.pad(coarse, 2, mode="wrap")
            fine = cv2.resize(padded, None, fx=cell, fy=cell, interpolation=cv2.INTER_CUBIC)
            coarse = fine[2 * cell : 2 * cell + shape[0], 2 * cell : 2 * cell + shape[1]]
        total += deviation * (coarse - coarse.mean())
    return total


def tinted(values: np.ndarray, colour: Sequence[float] | np.ndarray) -> np.ndarray:
    """Returns grey values around 1 times a BGR colour, as uint8."""
    return np.clip(values[..., None] * np.array(colour, np.float32), 0, 255).astype(np.uint8)


def pyramid(texture: np.ndarray, levels: int) -> list[np.ndarray]:
    """Returns the texture and its halves; pixel i of level k lies at pixel ``2**k i`` of the first."""
    stack = [texture]
    while len(stack) < levels and min(stack[-1].shape[:2]) > 2:
        stack.append(cv2.pyrDown(stack[-1]))
    return stack


def ground(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns textures of grass, pavement and asphalt, tiled so that any PATCH can be cut out."""
    green, contrast = 0.8 + 0.4 * rng.random(), rng.uniform(0.6, 1.3)
    paving = np.array([(125, 130, 135), (105, 125, 140), (70, 95, 90)][rng.integers(3)])  # slabs, gravel, mown grass
    kinds = (
        ((45, 95 * green, 75), {1: 0.1, 4: 0.12, 16: 0.18, 64: 0.18}),
        (tuple(paving), {1: 0.05, 4: 0.08, 16: 0.12, 64: 0.06}),
        (tuple(np.array((88, 88, 90)) * rng.uniform(0.8, 1.35)), {1: 0.06, 4: 0.1, 16: 0.15, 64: 0.12}),
    )
    tiles = [
        tinted(1 + noise(rng, (TILE, TILE), {cell: contrast * size for cell, size in cells.items()}), colour)
        for colour, cells in kinds
    ]
    if paving[0] > 120:
        tiles[1][::16] //= 2  # slabs of 1.6 m
        tiles[1][:, ::16] //= 2
    grass, pavement, asphalt = (np.tile(tile, (4, 4, 1)) for tile in tiles)
    return grass, pavement, asphalt


def facade(rng: np.random.Generator, rows: int = 96, columns: int = 160) -> np.ndarray:
    """Returns a house's wall of 12 x 20 m at 8 pixels a metre: plaster or brick, windows, doors."""
    colour = np.array([100, 120, 135]) + rng.normal(0, 12, 3) + rng.normal(0, 40)
    wall = tinted(1 + noise(rng, (96, 160), {1: 0.04, 8: 0.06, 32: 0.1}), np.clip(colour, 40, 210))
    wall = wall[:rows, :columns].copy()
    step, storey = int(rng.integers(18, 30)), int(rng.integers(22, 28))
    glass = np.clip(np.array([75, 65, 55]) + rng.normal(0, 8, 3) + rng.normal(0, 15), 15, 140)
    for top in range(5, rows - 10, storey):
        for left in range(6, columns - 8, step):
            shade = glass * rng.uniform(0.5, 1.5)
            cv2.rectangle(wall, (left - 1, top - 1), (left + 9, top + 13), (200, 205, 205), 1)
            cv2.rectangle(wall, (left, top), (left + 8, top + 12), np.clip(shade, 0, 255).tolist(), -1)
    return wall


def tree(rng: np.random.Generator) -> np.ndarray:
    """Returns a tree, premultiplied BGRA, 128 x 96."""
    rows, columns = 128, 96
    alpha = np.zeros((rows, columns), np.uint8)
    for _ in range(14):
        centre = (int(rng.normal(48, 14)), int(rng.normal(44, 15)))
        cv2.circle(alpha, centre, int(rng.integers(9, 20)), 255, -1)
    crown = alpha > 0
    alpha[noise(rng, (rows, columns), {4: 0.6, 8: 0.6}) > 0.9] = 0
    colour = np.array([40, 85, 60]) * rng.uniform(0.6, 1.3) + rng.normal(0, 8, 3)
    leaves = 1 + noise(rng, (rows, columns), {2: 0.15, 8: 0.25, 16: 0.15}) - np.linspace(-0.3, 0.4, rows)[:, None]
    picture = tinted(leaves, colour)
    trunk = np.zeros_like(alpha)
    cv2.rectangle(trunk, (44, 50), (51, rows), 255, -1)
    picture[(trunk > 0) & ~crown] = (45, 60, 75)
    return _premultiplied(picture, np.maximum(alpha, trunk))


def pole(rng: np.random.Generator) -> np.ndarray:
    """Returns a lamp post or a sign, premultiplied BGRA, 128 x 32."""
    alpha = np.zeros((128, 32), np.uint8)
    picture = np.full((128, 32, 3), int(rng.integers(50, 130)), np.uint8)
    cv2.rectangle(alpha, (14, 4), (17, 128), 255, -1)
    if rng.random() < 0.5:
        cv2.rectangle(alpha, (4, 4), (27, 26), 255, -1)
        colours = [(40, 40, 190), (190, 90, 30), (60, 190, 220), (210, 210, 210)]
        cv2.rectangle(picture, (4, 4), (27, 26), colours[rng.integers(4)], -1)
        cv2.rectangle(picture, (8, 8), (23, 22), (220, 220, 220), 2)
    else:
        cv2.rectangle(alpha, (8, 4), (23, 8), 255, -1)
    return _premultiplied(picture, alpha)


def _premultiplied(picture: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    weighted = (picture * (alpha[..., None] / 255)).astype(np.uint8)
    return np.dstack([weighted, alpha])


def hedge(rng: np.random.Generator) -> np.ndarray:
    """Returns a hedge or a fence, 24 x 160 at 8 pixels a metre."""
    if rng.random() < 0.7:
        colour = np.array([40, 80, 55]) * rng.uniform(0.6, 1.3)
        return tinted(1 + noise(rng, (24, 160), {2: 0.15, 8: 0.25}), colour)
    boards = 1 + 0.3 * (np.arange(160) % 4 == 0)[None] * -np.ones((24, 1)) + noise(rng, (24, 160), {4: 0.05})
    return tinted(boards, np.array([90, 115, 135]) * rng.uniform(0.6, 1.5))


def car(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns side (48 x 128), rear and front (48 x 56) of a car."""
    paint = np.clip(rng.normal(110, 60) + rng.normal(0, 22, 3), 15, 230)
    views = []
    for columns, margin in ((128, 22), (56, 6), (56, 6)):
        view = np.clip(paint * np.linspace(1.15, 0.75, 48)[:, None, None], 0, 255) * np.ones((1, columns, 1))
        view = view.astype(np.uint8)
        cv2.rectangle(view, (margin, 5), (columns - margin, 19), (50, 45, 40), -1)
        cv2.rectangle(view, (0, 40), (columns, 48), (25, 25, 25), -1)
        views.append(view)
    for x in (26, 102):
        cv2.circle(views[0], (x, 38), 11, (15, 15, 15), -1)
        cv2.circle(views[0], (x, 38), 5, (130, 130, 130), -1)
    for view, lamp in ((views[1], (30, 30, 200)), (views[2], (225, 235, 235))):
        for x in (2, 44):
            cv2.rectangle(view, (x, 24), (x + 9, 30), lamp, -1)
            cv2.rectangle(view, (x, 40), (x + 9, 48), (12, 12, 12), -1)
    cv2.rectangle(views[2], (16, 26), (39, 33), (30, 30, 30), -1)
    cv2.rectangle(views[1], (20, 31), (35, 35), (200, 205, 205), -1)
    side, rear, front = views
    return side, rear, front


def panorama(rng: np.random.Generator, haze: np.ndarray, rows: int = 160, columns: int = 1440) -> np.ndarray:
    """Returns sky with clouds, hills at the horizon, all around: four pixels a degree; the horizon is the last row."""
    rise = np.linspace(1, 0, rows, dtype=np.float32)[:, None, None]
    blue = np.array([235, 190, 150]) * rng.uniform(0.7, 1.0)
    sky = haze + (blue - haze) * np.minimum(1.6 * rise, 1)
    clouds = noise(rng, (rows, columns), {80: 0.5, 40: 0.35, 16: 0.2, 8: 0.1})
    cover = np.clip(clouds + rng.uniform(-0.4, 0.5), 0, 1)[..., None] * np.minimum(2 * rise + 0.2, 1)
    sky = sky * (1 - cover) + np.array([245, 243, 240]) * cover
    for height, shade in ((13, 0.85), (7, 0.7)):
        ridge = noise(rng, (160, columns), {80: 0.5, 16: 0.4, 4: 0.25})[0]
        hills = np.arange(rows)[::-1, None] < height * np.maximum(1 + ridge, 0.15)
        sky = np.where(hills[..., None], haze * shade * np.array([0.85, 0.95, 0.9]), sky)
    return np.clip(sky, 0, 255).astype(np.uint8)
