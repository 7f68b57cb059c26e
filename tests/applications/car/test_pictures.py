"""The ellipse holds 90 % of a Gaussian; each frame shows what has happened until then."""

import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf.applications.car.pictures import NamedSpan, _Animation, _Drive, drive_animation, drive_picture


def tracked(steps=6, members=4000):
    generator = torch.Generator().manual_seed(0)
    state = torch.zeros(steps, 5)
    state[:, 0] = torch.arange(steps)
    spread = torch.tensor([[2.0, 0.0], [1.5, 0.5]])
    ensemble = state.unsqueeze(1).repeat(1, members, 1)
    ensemble[..., :2] += torch.randn(steps, members, 2, generator=generator) @ spread.T
    belief = TensorDict({"ensemble": ensemble, "mean": ensemble.mean(1), "var": ensemble.var(1)}, [steps])
    time = torch.arange(steps).double().unsqueeze(-1) / 10
    entries = {"belief": belief, "state": state, "dead_reckoning": state[:, :3] + 1, "time": time}
    return TensorDict(entries, [steps])


def test_the_ellipse_holds_nine_tenths():
    drive = _Drive(tracked(), [])
    centre, width, height, angle = drive.ellipse_at(3)
    points = np.stack([-drive.members[3, :, 1], drive.members[3, :, 0]], -1) - centre
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turned = points @ np.array([[cos, -sin], [sin, cos]])
    inside = ((turned / np.array([width / 2, height / 2])) ** 2).sum(-1) <= 1
    assert abs(inside.mean() - 0.9) < 0.015


def test_frames_grow_and_name_what_fails(tmp_path):
    data, images = tracked(members=8), [np.full((10, 30, 3), 20 * n, np.uint8) for n in range(6)]
    spans = [NamedSpan("rain", 2, 3)]
    scene = _Animation(data, images, spans, "title")
    for step, name in ((0, "camera works"), (3, "rain"), (4, "camera works")):
        assert scene.frame(step).shape == (500, 800, 3)
        assert scene.camera.get_title() == name
        x, y = scene.parts["truth"].get_data()
        assert (len(x), y[-1]) == (step + 1, step)
        assert [cover.get_x() for cover in scene.covers] == [step / 10] * 2
    counted = []
    file = drive_animation(tmp_path / "a.gif", data, images, spans, every=2, fps=2, progress=counted.append)
    assert file.exists()
    assert sum(counted) == 3 + 2
    texts = [text.get_text() for axes in drive_picture(data, images, spans).axes for text in (axes.title, *axes.texts)]
    assert texts.count("rain") == 2, "over the camera's picture and in the panel"
