"""The sensor of pictures: it finds an arm's joints; where they should be, geometry says."""

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
    """Convolution, normalisation, ReLU."""
    return nn.Sequential(
        nn.Conv2d(before, after, kernel, stride, kernel // 2), nn.GroupNorm(8, after), nn.ReLU(inplace=True)
    )


class Maps(nn.Module):
    """Pictures ``[N, 1, H, W]`` to the logits of a map for each joint ``[N, J, H / 2, W / 2]``.

    Three scales on the way down, and what was seen at each is added on the way up: which joint it is, only the whole
    arm says; where it is, only the fine scale.
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
    """Reads where an arm's links end, m ``[*B, 2 J]``, from pictures ``[*B, 1, H, W]``.

    A map for each joint says where in the picture it is; its mean is the joint's place.

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
        """Scores pictures ``[N, 1, H, W]`` and states: maps against a bump of a cell at each joint, and places."""
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
    """Returns the ends of the links of members ``[*B, E, 3 J + 2 J]``, and what the sensor adds to it: its biases."""

    def __init__(self, arm: Arm):
        super().__init__(nn.Identity(), [("forecast", "ensemble")], [("forecast", "observation")])
        self.arm, self.observation_dim = arm, 2 * arm.joints

    def compute(self, ensemble: Tensor) -> Tensor:
        places = self.arm.places(self.arm.split(ensemble)[0]).flatten(-2)
        return places + ensemble[..., 3 * self.arm.joints :]


class FromPlaces(m.FromSensor):
    """A belief of an arm and of its sensor's biases from the places that the sensor reads first."""

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
