"""A second look: the trunk that sees the whole picture says where the gripper is, and there one looks closely."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from benchmarks.common.arm.close_look import FEATURES, CloseLook
from torch_denkf.applications.ur5.simulation.domains import SIM, Domain
from torch_denkf.modules import KeypointTrunk

REACH, RAISE = 0.36, 0.15  # half a patch's side and its shift upwards, in half pictures: hand and wrist
COARSE = 112  # pixels: the side of the picture that the first look gets


def project(places: Tensor, look: Domain = SIM) -> Tensor:
    """Projects places ``[*, 3]`` into a camera's picture: columns and rows ``[*, 2]`` from -1 (left, top) to 1.

    Only where the first looks go follows from it, so that roll and lens are left out.
    """
    camera, target = torch.tensor(look.camera), torch.tensor(look.target)
    ahead = nn.functional.normalize(target - camera, dim=0)
    right = nn.functional.normalize(torch.linalg.cross(ahead, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    up = torch.linalg.cross(right, ahead)
    way = places - camera
    depth = (way @ ahead) * torch.tan(torch.tensor(look.field / 2).deg2rad())
    return torch.stack([way @ right / depth, -(way @ up) / depth], -1)


class GlimpseTrunk(nn.Module):
    """A coarse trunk, and convolutions on a patch of the full resolution around the gripper.

    The gripper is a dozen pixels wide in a picture of 112: what its opening and its turn look like is lost in maps of
    a sixteenth of that.

    Args:
        coarse: sees the whole picture, ``[N, 3, H, W]`` to ``[N, F]``.
        picture: H and W in pixels.
        size: F.
        features: width of the output.

    Shape:
        ``[N, 3, H, W]`` to ``[N, features]``.
    """

    def __init__(self, coarse: nn.Module, picture: int, size: int = 256, features: int = 256):
        super().__init__()
        self.coarse = coarse
        self.centre = nn.Linear(size, 2)
        self.close = CloseLook(picture, REACH)
        self.mix = nn.Sequential(nn.Linear(size + FEATURES + 2, features), nn.ReLU())

    def forward(self, images: Tensor) -> Tensor:
        """Features of images."""
        code = self.coarse(images)
        centre = self.centre(code)
        return self.mix(torch.cat([code, self.close(images, centre, RAISE), centre], -1))

    @torch.no_grad()
    def aim(self, images: Tensor, goal: Tensor) -> float:
        """Sets the patch's centre by least squares to what :func:`project` says ``[N, 2]``; its error in pixels."""
        code = torch.cat([self.coarse(part) for part in images.split(128)])
        mean = code.mean(0)
        design = torch.cat([code - mean, torch.ones(len(code), 1)], -1).double()
        ridge = 1e-3 * len(code) * torch.eye(design.shape[-1], dtype=torch.double)
        solution = torch.linalg.solve(design.mT @ design + ridge, design.mT @ goal.double()).float()
        self.centre.weight.copy_(solution[:-1].mT)
        self.centre.bias.copy_(solution[-1] - self.centre.weight @ mean)
        return float((self.centre(code) - goal).abs().mean()) * images.shape[-1] / 2


class Shrink(nn.Module):
    """Averages pixels until a picture is at most :data:`COARSE` wide."""

    def forward(self, images: Tensor) -> Tensor:
        """Pictures ``[N, 3, H / n, W / n]``."""
        times = images.shape[-1] // COARSE
        return nn.functional.avg_pool2d(images, times) if times > 1 else images


def keypoint_trunk() -> nn.Module:
    """The coarse trunk of both presets."""
    return nn.Sequential(Shrink(), KeypointTrunk(3, channels=(32, 48, 96, 128), keypoints=64, features=256))
