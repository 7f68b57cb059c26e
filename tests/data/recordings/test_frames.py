"""Pictures of videos whose rate varies, of folders with other files, and copies of data sets."""

import os
import shutil
import warnings
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from tests.data.recordings.own_files import SIZE, grey, write_images, write_video
from torch_denkf.applications.car.odometry.images import read_frames
from torch_denkf.data import Images, Recording, RecordingReplay, Video
from torch_denkf.plots._frames import write_mp4


def write_varying(av, file, times):
    with av.open(str(file), "w") as container:
        stream = container.add_stream("ffv1", rate=2)  # as the file says, from which the number of frames is guessed
        stream.width, stream.height, stream.pix_fmt = SIZE[1], SIZE[0], "bgr0"
        stream.codec_context.time_base = Fraction(1, 1000)
        for number, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(grey(number), format="rgb24")
            frame.pts, frame.time_base = round(time * 1000), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def test_variable_frame_rate_loses_no_frame(tmp_path):
    av = pytest.importorskip("av")
    times = np.array([0.0, 0.5, 1.0, *(1.5 + np.arange(40) / 200)])
    write_varying(av, tmp_path / "run.mkv", times)
    data = RecordingReplay(Recording(camera=Video(tmp_path / "run.mkv")), size=SIZE, cache=None)
    np.testing.assert_allclose(data[:]["time"].squeeze(-1), times, atol=1e-6)
    red = [int(grey(number)[0, 0, 0]) for number in range(43)]
    assert (data[:]["pixels"][:, 0, 0, 0] * 255).round().int().tolist() == red


@pytest.mark.parametrize("name", ["run.mkv", "run.avi"])
def test_truncated_video_is_reported(tmp_path, name):
    file = tmp_path / name
    write_video(file, 12)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(Video(file).read(SIZE, None, False)) == 12
    data = file.read_bytes()
    for share in (0.95, 0.9, 0.8):
        file.write_bytes(data[: int(share * len(data))])
        with pytest.warns(UserWarning, match=rf"{name} shows .* s, but announces 1.2 s: is it cut\?"):
            left = Video(file).read(SIZE, None, False)
        assert len(left) < 12
        shown = (10 * left["time"]).round().int().tolist()
        assert (left["pixels"].numpy() == np.stack([grey(k).transpose(2, 0, 1) for k in shown])).all()


def test_names_that_are_no_utf_8(tmp_path):
    """OpenCV crashes on such a name of a video; pictures are read by Python."""
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/r\xff"))
    write_images(tmp_path / "run", ["0.0.png", "0.1.png"])
    (tmp_path / "run").rename(folder)
    assert len(Images(folder).read(SIZE, tmp_path / "cache", False)) == 2
    write_video(tmp_path / "run.mkv", 3)
    file = folder / "run.mkv"
    shutil.copy(tmp_path / "run.mkv", file)
    with pytest.raises(ValueError, match=r"r\\xff/run.mkv' is no UTF-8; rename it"):
        Video(file).read(SIZE, None, False)
    with pytest.raises(ValueError, match="is no UTF-8"):
        read_frames(file)
    with pytest.raises(ValueError, match="is no UTF-8"):
        write_mp4(folder / "out.mp4", [grey(0)], 10.0)
