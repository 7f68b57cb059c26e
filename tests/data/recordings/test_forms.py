"""Text logs in the forms in which robots and their tools write them, each read as it is, and ROS bags."""

import numpy as np
import pytest

from torch_denkf.data import Table

S = [1395837505.25, 1395837505.5, 1395837505.75]  # s since 1970, which float64 holds
X = [1.5, -2.0, 3.0]
Q = "0.0 0.0 0.6 0.8"
POSE = "1 0 0 {} 0 1 0 2 0 0 1 3"


def lines(head, row, times=S):
    return "\n".join([*([head] if head else []), *(row(t, x) for t, x in zip(times, X, strict=True))]) + "\n"


def whole(unit):
    return [int(t * unit) for t in S]


FORMS = {
    "blanks": (lines("t gyro", lambda t, x: f"   {t:.7e}   {x:.7e}", [0.5, 0.75, 1.0]), {}, [0.5, 0.75, 1.0]),
    "blanks and tabs": (lines("t \t gyro", lambda t, x: f"{t}\t {x}"), {}, S),
    "semicolons and decimal commas": (lines("time;x", lambda t, x: f"{t};{x}".replace(".", ",")), {}, S),
    "TUM": (lines("", lambda t, x: f"{t} {x} 0.5 0.25 {Q}"), {"columns": ["tx"]}, S),
    "TUM with comments": (
        lines("# ground truth\n# timestamp tx ty tz qx qy qz qw", lambda t, x: f"{t} {x} 0.5 0.25 {Q}"),
        {"columns": ["tx"]},
        S,
    ),
    "EuRoC": (lines("#timestamp [ns],w_RS_S_x [rad s^-1]", lambda t, x: f"{t},{x}", whole(1e9)), {}, S),
    "KITTI times": (lines("", lambda t, x: f"{t:e}", [0.0, 0.125, 0.25]), {}, [0.0, 0.125, 0.25]),
    "KITTI's dates": (
        lines("", lambda t, x: f"2014-03-26 12:38:25.{t}", ["250000000", "500000000", "750000000"]),
        {},
        S,
    ),
    "no header": (lines("", lambda t, x: f"{t},{x},9"), {"columns": ["when", "x", "y"], "time": "when"}, S),
    "dates of ISO": (lines("date,x", lambda t, x: f"2014-03-26T13:38:25.{t}+01:00,{x}", ["25", "50", "75"]), {}, S),
    "a date and a time of day": (
        lines("x,date,time", lambda t, x: f"{x},2014/03/26,12:38:{t}", ["25.25", "25.5", "25.75"]),
        {},
        S,
    ),
    "secs and nsecs": (
        lines(
            "Time,header.seq,header.stamp.secs,header.stamp.nsecs,header.frame_id,x",
            lambda t, x: f"1395837509.0,7,1395837505,{t},imu,{x}",
            [250_000_000, 500_000_000, 750_000_000],
        ),
        {"columns": ["x"]},
        S,
    ),
    "sec and nanosec": (
        lines(
            "header.stamp.sec;header.stamp.nanosec;x",
            lambda t, x: f"1395837505;{t};{x}",
            [250_000_000, 500_000_000, 750_000_000],
        ),
        {},
        S,
    ),
    "rostopic echo -p": (
        lines("%time,field.header.seq,field.header.frame_id,field.x", lambda t, x: f"{t},4,base,{x}", whole(1e9)),
        {"columns": ["field.x"]},
        S,
    ),
    "bag to CSV": (
        lines(
            "rosbagTimestamp,header,seq,stamp,secs,nsecs,frame_id,x",
            lambda t, x: f'{t},"",1,"",1395837505,{t - 1395837505000000000},"odom",{x}',
            whole(1e9),
        ),
        {"columns": ["x"]},
        S,
    ),
    "ms by name": (lines("millis,x", lambda t, x: f"{t},{x}", [500, 750, 1000]), {}, [0.5, 0.75, 1.0]),
    "us by size": (lines("timestamp,x", lambda t, x: f"{t},{x}", whole(1e6)), {}, S),
    "a row of units": (lines("time,x\n[ms],[m]", lambda t, x: f"{t},{x}", [500, 750, 1000]), {}, [0.5, 0.75, 1.0]),
    "empty cells of slow sensors": (
        lines("time,imu,gps", lambda t, x: f"{t},0.5,{x}\n{t + 0.125},0.25,"),
        {"columns": ["gps"]},
        S,
    ),
    "@ lines": (lines("@relation run\n@data\ntime,x", lambda t, x: f"{t},{x}"), {}, S),
    "text in a column": (lines("t|mode|x", lambda t, x: f"{t}|auto|{x}"), {}, S),
}


@pytest.mark.parametrize("form", FORMS)
def test_forms_that_are_read(tmp_path, form):
    text, options, times = FORMS[form]
    (tmp_path / "log.txt").write_text(text)
    if form.startswith("KITTI"):  # of pictures, or of poses
        poses = tmp_path / "poses.txt"
        poses.write_text("".join(POSE.format(x) + "\n" for x in X))
        read = Table(poses, ["x"], times=tmp_path / "log.txt").read()
    else:
        read = Table(tmp_path / "log.txt", **options).read()
    np.testing.assert_allclose(read.times, times, rtol=0, atol=5e-7)
    np.testing.assert_array_equal(read.values[:, 0], X)


@pytest.mark.parametrize(
    ("text", "options", "match"),
    [
        ("1 2 3\n2 3 4\n", {}, "has 3 columns without names: .*pass columns= with 3 names, the time's included"),
        ("1 2 3\n2 3 4\n", {"columns": ["t", "x"]}, r"with 3 names, the time's included; got \['t', 'x'\]"),
        ('{"t": 1, "x": 2}\n', {}, "is JSON or XML, no table: write a line of numbers a reading"),
        ("clock,x\n1,2\n", {}, "pass time= for the column of times"),
        ("time x\n1,0 2\n2,0 3\n", {}, r"'time' is '1,0', which is no finite number"),
        ("time,pose\n1,(1,2)\n", {}, "3 cells for 2 columns; .* which separates them by commas"),
        (POSE.format(1) + "\n", {}, r"lacks the columns \['time'\].*or times= where it has none"),
        ("time,x\n1,2\n", {"times": [1.0, 2.0]}, "times has 2 times, but .* has 1 rows"),
        ("time,x\n1,2\n", {"topic": "/odom"}, "is no ROS bag, and has no topic '/odom'"),
    ],
)
def test_forms_that_are_not(tmp_path, text, options, match):
    (tmp_path / "log.txt").write_text(text)
    with pytest.raises(ValueError, match=match):
        Table(tmp_path / "log.txt", **options).read()


def test_a_name_that_comes_twice_is_numbered(tmp_path):
    (tmp_path / "log.csv").write_text("time,x,x\n0,1,2\n1,3,4\n")
    read = Table(tmp_path / "log.csv").read()
    assert read.columns == ("x", "x.1")
    np.testing.assert_array_equal(read.values, [[1, 2], [3, 4]])


def test_an_offset_moves_all_times(tmp_path):
    (tmp_path / "log.csv").write_text("time,came,x\n100,300,1\n200,400,2\n")
    read = Table(tmp_path / "log.csv", unit="ms", arrived="came", offset=-0.1).read()
    np.testing.assert_allclose(read.times, [0.0, 0.1], atol=1e-12)
    np.testing.assert_allclose(read.arrived, [0.2, 0.3], atol=1e-12)
    with pytest.raises(ValueError, match="offset must be finite"):
        Table("log.csv", offset=np.nan)


def write_bag(path, version):
    """Three messages of an odometry and one of another topic, by rosbags itself."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    make = types.types
    stamp, header = make["builtin_interfaces/msg/Time"], make["std_msgs/msg/Header"]
    vector = make["geometry_msgs/msg/Vector3"]
    plugin = {} if version == 1 else {"version": 9, "storage_plugin": getattr(StoragePlugin, version)}
    with (Writer1 if version == 1 else Writer2)(path, **plugin) as writer:
        name = "geometry_msgs/msg/Vector3Stamped"
        options = {"typestore": types}
        odom, other = (writer.add_connection(topic, name, **options) for topic in ("/speed", "/other"))
        serialize = types.serialize_ros1 if version == 1 else types.serialize_cdr
        for number, x in enumerate(X):
            first = {"seq": 0} if version == 1 else {}
            head = header(**first, stamp=stamp(sec=1395837505, nanosec=250_000_000 * (number + 1)), frame_id="base")
            message = make[name](header=head, vector=vector(x=x, y=0.0, z=0.0))
            writer.write(odom, int(1e9) * (number + 7), serialize(message, name))
        writer.write(other, int(9e9), serialize(message, name))


@pytest.mark.parametrize("version", [1, "SQLITE3", "MCAP"])
def test_bags(tmp_path, version):
    pytest.importorskip("rosbags")
    path = tmp_path / ("run.bag" if version == 1 else "run")
    write_bag(path, version)
    read = Table(path, topic="/speed").read()
    np.testing.assert_allclose(read.times, S, rtol=0, atol=5e-7)
    assert read.columns == ("vector.x", "vector.y", "vector.z")
    np.testing.assert_array_equal(read.values[:, 0], X)
    late = Table(path, ["vector.x", "recorded"], topic="/speed", time="time").read()
    np.testing.assert_array_equal(late.values[:, 1], [7, 8, 9])
    with pytest.raises(ValueError, match=r"has the topics \['/other', '/speed'\]; pass topic="):
        Table(path).read()
    (tmp_path / "cut.mcap").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"cut.mcap is no complete bag"):
        Table(tmp_path / "cut.mcap").read()
