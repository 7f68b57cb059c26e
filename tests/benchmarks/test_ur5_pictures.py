"""Oracles: the saved camera pixels, the numbers behind the lines."""

import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib", reason="matplotlib is not installed: pip install 'torch_denkf[examples]'")

from benchmarks.common import beliefs
from benchmarks.common.beliefs import read_belief, save_belief
from benchmarks.ur5 import pictures

STEPS = 30
UNSEEN = [5, 6, 20]


@pytest.fixture
def belief(tmp_path):
    generator = torch.Generator().manual_seed(1)
    state = (0.02 * torch.randn(STEPS, 10, generator=generator)).cumsum(0)
    observed = torch.ones(STEPS, 1, dtype=torch.bool)
    observed[UNSEEN] = False
    pixels = torch.full((STEPS, 3, 24, 24), 200, dtype=torch.uint8)
    file = tmp_path / "demo.pt"
    save_belief(file, state + 0.01, torch.full((STEPS, 10), 0.02**2), state, observed, pixels=pixels)
    return read_belief(file)


@pytest.fixture
def figures(monkeypatch):
    """The figures, as they are when they have been written."""
    kept = []
    for module in (beliefs, pictures):
        save = module.save
        monkeypatch.setattr(module, "save", lambda figure, path, save=save: (save(figure, path), kept.append(figure)))
    return kept


def test_joints(belief, tmp_path, figures):
    pictures.NUMBERS.draw(belief, tmp_path / "joints.png", "title")
    for dim, factor in ((0, 180 / np.pi), (6, 180 / np.pi), (9, 100.0)):
        axis = figures[0].axes[dim]
        drawn = {line.get_label(): line for line in axis.lines}
        np.testing.assert_allclose(drawn["truth"].get_ydata(), factor * belief["state"][:, dim], rtol=1e-6)
        np.testing.assert_allclose(drawn["belief"].get_ydata(), factor * belief["belief", "mean"][:, dim], rtol=1e-6)
        np.testing.assert_allclose(drawn["truth"].get_xdata(), 0.08 * np.arange(STEPS), rtol=1e-6)
    assert cv2.imread(str(tmp_path / "joints.png")) is not None


def test_a_video_is_black_where_no_frame_was_seen(belief, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(beliefs, "belief_video", lambda path, belief, pixels, **_: shown.append(pixels))
    pictures.NUMBERS.film(belief, belief["pixels"], (0,), tmp_path / "demo.mp4", "title")
    assert [step for step in range(STEPS) if not shown[0][step].any()] == UNSEEN


def test_ensemble_size(tmp_path, figures):
    rows = [
        {"ensemble_size": str(size), "joint_mae_deg": 2 + seed / size, "ee_mae_cm": 0.5, "ms_per_step": f"{size / 10}"}
        for size in (512, 4, 32)
        for seed in (1, 3)
    ]
    pictures.draw_ensemble_size(rows, tmp_path / "sizes.png")
    joints, effector, time = figures[0].axes
    assert joints.get_xscale() == "log"
    np.testing.assert_allclose(joints.lines[-1].get_xydata(), [[4, 2.5], [32, 2 + 2 / 32], [512, 2 + 2 / 512]])
    np.testing.assert_allclose(effector.lines[-1].get_ydata(), 0.5)
    np.testing.assert_allclose(time.lines[-1].get_ydata(), [0.4, 3.2, 51.2])
    assert [tick.get_text() for tick in time.get_xticklabels()] == ["4", "32", "512"]


def test_a_belief_that_is_not_there_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="demo"):
        read_belief(tmp_path / "demo.pt")
