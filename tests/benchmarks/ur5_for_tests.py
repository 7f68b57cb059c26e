"""Statistics of an invented arm, and random states of it."""

import torch

from benchmarks.common.arm.sensors import Statistics

FACTS = Statistics(
    loc=torch.linspace(-1, 1, 10),
    scale=torch.linspace(0.1, 1, 10),
    rate=torch.full((7,), 0.01),
    acceleration=torch.full((7,), 0.001),
    jerk=torch.full((7,), 0.001),
    pixel_loc=torch.full((3,), 0.5),
    pixel_scale=torch.full((3,), 0.2),
    size=(32, 32),
)


def states(*size, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return FACTS.loc + FACTS.scale * torch.randn(*size, 10, generator=generator)
