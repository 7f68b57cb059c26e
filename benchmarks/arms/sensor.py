"""The sensor of images, which finds an arm's joints, and its measurement model by geometry."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from benchmarks.arms.arms import SIDE, Arm
from torch_denkf import modules as m
from torch_denkf.functional.moments import ensemble_mean, ensemble_var
from torch_denkf.submodel import Sensor

PIXELS = 0.25, 0.1  # mean and standard deviation of a pixel
CELLS = SIDE // 2  # of a map, along a side
MIDDLES = (2 * torch.arange(CELLS) + 1) / CELLS - 1  # of cells, from -1 (left) to 1 (right)


def layers(before: int, after: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """Returns convolution, normalisation and ReLU."""
    return nn.Sequential(
        nn.Conv2d(before, after, kernel, stride, kernel // 2), nn.GroupNorm(8, after), nn.ReLU(inplace=True)
    )


class Maps(nn.Module):
    """Maps images ``[N, 1, H, W]`` to the logits of a map for each joint ``[N, J, H / 2, W / 2]``.

    A U-net of three scales: the coarse one tells the joints apart, the fine one locates them.
    """

    def __init__(self, joints: int, channels: tuple[int, int, int] = (24, 32, 48)):
        super().__init__()
        fine, middle, coarse = channels
        self.fine = nn.Sequential(layers(3, fine, 5, 2), layers(fine, fine))
        self.middle = nn.Sequential(layers(fine, middle, stride=2), layers(middle, middle))
        self.coarse = nn.Sequential(layers(middle, coarse, stride=2), layers(coarse, coarse), layers(coarse, coarse))
        self.up_to_middle = nn.Sequential(nn.Conv2d(coarse, middle, 1), nn.Upsample(scale_factor=2))
        self.up_to_fine = nn.Sequential(nn.Conv2d(middle, fine, 1), nn.Upsample(scale_factor=2))
        self.mix_middle, self.mix_fine = layers(middle, middle), layers(fine, fine)
        self.out = nn.Conv2d(fine, joints, 1)

    def forward(self, pixels: Tensor) -> Tensor:
        line = torch.linspace(-1, 1, pixels.shape[-1])
        grid = torch.stack(torch.meshgrid(line, line, indexing="xy")).expand(len(pixels), -1, -1, -1)
        fine = self.fine(torch.cat([(pixels - PIXELS[0]) / PIXELS[1], grid], 1))
        middle = self.middle(fine)
        middle = self.mix_middle(middle + self.up_to_middle(self.coarse(middle)))
        return self.out(self.mix_fine(fine + self.up_to_fine(middle)))


class JointSensor(Sensor):
    """Estimates the ends of an arm's links, m ``[*B, 2 J]``, from images ``[*B, 1, H, W]``.

    The estimate is the mean of a map over the image for each joint.

    Reference:
        Lee et al., "Camera-to-robot pose estimation from a single image", ICRA 2020, arXiv:1911.09231: joints on maps.
    """

    def __init__(self, arm: Arm):
        network = Maps(arm.joints).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        super().__init__(network, ["pixels"], [("sensor", "reading")])
        self.arm, self.observation_dim = arm, 2 * arm.joints

    def places(self, maps: Tensor) -> Tensor:
        """Returns means of maps ``[*B, J, H, W]``, m ``[*B, J, 2]``."""
        share = maps.flatten(-2).softmax(-1).unflatten(-1, maps.shape[-2:])
        middle = torch.stack([share.sum(-2) @ MIDDLES, -(share.sum(-1) @ MIDDLES)], -1)  # rows go down
        return self.arm.view * middle

    def compute(self, pixels: Tensor) -> Tensor:
        maps = self.module(pixels.flatten(0, -4))
        return self.places(maps).flatten(-2).unflatten(0, pixels.shape[:-3])

    def losses(self, pixels: Tensor, state: Tensor) -> dict[str, Tensor]:
        """Returns the losses of images ``[N, 1, H, W]`` and states: maps against a bump at each joint, and places."""
        maps, truth = self.module(pixels), self.arm.places(self.arm.split(state)[0])
        across, up = (truth / self.arm.view).unsqueeze(-1).unbind(-2)
        column, row = ((-0.5 * ((MIDDLES - at) * CELLS / 2).square()).softmax(-1) for at in (across, -up))
        bump = row.unsqueeze(-1) * column.unsqueeze(-2)
        error = (self.places(maps) - truth) / self.arm.view
        return {
            "loss_maps": -(bump.flatten(-2) * maps.flatten(-2).log_softmax(-1)).sum(-1).mean(),
            "loss_places": 20 * error.square().mean(),
        }


class JointPlaces(Sensor):
    """Maps members ``[*B, E, 3 J + 2 J]`` to the ends of their links plus the sensor's biases."""

    def __init__(self, arm: Arm):
        super().__init__(nn.Identity(), [("forecast", "ensemble")], [("forecast", "observation")])
        self.arm, self.observation_dim = arm, 2 * arm.joints

    def compute(self, ensemble: Tensor) -> Tensor:
        places = self.arm.places(self.arm.split(ensemble)[0]).flatten(-2)
        return places + ensemble[..., 3 * self.arm.joints :]


class FromPlaces(m.FromSensor):
    """Initial belief of an arm and of its sensor's biases from the first places that the sensor reads."""

    def __init__(self, arm: Arm, *, mean: Tensor, std: Tensor, bias: Tensor, ensemble_size: int):
        mean, std = torch.cat([mean, torch.zeros_like(bias)]), torch.cat([std, bias])
        settings = {"observation_key": ("sensor", "reading"), "ensemble_size": ensemble_size}
        super().__init__(range(2 * arm.joints), mean=mean, std=std, **settings)
        self.arm = arm

    def _members(self, center, std, noise, batch_size):
        reading, rest = super()._members(center, std, noise, batch_size)[0].tensor_split((2 * self.arm.joints,), -1)
        velocity, bias = rest.tensor_split((self.arm.joints,), -1)
        angles = self.arm.angles((reading - bias).unflatten(-1, (-1, 2)))
        ensemble = torch.cat([self.arm.join(angles, velocity), bias], -1)
        return ensemble, ensemble_mean(ensemble), ensemble_var(ensemble)
