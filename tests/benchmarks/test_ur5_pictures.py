"""Oracles: the saved camera pixels, the simulator's picture of the true state, the numbers behind the lines."""

import sys

import cv2
import numpy as np
import pytest
import torch

from tests.envs.opengl import needs_opengl

pytest.importorskip("matplotlib", reason="matplotlib is not installed: pip install 'torch_denkf[examples]'")

from benchmarks.ur5 import pictures
from torch_denkf.applications.ur5 import UR5TableEnv
from torch_denkf.applications.ur5.envs.expert import UR5Expert

STEPS, SIDE, MEMBERS = 24, 48, 6
UNSEEN = slice(10, 16)


@pytest.fixture(scope="module")
def demo():
    """A rollout of the expert, with a belief whose error and spread grow while frames are missing."""
    needs_opengl()
    env = UR5TableEnv("pick", size=(SIDE, SIDE), pixels_dtype=torch.uint8, max_steps=STEPS, seed=3)
    rollout = env.rollout(STEPS, UR5Expert(env))["next"]
    env.close()
    rng, truth = np.random.default_rng(0), rollout["state"].numpy().astype(np.float32)
    observed = np.ones(STEPS, bool)
    observed[UNSEEN] = False
    spread = np.full((STEPS, 1), 0.004, np.float32)
    spread[UNSEEN, 0] = 0.03 * np.arange(1, 7)
    mean = truth + spread * rng.standard_normal(10).astype(np.float32)
    members = rng.standard_normal((MEMBERS, 10)).astype(np.float32)
    ensemble = mean[:, None] + spread[..., None] * (members - members.mean(0)) / members.std(0, ddof=1)
    return {
        "pixels": rollout["pixels"].permute(0, 2, 3, 1).numpy(),
        "truth": truth,
        "mean": mean,
        "var": ensemble.var(1, ddof=1),
        "ensemble": ensemble,
        "observed": observed,
    }


def save(folder, demo, **changes):
    file = folder / "demo.npz"
    np.savez(file, **{**demo, **changes})
    return file


def video(npz, **kwargs):
    """The decoded frames as RGB integers, and the panels' side in pixels."""
    file = npz.with_suffix(".mp4")
    pictures.draw_video(npz, file, **{"panel": 4 * SIDE, **kwargs})
    capture, frames = cv2.VideoCapture(str(file)), []
    while (read := capture.read())[0]:
        frames.append(read[1][..., ::-1].astype(int))
    assert capture.get(cv2.CAP_PROP_FPS) == 12.5
    return np.stack(frames), 4 * SIDE


LABELS = 74  # rows of the panels that hold text


@pytest.fixture(scope="module")
def plain(demo, tmp_path_factory):
    return video(save(tmp_path_factory.mktemp("plain"), demo), ghosts=0)


def test_left_is_the_camera_and_right_the_arm_at_the_mean(demo, plain):
    frames, side = plain
    assert len(frames) == STEPS
    enlarged = demo["pixels"].repeat(4, 1).repeat(4, 2).astype(int)
    seen = demo["observed"]
    error = np.abs(frames[:, LABELS:side, :side] - enlarged[:, LABELS:side])
    assert error[seen].mean() < 4  # of 255: what the codec loses, colours at half the resolution included
    env = UR5TableEnv("pick", size=(side, side), pixels_dtype=torch.uint8, render_at=(), seed=0)
    env.reset()
    drawn = env.render_state(torch.from_numpy(demo["mean"]), scenery=False).permute(0, 2, 3, 1).numpy().astype(int)
    env.close()
    at_mean = np.abs(frames[:, LABELS:side, side:] - drawn[:, LABELS:])
    assert at_mean.mean() < 4
    other = np.roll(drawn, 12, 0)[:, LABELS:]  # the check would see another pose
    assert np.abs(frames[:, LABELS:side, side:] - other).mean() > 2 * at_mean.mean()


def test_frames_that_were_not_seen_are_marked(demo, plain):
    frames, _ = plain
    edge = frames[:, 40:80, 4:6].mean((1, 2))  # of the camera's panel
    red = (edge[:, 0] > 150) & (edge[:, 1] < 90)
    assert red.tolist() == (~demo["observed"]).tolist()


def test_the_strip_grows_with_time_and_with_the_band(demo, plain):
    frames, side = plain
    strip = frames[:, side:]
    blue = ((strip[..., 2] - strip[..., 0]) > 8).sum((1, 2))
    assert blue[9] < blue[15] < 10 * blue[-1]
    assert blue[15] - blue[10] > 3 * (blue[9] - blue[4])  # the band is wide while nothing is seen
    last = pictures._strip(demo, 2 * side)[1:]
    axis = strip[:, last[2] + 5 : last[3] - 5, last[0] : last[1]]
    cursor = (axis.max((1, 3)) < 110).argmax(-1) / (last[1] - last[0])  # the dark column
    np.testing.assert_allclose(cursor[1:-1], np.linspace(0, 1, STEPS)[1:-1], atol=0.03)


def test_the_estimate_differs_where_the_mean_does(demo, plain, tmp_path):
    mean = demo["mean"].copy()
    mean[20, 0] += 0.5
    frames, side = video(save(tmp_path, demo, mean=mean), ghosts=0)
    difference = np.abs(frames - plain[0])[:, LABELS:side].mean(-1)
    camera, estimate = difference[..., :side].mean((1, 2)), difference[..., side:].mean((1, 2))
    assert estimate.argmax() == 20
    assert estimate[20] > 5 * np.delete(estimate, 20).max()
    assert camera.max() < 1


def test_ghosts_spread_with_the_ensemble(demo, plain, tmp_path):
    frames, side = video(save(tmp_path, demo), ghosts=MEMBERS)
    ghost = (np.abs(frames - plain[0]).max(-1) > 20)[:, LABELS:side, side:].sum((1, 2))
    assert ghost[15] > 1.3 * ghost[[8, 9, 16, 17]].max()
    assert ghost.min() > 0


def test_without_pyav(demo, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)  # importing it fails
    short = {key: value[8:14] for key, value in demo.items()}
    frames, side = video(save(tmp_path, short), ghosts=0)
    enlarged = short["pixels"].repeat(4, 1).repeat(4, 2).astype(int)
    assert len(frames) == 6
    assert np.abs(frames[:2, LABELS:side, :side] - enlarged[:2, LABELS:side]).mean() < 5


# ------------------------------------------------------------------------------------------------------------ plots


def invented(folder, steps=30, unseen=(), name="demo"):
    rng = np.random.default_rng(1)
    truth = np.cumsum(rng.standard_normal((steps, 10)) * 0.02, 0)
    mean, var = truth + 0.01, np.full((steps, 10), 0.02**2)
    observed = np.ones((steps, 1), bool)
    observed[list(unseen)] = False
    ensemble = mean[:, None] + 0.02 * rng.standard_normal((steps, 5, 10))
    pixels = np.zeros((steps, 8, 8, 3), np.uint8)
    file = folder / f"{name}.npz"
    np.savez(file, pixels=pixels, truth=truth, mean=mean, var=var, ensemble=ensemble, observed=observed)
    return file


@pytest.fixture
def figures(monkeypatch):
    """The figures, as they are when they have been written."""
    kept = []
    save = pictures.save
    monkeypatch.setattr(pictures, "save", lambda figure, path: (save(figure, path), kept.append(figure)))
    return kept


def lines(axis):
    return {line.get_label(): line for line in axis.lines}


def test_joints(tmp_path, figures):
    npz = invented(tmp_path, unseen=(5, 6, 20))
    pictures.draw_joints(npz, tmp_path / "joints.png", "title")
    saved, axes = np.load(npz), np.array(figures[0].axes).reshape(5, 2).T.ravel()
    for dim, factor in ((0, 180 / np.pi), (6, 180 / np.pi), (9, 100.0)):
        drawn = lines(axes[dim])
        np.testing.assert_allclose(drawn["truth"].get_ydata(), factor * saved["truth"][:, dim])
        np.testing.assert_allclose(drawn["mean of the belief"].get_ydata(), factor * saved["mean"][:, dim])
        np.testing.assert_allclose(drawn["truth"].get_xdata(), 0.08 * np.arange(30))
        band, shade = axes[dim].collections
        corners = band.get_paths()[0].vertices
        at_start = corners[np.isclose(corners[:, 0], 0.0), 1]
        width = np.ptp(at_start)  # of 90 % of a Gaussian with deviation 0.02
        assert width == pytest.approx(2 * 1.6449 * 0.02 * factor, rel=1e-3)
        spans = [(path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in shade.get_paths()]
        np.testing.assert_allclose(spans, [(0.36, 0.44), (0.44, 0.52), (1.56, 1.64)])
    assert cv2.imread(str(tmp_path / "joints.png")).shape[:2] == (1200, 1200)


def test_end_effector(tmp_path, figures):
    npzs = [invented(tmp_path, name="a"), invented(tmp_path, unseen=(3, 4), name="b")]
    pictures.draw_end_effector(npzs, tmp_path / "paths.png")
    first, second = figures[0].axes
    for axis, npz in ((first, npzs[0]), (second, npzs[1])):
        drawn, saved = lines(axis), np.load(npz)
        np.testing.assert_allclose(np.transpose(drawn["truth"].get_data_3d()), 100 * saved["truth"][:, 7:])
        np.testing.assert_allclose(np.transpose(drawn["mean of the belief"].get_data_3d()), 100 * saved["mean"][:, 7:])
        assert len({round(float(np.ptp(limits)), 6) for limits in (axis.get_xlim(), axis.get_ylim())}) == 1
    assert first.get_title() == "a: 1.73 cm on average"  # 0.01 m along each axis
    assert "no frame seen" not in lines(first)
    np.testing.assert_allclose(
        np.transpose(lines(second)["no frame seen"].get_data_3d()), 100 * np.load(npzs[1])["mean"][3:5, 7:]
    )


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


def test_what_is_wrong_is_named(tmp_path):
    npz = invented(tmp_path)
    whole = dict(np.load(npz))
    np.savez(npz, **{key: value for key, value in whole.items() if key != "var"})
    with pytest.raises(KeyError, match=r"demo.npz lacks \['var'\]"):
        pictures.read_belief(npz)
    np.savez(npz, **{**whole, "ensemble": whole["ensemble"][1:]})
    with pytest.raises(ValueError, match=r"demo.npz: 'ensemble' has shape \(29, 5, 10\), not 3 dimensions of 30 steps"):
        pictures.read_belief(npz)
    with pytest.raises(ValueError, match="no rows"):
        pictures.draw_ensemble_size([], tmp_path / "sizes.png")
    with pytest.raises(KeyError, match="ms_per_step"):
        pictures.draw_ensemble_size([{"ensemble_size": 4, "joint_mae_deg": 1, "ee_mae_cm": 1}], tmp_path / "sizes.png")
