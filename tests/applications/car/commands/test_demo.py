"""The demo leaves a picture and an animation, and says what the library's functions give."""

import re

import pytest
from PIL import Image

from torch_denkf.applications.car.odometry import failing_drive
from torch_denkf.applications.car.odometry.failing_drive import drive_scores, track_failing_drive
from torch_denkf.cli.main import main


@pytest.mark.filterwarnings("ignore:.*:UserWarning")
def test_demo_of_a_rendered_drive(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    tracked = []

    def track(*args, **options):
        tracked.append(track_failing_drive(*args, **options))
        return tracked[0]

    monkeypatch.setattr(failing_drive, "track_failing_drive", track)
    assert main(["demo", "--out", str(tmp_path), "--frames", "36", "--every", "12"]) == 0
    said, scores = capsys.readouterr().out, drive_scores(tracked[0])
    assert len(tracked[0]) == 36
    assert re.search(rf"DEnKF +{scores['filter_end_m']:.1f} m .* {scores['filter_mean_m']:.1f} m", said)
    assert re.search(rf"dead reckoning +{scores['reckoned_end_m']:.1f} m .* {scores['reckoned_mean_m']:.1f} m", said)
    assert f"90 % coverage of the DEnKF: speed {100 * scores['held_v']:.0f} %" in said
    with Image.open(tmp_path / "demo.gif") as animation:
        assert animation.size == (800, 500)
        assert animation.n_frames == 3
    with Image.open(tmp_path / "demo.png") as picture:
        assert picture.width >= 800
