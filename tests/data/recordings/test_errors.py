"""Raises for one's own files with the file, the line and the column."""

from functools import partial

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest

from tests.data.recordings.own_files import SIZE, write_csv, write_images, write_video
from torch_denkf.data import Images, Recording, RecordingReplay, Table, Video

open_runs = partial(RecordingReplay, size=SIZE, cache=None, progress=False)


def fails(error, match, *, clock=None, name=None, **streams):
    with pytest.raises(error, match=match):
        open_runs(Recording(name=name, **streams), clock=clock)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("tick,x\n0,1\n1,2\n", r"run.csv lacks the columns \['time'\]; it has \['tick', 'x'\]: pass time="),
        ("time,x\n0,1\n1,nan\n", r"run.csv:3: 'x' is 'nan', which is no finite number"),
        ("time,x\n0,1\n\n1,one\n", r"run.csv:4: 'x' is 'one', which is no finite number"),
        ("time,x\n0,1\n1\n", r"run.csv:3: 'x' is ''"),
        ("time,x\n0,1\ninf,3\n", r"run.csv:3: 'time' is 'inf'"),
        ("time,x\n0,1\n2,1\n1.5,1\n", r"run.csv:4: 'time' goes from 2 to 1.5 s; times must ascend"),
        ("time,x\n0,1\n2,1\n2,1\n", r"run.csv:4: 'time' goes from 2 to 2 s"),
        ("time,x\n0,1\n0.1,1_1\n", r"run.csv:3: 'x' is '1_1'"),
        ("time,x\n0,1\n0.1,1e39\n", r"run.csv:3: 'x' is '1e39'"),  # infinite in float32
        ("time,x\n0,1\n1_0,1\n", r"run.csv:3: 'time' is '1_0'"),
        ("t,time,x\n0,1700000000.25,1\n0,1700000000.125,2\n", "from 1700000000.25 to 1700000000.125 s"),
        ("0,1\n0.1,1\n", "its first line must name the columns, or pass columns= with 2 names"),
        ("time\n0\n1\n", "has no column to read beside 'time'"),
        ("time,x\n0,1\n0.1,1,5\n", r"run.csv:3: 3 cells for 2 columns; write decimals with points"),
        ("time,x\n", r"run.csv has no rows"),
        ("", r"run.csv lacks the columns \['time'\]; it has \[\]"),
    ],
)
def test_tables(tmp_path, text, match):
    (tmp_path / "run.csv").write_text(text)
    fails(ValueError, match, state=Table(tmp_path / "run.csv"))


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_other_encodings(tmp_path, encoding):
    (tmp_path / "run.csv").write_text("time,größe\n0,1\n", encoding)
    fails(ValueError, r"run.csv is no text in UTF-8 .*store it again", state=Table(tmp_path / "run.csv"))


def test_parquet(tmp_path):
    file = tmp_path / "run.parquet"
    parquet.write_table(
        pa.table({"time": [0.0, 1, 2], "x": [1.0, None, 3], "v": [[1], [2], [3]], "s": list("abc")}), file
    )
    fails(ValueError, r"run.parquet, row 1 \(from 0\): 'x' is None, which is no finite", state=Table(file, ["x"]))
    fails(ValueError, r"run.parquet: 'v' holds list.*, not a number a row", state=Table(file, ["v"]))
    fails(ValueError, r"run.parquet: 's' holds string, not a number a row", state=Table(file, ["s"]))
    fails(ValueError, r"run.parquet lacks the columns \['y'\]", state=Table(file, ["y"]))
    file.write_bytes(file.read_bytes()[:100])
    fails(ValueError, r"run.parquet is no complete parquet file", state=Table(file, ["x"]))


def test_videos(tmp_path):
    write_video(tmp_path / "run.mkv", 5)
    state = Table(tmp_path / "run.csv")
    write_csv(tmp_path / "run.csv", time=np.arange(5) / 10 + 1e6, x=np.arange(5))
    fails(
        ValueError,
        r"recording 'run': the streams have fewer than two rows in common: camera from 0 to 0.4 s, state from 1000000 "
        r"to 1000000.4 s; .* pass start=",
        camera=Video(tmp_path / "run.mkv"),
        state=state,
    )
    fails(FileNotFoundError, r"no video .*none.mkv", camera=Video(tmp_path / "none.mkv"))
    for name, target in (("nowhere.mkv", "none.mkv"), ("itself.mkv", "itself.mkv")):
        (tmp_path / name).symlink_to(target)
        fails(FileNotFoundError, rf"no video .*{name}", camera=Video(tmp_path / name))
    write_video(tmp_path / "six.mkv", 6)
    fails(ValueError, r"run.csv has 5 times, but .*six.mkv has 6 pictures",
          camera=Video(tmp_path / "six.mkv", times=tmp_path / "run.csv"))  # fmt: skip
    fails(ValueError, r"times\[1\]: 'time' goes from 3 to 2 s",
          camera=Video(tmp_path / "run.mkv", times=[3, 2, 1, 0, -1]))  # fmt: skip
    fails(ValueError, r"times\[2\]: 'time' is nan", camera=Video(tmp_path / "run.mkv", times=[0, 1, np.nan, 3, 4]))
    with pytest.raises(ValueError, match="start must be finite; got nan"):
        Video(tmp_path / "run.mkv", start=np.nan)
    (tmp_path / "run.mkv").write_bytes(b"nothing")
    fails(ValueError, r"no frame of .*run.mkv can be decoded.*AV1", camera=Video(tmp_path / "run.mkv"))


def test_images(tmp_path):
    fails(FileNotFoundError, r"no folder .*run; check", camera=Images(tmp_path / "run"))
    write_images(tmp_path / "run", ["a.png", "b.png"])
    fails(ValueError, r"nothing says when the images in .*run were taken: .*'a.png'.*pass times= or rate=",
          camera=Images(tmp_path / "run"))  # fmt: skip
    for rate in (0.0, np.inf):
        with pytest.raises(ValueError, match=r"rate must be finite and above 0; got"):
            Images(tmp_path / "run", rate=rate)
    with pytest.raises(ValueError, match="times or rate, not both"):
        Images(tmp_path / "run", rate=1.0, times=[0.0, 1.0])
    cv2.imwrite(str(tmp_path / "run/c.png"), np.zeros((5, 7, 3), np.uint8))
    fails(ValueError, r"c.png is 7 pixels wide and 5 high, but .*a.png is 32 pixels wide",
          camera=Images(tmp_path / "run", rate=1.0))  # fmt: skip
    (tmp_path / "empty").mkdir()
    fails(ValueError, r"no images in .*empty; expected names that end in .png", camera=Images(tmp_path / "empty"))


def test_streams_and_clocks(tmp_path):
    write_csv(tmp_path / "run.csv", time=[0, 1, 2], x=[1, 2, 3])
    table = Table(tmp_path / "run.csv")
    fails(
        ValueError, "clock is a stream, one of .*'state'.*, or a rate in Hz; got 'camera'", state=table, clock="camera"
    )
    fails(ValueError, "a positive rate in Hz, got 0", state=table, clock=0)
    for name in ("time", "_row", "_reset", "reward", "recorded", "belief"):
        fails(ValueError, f"an entry '{name}' of its own", **{name: table})
    fails(TypeError, "name is that of the recording, got Table", name=table, state=table)
    with pytest.raises(TypeError, match="a list of them; got Table"):
        RecordingReplay([table])
    fails(ValueError, "10 rows per second from 0 to 200000000 s are more than 1e\\+08; .*unit=", clock=10.0,
          state=Table(write_csv(tmp_path / "ms.csv", time=[0, 1e8, 2e8], x=[1, 2, 3])))  # fmt: skip
    fails(ValueError, "an entry 'imu_observed' of its own", imu_observed=table)
    fails(ValueError, r"one camera, got \['left', 'right'\]", left=Video("a.mp4"), right=Video("b.mp4"))
    fails(TypeError, "stream 'state' is a Video, Images or Table, got str", state="run.csv")
    with pytest.raises(ValueError, match="a recording needs streams"):
        Recording()
    with pytest.raises(ValueError, match="sample is one of 'last', 'nearest', 'linear', got 'cubic'"):
        Table("run.csv", sample="cubic")
    with pytest.raises(ValueError, match="sample is one of 'last', 'nearest', got 'linear'"):
        Video("run.mp4", sample="linear")
    with pytest.raises(ValueError, match="unit is one of 's', 'ms', 'us', 'ns', got 'min'"):
        Table("run.csv", unit="min")
    with pytest.raises(ValueError, match="tolerance must be finite and above 0; got"):
        Table("run.csv", tolerance=0.0)


def test_recordings_that_do_not_go_together(tmp_path):
    write_csv(tmp_path / "a.csv", time=[0, 1], x=[1, 2])
    write_csv(tmp_path / "b.csv", time=[0, 1], y=[1, 2])
    a, b = Table(tmp_path / "a.csv"), Table(tmp_path / "b.csv")
    with pytest.raises(
        ValueError, match=r"told apart by their names, but \['a'\] are there twice; pass Recording\(name="
    ):
        open_runs([Recording(state=a), Recording(state=a)])
    with pytest.raises(ValueError, match=r"recording 'b' has \['y'\] in 'state', the first one has \['x'\]"):
        open_runs([Recording(state=a), Recording(state=b)])
    with pytest.raises(ValueError, match=r"recording 'b' has the streams \['imu'\], 'a' has \['state'\]"):
        open_runs([Recording(state=a), Recording(imu=b)])
    with pytest.raises(ValueError, match="there are no recordings"):
        open_runs([])
    assert len(open_runs([Recording(state=a), Recording(state=a, name="again")])) == 4
