"""Finds the hand in the image without labels, from the changes of the image while the arm moves."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torch_denkf.data import LeRobotReplay

APART = 4  # rows between two compared images
NOISE = 12 / 255  # smaller changes are the camera's noise
MOVING = 0.6  # share of the pairs that are used, those with the largest changes


class HandPlace:
    """Regression of the hand's place in the image on the joints.

    Only the right arm and the object in its hand move in these recordings. The centroid of the change between two
    images, regressed on the joints and their products, is the back of the hand. It is the target for the patch of the
    sensor, and the place of the box in the tests.

    Args:
        data: the recordings.
        rows: of training episodes, ``[n]``.
        joints: of all rows of ``data``, ``[N, J]``.
    """

    def __init__(self, data: LeRobotReplay, rows: Tensor, joints: Tensor):
        rows = rows[::APART]
        episode = data.storage[:]["episode"]
        rows = rows[rows + APART < len(joints)]
        rows = rows[episode[rows] == episode[rows + APART]]
        places, weights = [], []
        for part in rows.split(256):
            before, after = (avg_pool2d(data[index]["pixels"].mean(1), 2) for index in (part, part + APART))
            change = ((after - before).abs() - NOISE).clamp_min(0)
            weight = change.sum((1, 2))
            down, right = (torch.linspace(-1, 1, n) for n in change.shape[1:])
            middle = torch.stack([change.sum(1) @ right, change.sum(2) @ down], -1)
            places.append(middle / weight.clamp_min(1e-6).unsqueeze(-1))
            weights.append(weight)
        place, weight = torch.cat(places), torch.cat(weights)
        moving = weight >= weight.quantile(1 - MOVING)
        seen = (joints[rows] + joints[rows + APART])[moving] / 2
        self.loc, self.scale = seen.mean(0), seen.std(0).clamp_min(1e-6)
        inputs = self._features(seen).double()
        ridge = 10 * torch.eye(inputs.shape[-1], dtype=torch.double)
        self.weights = torch.linalg.solve(inputs.mT @ inputs + ridge, inputs.mT @ place[moving].double()).float()

    def _features(self, joints: Tensor) -> Tensor:
        z = (joints - self.loc) / self.scale
        products = (z.unsqueeze(-1) * z.unsqueeze(-2)).flatten(-2)
        upper = torch.ones(z.shape[-1], z.shape[-1]).triu().flatten() > 0
        return torch.cat([torch.ones_like(z[..., :1]), z, products[..., upper]], -1)

    def __call__(self, joints: Tensor) -> Tensor:
        """Returns columns and rows ``[*, 2]`` from -1 (left, top) to 1, for joints ``[*, J]``."""
        return self._features(joints) @ self.weights
