"""The still of a drive, and frames that say what fails."""

import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf.applications.car.pictures import NamedSpan, drive_picture, named_frames


def tracked(steps=6, members=8):
    generator = torch.Generator().manual_seed(0)
    state = torch.zeros(steps, 5)
    state[:, 0] = torch.arange(steps)
    ensemble = state.unsqueeze(1) + 0.1 * torch.randn(steps, members, 5, generator=generator)
    belief = TensorDict({"ensemble": ensemble, "mean": ensemble.mean(1), "var": ensemble.var(1)}, [steps])
    time = torch.arange(steps).double().unsqueeze(-1) / 10
    entries = {"belief": belief, "state": state, "dead_reckoning": state[:, :3] + 1, "time": time}
    return TensorDict(entries, [steps])


def test_what_fails_is_named_over_the_picture_and_beside_the_bands():
    images, spans = [np.full((40, 90, 3), 20 * n, np.uint8) for n in range(6)], [NamedSpan("rain", 2, 3)]
    map_, *panels = drive_picture(tracked(), images, spans).axes[2:]
    assert "dead reckoning (last reading held)" in [line.get_label() for line in map_.get_lines()]
    for axes in panels:
        assert [patch.get_extents().width > 0 for patch in axes.patches if patch.get_gid() == "rain"] == [True]
    frames = named_frames(images, spans)
    assert [bool((a != b).any()) for a, b in zip(frames, images, strict=True)] == [n in (2, 3) for n in range(6)]
