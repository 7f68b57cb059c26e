"""One's own recordings: tables, videos, images."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
from tensordict import TensorDict

from benchmarks.reliability.case import Case, apart, workshop
from benchmarks.reliability.damage import BYTES, copied, finite, gone, leaves, same, same_but, written
from tests.data.recordings.own_files import SIZE, write_csv, write_images, write_video
from torch_denkf.data import Images, Recording, RecordingReplay, Table, Video, recording_from_rows, write_trajectory

ROWS = 12
NAN, INF = float("nan"), float("inf")
Change = Callable[[Path], Any]


@cache
def sound() -> Path:
    """A table as CSV and as Parquet, a video, and a folder of images."""
    root = workshop() / "own"
    root.mkdir()
    apart(lambda: _write(root))  # OpenCV's threads are not to be forked
    return root


def _write(root: Path) -> None:
    time = np.arange(ROWS) / 10
    columns = {"time": time, "x": np.sin(time), "y": np.cos(time)}
    write_csv(root / "table.csv", **columns)
    parquet.write_table(pa.table(columns), root / "table.parquet")
    write_csv(root / "stamps.csv", time=time)
    write_video(root / "run.mkv", ROWS)
    write_images(root / "images", [f"{k / 10:.1f}.png" for k in range(ROWS)])


def read(root: Path, *, camera: str = "", table: str = "table.csv", replay: Any = None, **options: Any) -> TensorDict:
    """All rows, as a user reads them."""
    streams: dict[str, Any] = {"state": Table(root / table, **options)}
    if camera == "video":
        streams["camera"] = Video(root / "run.mkv", times=root / "stamps.csv")
    elif camera:
        streams["camera"] = Images(root / "images")
    settings = {"size": SIZE, "cache": None, "split": "all", "progress": False, **(replay or {})}
    return RecordingReplay(Recording(**streams), **settings)[:]


@cache
def reference(camera: str = "") -> TensorDict:
    """The rows without damage."""
    return read(sound(), camera=camera)


def _act(change: Change, folder: Path, **options: Any) -> TensorDict:
    root = copied(sound(), folder)
    change(root)
    return read(root, **options)


def _equal(camera: str, result: TensorDict) -> bool:
    return same(result, reference(camera))


def _table(change: Callable[[list[str]], list[str]]) -> Change:
    def act(root: Path) -> None:
        lines = (root / "table.csv").read_text().splitlines()
        (root / "table.csv").write_text("\n".join(change(lines)) + "\n")

    return act


def _cell(row: int, column: int, value: str) -> Change:
    def change(lines: list[str]) -> list[str]:
        words = lines[row].split(",")
        words[column] = value
        return [*lines[:row], ",".join(words), *lines[row + 1 :]]

    return _table(change)


def _tables() -> Iterator[Case]:
    for file in ("table.csv", "table.parquet"):
        for what, change in BYTES.items():
            act = partial(_act, lambda root, file=file, change=change: written(root / file, change), table=file)
            yield Case(
                "recordings",
                f"{file} {what}",
                (file,),
                act,
                partial(_equal, "") if file == "table.parquet" or what == "cut by a byte" else None,
            )
        yield Case(
            "recordings",
            f"{file} taken away",
            (file,),
            partial(_act, lambda root, file=file: gone(root / file), table=file),
        )
        yield Case(
            "recordings",
            f"{file} a folder",
            (file,),
            partial(_act, lambda root, file=file: (gone(root / file), (root / file).mkdir()), table=file),
        )
        link = lambda root, file=file: (gone(root / file), (root / file).symlink_to("/dev/zero"))  # noqa: E731
        yield Case("recordings", f"{file} a link to a device", (file,), partial(_act, link, table=file))
    values = {
        "nan": "nan",
        "inf": "inf",
        "a word": "far",
        "empty": "",
        "a comma for a point": '"1,5"',
        "hexadecimal": "0x1f",
        "1e400": "1e400",
        "NULL": "NULL",
        "two points": "1.2.3",
    }
    for row in (1, 5, ROWS):
        for column, name in enumerate(("time", "x", "y")):
            for what, value in values.items():
                yield Case(
                    "recordings",
                    f"{name} in row {row}: {what}",
                    ("table.csv",),
                    partial(_act, _cell(row, column, value)),
                )
    times = {"back": "0.05", "the same": "0.3", "an hour on": "3600.4", "1e300": "1e300", "negative": "-3"}
    for what, value in times.items():
        right = _with_gap if what == "an hour on" else None
        yield Case("recordings", f"time goes on by: {what}", ("table.csv",), partial(_act, _cell(5, 0, value)), right)
    lines: dict[str, Callable[[list[str]], list[str]]] = {
        "no header": lambda lines: lines[1:],
        "only a header": lambda lines: lines[:1],
        "one row": lambda lines: lines[:2],
        "a column less in a row": lambda lines: [*lines[:5], lines[5].rsplit(",", 1)[0], *lines[6:]],
        "a column more in a row": lambda lines: [*lines[:5], lines[5] + ",1", *lines[6:]],
        "two columns of a name": lambda lines: ["time,x,x", *lines[1:]],
        "an empty name": lambda lines: ["time,,y", *lines[1:]],
        "semicolons": lambda lines: [line.replace(",", ";") for line in lines],
        "no time": lambda lines: ["t,x,y", *lines[1:]],
        "an open quote": lambda lines: [*lines[:5], '"' + lines[5], *lines[6:]],
        "a line of a megabyte": lambda lines: [*lines[:5], "9" * (1 << 20), *lines[6:]],
        "sorted backwards": lambda lines: [lines[0], *lines[:0:-1]],
    }
    for what, edit in lines.items():
        right = partial(_equal, "") if what == "an empty name" else None  # a column is a column
        yield Case("recordings", f"table.csv {what}", ("table.csv", "table"), partial(_act, _table(edit)), right)
    empty = _table(lambda lines: [*lines[:5], "", *lines[5:]])
    yield Case("recordings", "table.csv an empty line", ("table.csv",), partial(_act, empty), partial(_equal, ""))


def _with_gap(result: TensorDict) -> bool:
    """An hour's gap in a table is one: readings are as they stand there."""
    return finite(result)


def _pictures() -> Iterator[Case]:
    for what, change in BYTES.items():
        if "flipped" not in what:  # a video has no checksum
            act = partial(_act, lambda root, change=change: written(root / "run.mkv", change), camera="video")
            yield Case("recordings", f"video {what}", ("run.mkv", "stamps.csv"), act, partial(_shown, "video"))
        act = partial(_act, lambda root, change=change: written(root / "stamps.csv", change), camera="video")
        yield Case(
            "recordings",
            f"video's stamps {what}",
            ("stamps.csv",),
            act,
            partial(_equal, "video") if what == "cut by a byte" else None,
        )
        act = partial(_act, lambda root, change=change: written(root / "images/0.5.png", change), camera="images")
        yield Case("recordings", f"image {what}", ("0.5.png",), act, partial(_shown, "images"))
    images = lambda root: root / "images"  # noqa: E731
    changes: dict[str, tuple[Change, bool]] = {
        "no images": (lambda root: [gone(file) for file in images(root).iterdir()], False),
        "no folder": (lambda root: gone(images(root)), False),
        "a name that is no time": (lambda root: (images(root) / "0.5.png").rename(images(root) / "half.png"), False),
        "a name that is nan": (lambda root: (images(root) / "0.5.png").rename(images(root) / "nan.png"), False),
        "a name that is inf": (lambda root: (images(root) / "0.5.png").rename(images(root) / "inf.png"), False),
        "a time twice": (
            lambda root: (images(root) / "0.50.png").write_bytes((images(root) / "0.5.png").read_bytes()),
            False,
        ),
        "a folder as an image": (
            lambda root: (gone(images(root) / "0.5.png"), (images(root) / "0.5.png").mkdir()),
            True,
        ),
        "a link to nowhere": (
            lambda root: (gone(images(root) / "0.5.png"), (images(root) / "0.5.png").symlink_to("nowhere")),
            True,
        ),
        "a link to a device": (
            lambda root: (gone(images(root) / "0.5.png"), (images(root) / "0.5.png").symlink_to("/dev/zero")),
            True,
        ),
    }
    for what, (change, may_go_on) in changes.items():
        words = ("images", "0.5.png", "half.png", "nan.png", "inf.png", "0.50.png")
        yield Case(
            "recordings",
            f"images: {what}",
            words,
            partial(_act, change, camera="images"),
            partial(_shown, "images") if may_go_on else None,
        )
    yield Case(
        "recordings",
        "video taken away",
        ("run.mkv",),
        partial(_act, lambda root: gone(root / "run.mkv"), camera="video"),
    )
    yield Case(
        "recordings",
        "video a link to a device",
        ("run.mkv", "/dev/zero"),
        partial(
            _act, lambda root: (gone(root / "run.mkv"), (root / "run.mkv").symlink_to("/dev/zero")), camera="video"
        ),
    )


def _shown(camera: str, result: TensorDict) -> bool:
    """Right where each row that counts as seen shows its own picture, and all numbers are as without damage."""
    expected = reference(camera)
    if _equal(camera, result):
        return True
    found, places = leaves(result), result["time"].squeeze(-1)
    rows = [int((expected["time"].squeeze(-1) - time).abs().argmin()) for time in places]
    seen = found["observed"].squeeze(-1)
    equal = all(
        bool((value == leaves(expected)[key][rows]).all())
        for key, value in found.items()
        if key in ("state", "state_observed")
    )
    pictures = bool((found["pixels"][seen] == expected["pixels"][rows][seen]).all()) and not bool(
        found["pixels"][~seen].any()
    )
    return finite(result) and equal and pictures and len(result) >= ROWS - 2


ARGUMENTS: dict[str, dict[str, Any]] = {
    "columns": {"unknown": ["z"], "text": "x", "none": [], "a number": 3},
    "time": {"unknown": "stamp", "a number": 3},
    "unit": {"unknown": "h", "a number": 3},
    "sample": {"unknown": "first", "a number": 3},
    "tolerance": {"zero": 0.0, "negative": -1.0, "nan": NAN, "text": "x"},
}
REPLAY: dict[str, dict[str, Any]] = {
    "clock": {"zero": 0.0, "negative": -1.0, "nan": NAN, "inf": INF, "unknown": "sun", "1e12": 1e12},
    "size": {"zero": (0, 4), "negative": (-4, 4), "one number": (4,), "text": "ab", "fractions": (1.5, 2.5)},
    "test_share": {"beyond one": 1.5, "negative": -0.1, "nan": NAN, "text": "x"},
    "batch_size": {"negative": -4, "a fraction": 2.5, "text": "x"},
    "slice_len": {"zero": 0, "negative": -1, "text": "x"},
}


def _arguments() -> Iterator[Case]:
    for name, values in ARGUMENTS.items():
        for what, value in values.items():
            yield Case(
                "recordings",
                f"Table({name}: {what})",
                (name, "table.csv"),
                partial(_act, lambda root: None, **{name: value}),
            )
    for name, values in REPLAY.items():
        for what, value in values.items():
            also = ("rows", "slices") if name in ("clock", "slice_len") else ()
            yield Case(
                "recordings",
                f"RecordingReplay({name}: {what})",
                (name, *also),
                partial(_act, lambda root: None, replay={name: value}),
            )
    for name, values in {
        "start": {"nan": NAN, "inf": INF, "text": "x"},
        "rate": {"zero": 0.0, "negative": -1.0, "nan": NAN, "text": "x"},
    }.items():
        for what, value in values.items():
            yield Case(
                "recordings",
                f"Images({name}: {what})",
                (name,),
                lambda folder, name=name, value=value: Images(sound() / "images", **{name: value}),
            )
    makes: dict[str, tuple[tuple[str, ...], Callable[[], Any]]] = {
        "no streams": (("streams",), lambda: Recording()),
        "a stream of text": (("state",), lambda: Recording(state="table.csv")),
        "two cameras": (("camera",), lambda: Recording(a=Images("a", rate=1.0), b=Images("b", rate=1.0))),
        "a name that is taken": (("reward",), lambda: Recording(reward=Table("table.csv"))),
        "a name that is no text": (("name",), lambda: Recording(name=3, state=Table("table.csv"))),
        "no recordings": (("recordings",), lambda: RecordingReplay([])),
        "recordings of text": (("Recording",), lambda: RecordingReplay(["table.csv"])),
    }
    for what, (words, make) in makes.items():
        yield Case("recordings", what, words, lambda folder, make=make: make())
    yield from _rows()
    yield from _trajectories()


def _rows() -> Iterator[Case]:
    """Rows that are in memory."""

    def rows(change: Callable[[TensorDict], Any]) -> TensorDict:
        import torch

        state = torch.rand(12, 2, generator=torch.Generator().manual_seed(0))
        made = TensorDict({"observation": {"image": torch.zeros(12, 3, 8, 8, dtype=torch.uint8), "state": state}}, [12])
        made["episode"] = torch.arange(3).repeat_interleave(4)
        change(made)
        return made

    def made(change: Callable[[TensorDict], Any], fps: Any, folder: Path) -> Any:
        from torch_denkf.data import LeRobotReplay

        return LeRobotReplay(recording_from_rows(rows(change), fps=fps), split="all")[:]

    def row_masked(result: TensorDict) -> bool:
        """Right where the damaged row counts neither as seen nor in a loss, and all others are as without damage."""
        masks = ("observed", "state_observed", ("collector", "mask"))
        expected = made(lambda rows: None, 10.0, Path())
        return all(not bool(result[mask][1].any()) for mask in masks) and same_but(result, expected, [1], ["observed"])

    for what, fps in {"zero": 0.0, "negative": -1.0, "nan": NAN, "inf": INF, "text": "fast"}.items():
        yield Case("recordings", f"recording_from_rows(fps: {what})", ("fps",), partial(made, lambda rows: None, fps))
    changes: dict[str, tuple[str, Callable[[TensorDict], Any]]] = {
        "no state": ("state", lambda rows: rows["observation"].pop("state")),
        "no image": ("image", lambda rows: rows["observation"].pop("image")),
        "no episode": ("episode", lambda rows: rows.pop("episode")),
        "nan in the state": ("state", lambda rows: rows["observation", "state"].view(-1)[3:4].fill_(NAN)),
        "images of two dimensions": (
            "image",
            lambda rows: rows.set(("observation", "image"), rows["observation", "image"][:, 0, 0]),
        ),
        "images of five channels": (
            "image",
            lambda rows: rows.set(
                ("observation", "image"), rows["observation", "image"][:, :1].expand(12, 5, 8, 8).clone()
            ),
        ),
        "episodes as floats with nan": ("episode", lambda rows: rows.set("episode", rows["episode"] * NAN)),
        "an episode in two parts": ("episode", lambda rows: rows["episode"][-2:].fill_(0)),
    }
    for what, (word, change) in changes.items():
        right = row_masked if what == "nan in the state" else None
        yield Case("recordings", f"recording_from_rows: {what}", (word,), partial(made, change, 10.0), right)


def _trajectories() -> Iterator[Case]:
    """Paths that are written for other programs."""
    import torch

    path = torch.zeros(5, 3)
    wrong: dict[str, tuple[str, dict[str, Any]]] = {
        "nan": ("trajectory", {"trajectory": torch.full((5, 3), NAN)}),
        "two columns": ("trajectory", {"trajectory": path[:, :2]}),
        "a vector": ("trajectory", {"trajectory": path[:, 0]}),
        "text": ("trajectory", {"trajectory": "path"}),
        "another layout": ("layout", {"layout": "csv"}),
        "tum without times": ("times", {"layout": "tum"}),
        "too few times": ("times", {"layout": "tum", "times": torch.zeros(3)}),
        "times that are nan": ("times", {"layout": "tum", "times": torch.full((5,), NAN)}),
        "times backwards": ("times", {"layout": "tum", "times": torch.arange(5.0).flip(0)}),
    }
    for what, (word, given) in wrong.items():
        act = lambda folder, given=given: write_trajectory(folder / "path.txt", **{"trajectory": path, **given})  # noqa: E731
        yield Case("recordings", f"write_trajectory: {what}", (word,), act)


def cases() -> Iterator[Case]:
    """All damaged recordings."""
    sound()  # here, not in each case's process
    yield from _tables()
    yield from _pictures()
    yield from _arguments()
