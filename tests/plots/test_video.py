"""Oracles: the frames that were written, decoded by OpenCV and pillow."""

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from tests.plots.runs_for_tests import ensemble_run
from torch_denkf.plots import belief_video, write_video


def smooth_frames(count=6, height=48, width=64):
    y, x = np.mgrid[:height, :width]
    return [
        np.stack([3 * x + 10 * t, 4 * y, np.full_like(x, 30 * t)], -1).clip(0, 255).astype(np.uint8)
        for t in range(count)
    ]


def decoded(file):
    """Returns RGB frames [T, H, W, 3], and frames per second."""
    if file.suffix == ".gif":
        with Image.open(file) as gif:
            durations = []
            frames = []
            for number in range(gif.n_frames):
                gif.seek(number)
                frames.append(np.asarray(gif.convert("RGB")))
                durations.append(gif.info["duration"])
            return np.stack(frames), 1000 * len(durations) / sum(durations)
    reader = cv2.VideoCapture(str(file))
    frames = []
    while (read := reader.read())[0]:
        frames.append(read[1][..., ::-1])
    return np.stack(frames), reader.get(cv2.CAP_PROP_FPS)


@pytest.mark.parametrize("ending", ["mp4", "gif"])
def test_frames_come_back(tmp_path, ending):
    frames = smooth_frames()
    file = write_video(tmp_path / "new" / f"a.{ending}", iter(frames), 12)
    got, fps = decoded(file)
    assert got.shape == (6, 48, 64, 3)
    assert fps == pytest.approx(12, abs=0.05)
    error = np.abs(got.astype(int) - np.stack(frames))
    assert error.mean() < 5
    # Each is nearest to its own.
    for number, frame in enumerate(got.astype(int)):
        assert np.argmin([np.abs(frame - other).mean() for other in frames]) == number


def blue(frame):
    """Finds a band or a line of the belief."""
    return frame[..., 2].astype(int) - frame[..., 0] > 30


def test_video_shows_belief_next_to_the_camera(tmp_path):
    run = ensemble_run(steps=20)
    run["observed"] = torch.arange(20).unsqueeze(-1) != 12
    run["pixels"] = torch.zeros(20, 3, 8, 16)
    run["pixels"][:, 1] = torch.linspace(0.3, 1, 20)[:, None, None]  # ever greener
    settings = {"time": 0.1, "path": {"forward_up": True}, "bands": {"dims": [0, 1]}, "every": 2, "size": (8, 5)}
    got, fps = decoded(belief_video(tmp_path / "a.gif", run, title="a title", **settings))
    assert got.shape == (10, 500, 800, 3)
    assert fps == pytest.approx(5, abs=0.01)
    # The camera's picture is that of the step.
    places = np.argwhere((got[-1, ..., 1] > 230) & (got[-1, ..., 0] < 40) & (got[-1, ..., 2] < 40))
    top, left = places.min(0) + 4
    bottom, right = places.max(0) - 4
    assert (bottom - top) > 40
    for number, frame in enumerate(got):
        colour = frame[top:bottom, left:right].reshape(-1, 3).mean(0)
        expected = 255 * float(run["pixels"][2 * number, 1, 0, 0])
        np.testing.assert_allclose(colour, [0, expected, 0], atol=12)
    # What was not observed has a vermilion frame.
    frames_of_red = [number for number, frame in enumerate(got) if vermilion(frame[: bottom + 40, : right + 8]) > 300]
    assert frames_of_red == [6]
    # Bands grow to the right, and nothing is drawn beyond the step.
    ends = [np.flatnonzero(blue(frame[110:, 440:]).any(0)).max() for frame in got]
    assert (np.diff(ends) > 0).all()
    np.testing.assert_allclose(np.diff(ends[1:-1]), np.diff(ends[1:-1]).mean(), atol=3)
    path = [blue(frame[bottom + 80 :, :right]).sum() for frame in got]
    assert (np.diff(path) > 0).sum() >= 8


def vermilion(frame):
    return (np.abs(frame.astype(int) - (213, 94, 0)).max(-1) <= 60).sum()
