"""A second look: the trunk that sees the whole picture says where the gripper is, and there one looks closely."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from benchmarks.common.arm.close_look import CloseLook, GlimpseTrunk
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


class Shrink(nn.Module):
    """Averages pixels until a picture is at most :data:`COARSE` wide."""

    def forward(self, images: Tensor) -> Tensor:
        """Pictures ``[N, 3, H / n, W / n]``."""
        times = images.shape[-1] // COARSE
        return nn.functional.avg_pool2d(images, times) if times > 1 else images


def keypoint_trunk() -> nn.Module:
    """The coarse trunk of both presets."""
    return nn.Sequential(Shrink(), KeypointTrunk(3, channels=(32, 48, 96, 128), keypoints=64, features=256))


def glimpse_trunk(side: int) -> GlimpseTrunk:
    """The trunk that looks at the gripper in pictures of a side of so many pixels."""
    return GlimpseTrunk(keypoint_trunk(), CloseLook(side, REACH), 256, raised=RAISE)


@torch.no_grad()
def aim(trunk: GlimpseTrunk, images: Tensor, goal: Tensor) -> None:
    """Sets the patch's centre by least squares to what :func:`project` says, ``[N, 2]``."""
    code = torch.cat([trunk.coarse(part) for part in images.split(128)])
    mean = code.mean(0)
    design = torch.cat([code - mean, torch.ones(len(code), 1)], -1).double()
    ridge = 1e-3 * len(code) * torch.eye(design.shape[-1], dtype=torch.double)
    solution = torch.linalg.solve(design.mT @ design + ridge, design.mT @ goal.double()).float()
    trunk.centre.weight.copy_(solution[:-1].mT)
    trunk.centre.bias.copy_(solution[-1] - trunk.centre.weight @ mean)
