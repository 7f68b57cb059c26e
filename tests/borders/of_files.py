"""Arguments of what reads and writes files: drives, recordings, demos, corners, trainings, filters, packages."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.borders import models, recorded
from benchmarks.reliability.damage import INF, NAN
from benchmarks.reliability.target import Subject, Target, targets_of
from tests.borders.around_filters import STRETCHES
from tests.filters.factories import linear_kalman
from tests.training.problem import make_trainer
from torch_denkf.applications.car import KITTIOdometryExperienceReplay, KITTIReplayEnv, OpticalFlow, track, with_motion
from torch_denkf.applications.car.corners.camera import StereoCamera
from torch_denkf.applications.car.corners.motion import CornerNoise, corner_motion
from torch_denkf.applications.car.kitti.drive import list_kitti_drives
from torch_denkf.applications.car.kitti.gaps import bridge_gaps
from torch_denkf.applications.car.kitti.trajectories import write_trajectory
from torch_denkf.applications.car.odometry.filter import car_filter
from torch_denkf.applications.car.odometry.training import Updates
from torch_denkf.applications.car.vision.camera import CanonicalCamera
from torch_denkf.applications.reacher import reacher
from torch_denkf.applications.ur5.envs.collect import collect_ur5_demos
from torch_denkf.data import Images, Recording, RecordingReplay, Table
from torch_denkf.deployment import export_step
from torch_denkf.functional import sigma_points
from torch_denkf.functional.unscented import unscented_moments, unscented_weights
from torch_denkf.pretrained import from_pretrained, save_pretrained
from torch_denkf.training import FilterTrainer, Stage

DRIVE, SIZE = recorded.DRIVE, d.SIZE | d.of((1.5, 2.5))


def _drive() -> TensorDict:
    return recorded.KITTI.reference().clone()


# ------------------------------------------------------------------------------------------------------------ drives


def _replayed(**given: Any) -> Any:
    data = KITTIOdometryExperienceReplay(recorded.drives(), **{"size": recorded.SIZE, "cache": None, **given})
    return data.sample() if {"batch_size", "num_slices", "slice_len"} & set(given) else data[:]


def _drives() -> Iterator[Subject]:
    outside = ("../../../etc", "/etc")
    one = {
        "size": SIZE | d.of(10),
        "camera": d.of("image_9", 2, *outside),
        "drive": d.of("nope", -1, 0.5, "", *outside),
        "colour": d.of("yes", 3),
    }
    share = d.SHARE.but("inf")
    many = {
        "drives": d.of([], [DRIVE, DRIVE], ["nope"], ["../../etc"]),
        "test_share": share,
        "validation_share": share.but("beyond one") | {"one": 1.0},
        "split": d.CHOICE.but("empty"),
        **dict.fromkeys(("batch_size", "num_slices"), d.COUNT),
        "slice_len": d.COUNT.without("fraction") | {"beyond the drive": 1000},
        "cameras": d.of("third", ["image_7"], []),
        "flow": d.Wrong({"text": "yes", "no flow": lambda drive: drive}),
        "slice_length": d.of(4),
    }
    also = {
        "drive": ("sequence", "sequences", "poses", "/etc"),
        "camera": ("image_9",),
        "cameras": ("camera", "image_7"),
        "drives": ("sequences",),
        "slice_len": ("slices",),
    }
    moved = lambda **given: with_motion(_drive(), cache=None, **given)  # noqa: E731
    yield recorded.KITTI.arguments("read_kitti_drive", wrong=one, also=also)
    yield Subject(_replayed, wrong=many, also=also, name="KITTIOdometryExperienceReplay")
    yield Subject(moved, wrong={"height": d.POSITIVE.but("inf")}, name="with_motion")
    yield Subject(list_kitti_drives, wrong={"root": d.of(".")}, also={"root": ("sequences",)})


# --------------------------------------------------------------------------------------------------------------- car

CALIBRATION = d.of((1.0, 1.0, 1.0), (0.0, 40.0, 35.0, 11.0), (NAN, 40.0, 35.0, 11.0), (-4.0, 40.0, 35.0, 11.0), "ab")


def _tracked(**given: Any) -> Any:
    car = models.LOADERS["car-odometry"](models.FOLDERS["car-odometry"])
    frames = [np.full((24, 72, 3), 40 * k, np.uint8) for k in range(1, 5)]
    settings: dict[str, Any] = {"frames": frames, "calibration": (41.7, 41.7, 35.5, 11.5), "fps": 10.0, **given}
    if "times" in given:
        settings["fps"] = None
    return list(track(car, **settings))


def _no_moments(points: torch.Tensor) -> bool:
    """Checks what functions of tensors promise where an element of a batch has no result: that it alone is NaN.

    They look at no values, which under ``torch.compile`` and on a GPU would cost more than they do. Of sigma points
    without a covariance nothing finite may be left in their moments.
    """
    moments = unscented_moments(points, unscented_weights(2))
    sound = sigma_points(torch.zeros(2), torch.eye(2))
    return all(bool(value[1].isnan().all()) for value in moments) and torch.equal(points[0], sound)


def _car() -> Iterator[Subject]:
    eye, frame = torch.eye(2), np.zeros((24, 72, 3), np.uint8)
    frames = {
        "none": [],
        "one": [frame],
        "another size": [frame, frame[:10], frame],
        "floats": [frame / 255.0] * 3,
        "five channels": [np.zeros((24, 72, 5), np.uint8)] * 3,
        "text": ["a", "b", "c"],
    }
    tracked = {
        "frames": d.Wrong(frames),
        "times": d.of([3.0, 2.0, 1.0, 0.0], [0.0] * 4, [0.0, NAN, 0.2, 0.3], [0.0, 0.1], ["a", "b", "c", "d"])
        | {"a gap of a day": [0.0, 0.1, 86400.0, 86400.1]},
        **dict.fromkeys(("fps", "height"), d.POSITIVE),
        "pitch": d.FINITE | {"a right angle": 1.57},
        "black_level": d.of(-1, 300, "x"),
        "calibration": CALIBRATION,
    }
    covariances = {
        "negative": torch.stack([eye, -eye]),
        "indefinite": torch.stack([eye, torch.tensor([[1.0, 2.0], [2.0, 1.0]])]),
        "nan": torch.stack([eye, torch.full((2, 2), NAN)]),
        "a row more": torch.eye(3, 2).expand(2, 3, 2),
    }
    points = {"cov": d.Wrong(covariances), "mean": None, "alpha": d.of(0.0, NAN), "kappa": d.of(-2.0, NAN)}
    updates = dict.fromkeys(("sensor", "filter", "end_to_end", "length"), d.COUNT)
    flow = lambda transform: transform(TensorDict({"pixels": torch.rand(6, 24, 72)}))  # noqa: E731
    camera = lambda: {"calibration": (40.0, 40.0, 35.0, 11.0)}  # noqa: E731
    batch = lambda: {"mean": torch.zeros(2, 2), "cov": eye.expand(2, 2, 2)}  # noqa: E731
    yield Subject(car_filter, wrong=models.CAR)
    yield Subject(_tracked, wrong=tracked, also={"frames": ("frame",), "times": ("time",)}, name="track")
    yield Subject(CanonicalCamera, lambda: {"focal": 40.0})
    yield Subject(OpticalFlow, camera, flow, {"calibration": CALIBRATION})
    yield Subject(Updates, wrong=updates, also=dict.fromkeys(updates, ("Updates",)))
    yield Subject(bridge_gaps, lambda: {"drive": _drive()})
    yield Subject(sigma_points, batch, wrong=points, right={"cov": _no_moments})
    roll = lambda env: env.rollout(3)  # noqa: E731
    yield Subject(KITTIReplayEnv, lambda: {"drive": _drive()}, roll, {**STRETCHES, "size": None})


# -------------------------------------------------------------------------------------------- recordings and corners


def _trajectory(**given: Any) -> Any:
    """Returns a path that is written for other programs."""
    layout = {"layout": "tum"} if "times" in given else {}
    return write_trajectory("path.txt", **{"trajectory": torch.zeros(5, 3), **layout, **given})


def _made(streams: Any) -> Any:
    return RecordingReplay(streams) if isinstance(streams, list) else Recording(**streams)


def _recordings() -> Iterator[Subject]:
    table = {
        "columns": d.of(["z"], "x", [], 3),
        "time": d.of("stamp", 3),
        "unit": d.of("h", 3),
        "sample": d.of("first", 3),
        "tolerance": d.POSITIVE.but("inf"),
    }
    replay = {
        "clock": d.of(0.0, -1.0, NAN, INF, "sun", 1e12),
        "size": SIZE,
        "test_share": d.SHARE.but("inf"),
        "batch_size": d.COUNT_OR_NONE,
        "slice_len": d.COUNT.but("fraction"),
    }
    path = {
        "trajectory": d.of(torch.full((5, 3), NAN), torch.zeros(5, 2), torch.zeros(5), "path"),
        "layout": d.of("csv"),
        "times": d.of(None, torch.zeros(3), torch.full((5,), NAN), torch.arange(5.0).flip(0)),
    }
    streams = {
        "none": {},
        "text": {"state": "table.csv"},
        "two cameras": {name: Images(name, rate=1.0) for name in "ab"},
        "a name that is taken": {"reward": Table("table.csv")},
        "a name that is no text": {"name": 3, "state": Table("table.csv")},
        "no recordings": [],
        "recordings of text": ["table.csv"],
    }
    words = {"streams": ("state", "camera", "reward", "name", "recordings", "Recording")}
    images = lambda **given: Images(recorded.own() / "images", **given)  # noqa: E731
    replayed = lambda **given: recorded.read_own(recorded.own(), replay=given)  # noqa: E731
    in_memory = lambda **given: recorded.rows_in_memory(**given)  # noqa: E731
    yield recorded.OWN.arguments("Table", wrong=table, also=dict.fromkeys(table, ("table.csv",)))
    slices = dict.fromkeys(("clock", "slice_len"), ("rows", "slices"))
    yield Subject(replayed, wrong=replay, also=slices, name="RecordingReplay")
    yield Subject(images, wrong={"start": d.FINITE, "rate": d.POSITIVE.but("inf")}, name="Images")
    yield Subject(in_memory, wrong={"fps": d.POSITIVE}, name="recording_from_rows")
    yield Subject(_trajectory, wrong=path, name="write_trajectory")
    yield Subject(_made, wrong={"streams": d.Wrong(streams)}, also=words, name="Recording")


def _lerobot() -> Iterator[Subject]:
    wrong = {
        "camera": d.of("bottom", 3, "../.."),
        "state_key": d.of("nothing", recorded.CAMERA, 3),
        "action_key": d.of("nothing", recorded.CAMERA),
        "size": SIZE,
    }
    yield recorded.V2.arguments("LeRobotReplay", wrong=wrong, also=dict.fromkeys(wrong, ("feature",)))


def _corners() -> Iterator[Subject]:
    corners = torch.rand(6, 3) + torch.tensor([600.0, 180.0, 20.0])
    sound = {"before": corners, "after": corners, "seen": torch.ones(6, dtype=torch.bool)}
    camera = {"focal": 700.0, "center": (600.0, 180.0), "baseline": 0.54}
    shapes = d.of(torch.ones(3), torch.ones(7, 3), torch.ones(6, 4))
    motion = {
        **dict.fromkeys(("before", "after"), shapes),
        "seen": d.of(torch.ones(6), torch.ones(3, dtype=torch.bool)),
        "start": d.of(torch.ones(2, 7), torch.eye(4)),
        "stereo_var": d.of(torch.tensor(1.0)),
        "steps": d.COUNT.but("zero"),
    }
    cameras = {
        **dict.fromkeys(("focal", "baseline"), d.POSITIVE),
        "center": d.vector(2).but("nan", "inf", "a matrix") | d.of((NAN, 1.0), (1.0, INF)),
        "radial": d.of((0.0, 0.0), (0.0, NAN, 0.0), "abc"),
        "disparity_offset": d.of((), (0.0,) * 8, (NAN,), "abc"),
    }
    noise = dict.fromkeys(CornerNoise.__dataclass_fields__, d.NOT_NEGATIVE)
    noise |= dict.fromkeys(("pixel", "disparity", "freedom"), d.POSITIVE)
    rows = {"rows": d.COUNT | {"more than there are": 99, "one": 1}}
    yield recorded.CORNERS.arguments("read_corner_drive", wrong=rows)
    yield Subject(lambda **given: StereoCamera(**{**camera, **given}), wrong=cameras, name="StereoCamera")
    yield Subject(lambda **given: CornerNoise(**given), wrong=noise, name="CornerNoise")
    moved = lambda **given: corner_motion(**{**sound, "camera": StereoCamera(**camera), **given})  # noqa: E731
    yield Subject(moved, wrong=motion, name="corner_motion")


# --------------------------------------------------------------------------------------------- what is made and saved


def _ur5() -> Iterator[Subject]:
    replay = {"size": SIZE | {"larger": (500, 500)}, "split": d.of("best"), "validation_share": d.of(1.0, -1.0)}
    collected = {
        "demos": d.COUNT,
        **dict.fromkeys(("processes", "max_steps"), d.COUNT.but("fraction")),
        **dict.fromkeys(("frames", "seed"), d.COUNT_OR_NONE),
        "size": d.SIZE,
        "domain": d.of("moon"),
        "tasks": d.of(["juggle"], [], ["pick", "pick"]),
        "noise": d.NOT_NEGATIVE,
    }
    one = {"demos": 1, "frames": None, "max_steps": 4}
    yield recorded.DEMOS.arguments("UR5ExperienceReplay", wrong=replay)
    collect = lambda **given: collect_ur5_demos("out", **{**one, **given})  # noqa: E731
    yield Subject(collect, wrong=collected, name="collect_ur5_demos")


def _trained(out: Any = "out", **settings: Any) -> Any:
    Path("file").touch()
    return make_trainer(Path(out), **{"updates": 1, "progress": False, **settings}).fit()


def _staged(**given: Any) -> Any:
    net = torch.nn.Linear(1, 1)

    def sample(generator: torch.Generator, length: int | None) -> TensorDict:
        return TensorDict({"x": torch.rand(8, 1, generator=generator)}, [8])

    loss = lambda batch: {"loss_fit": net(batch["x"]).square().mean()}  # noqa: E731
    stage = Stage(**{"name": "fit", "loss": loss, "sample": sample, "updates": 2, **given})
    return FilterTrainer(net, [stage], out=Path("out"), device="cpu", progress=False).fit()


def _training() -> Iterator[Subject]:
    settings = {
        **dict.fromkeys(("updates", "validate_every", "save_every", "log_every"), d.of("x", -3, 1.5, 0)),
        "max_skipped": d.of("x", -3),
        "seed": d.of("x", -3, 1.5),
        "keep": d.of("worst", 3),
        "monitor": d.of("beauty"),
        "loggers": d.of(("paper",)),
        "device": d.of("abacus", "cuda:77"),
        "out": d.of("file"),
    }
    stage = {
        "name": d.of("../x", "", 3),
        "lr": d.POSITIVE,
        "weight_decay": d.NOT_NEGATIVE.but("inf"),
        "schedule": d.of("weekly", 3),
        "clip": d.POSITIVE.but("inf"),
        "lengths": d.of({5: 4}, {0: -4}, "x"),
    }
    yield Subject(_trained, wrong=settings, also={"loggers": ("logger",), "out": ("file",)}, name="FilterTrainer")
    yield Subject(_staged, wrong=stage, also={"name": ("stage's name",)}, name="Stage")


def _saved(**given: Any) -> Any:
    given = {"builder": reacher, "settings": {}, **given}
    given = {name: value for name, value in given.items() if value is not None}
    return save_pretrained(torch.nn.Linear(2, 2), "folder", **given)


def _pretrained() -> Iterator[Subject]:
    objects = {"a": object()}
    saved = {"builder": d.of(None), "settings": d.of(objects, {"a": NAN}, "x"), "training": d.of(objects)}
    yield Subject(_saved, wrong=saved, name="save_pretrained")


def _exported(path: str = "step.pt2", **given: Any) -> Any:
    Path("file").touch()
    settings = {"filter": linear_kalman(), "example": TensorDict({"observation": torch.ones(2)}), **given}
    return export_step(**settings, path=Path.cwd() / path, compiled=False)


def _packages() -> Iterator[Subject]:
    wrong = {
        "path": d.of("step.zip", "file/step.pt2", "/dev/full/step.pt2"),
        "out_keys": d.of(["nothing"]),
        "example": d.Wrong({"without a reading": TensorDict({}), "nothing": None}),
        "filter": d.of(torch.nn.Linear(2, 2)),
    }
    words = {"path": ("pt2", "file", "/dev/full"), "out_keys": ("nothing", "write"), "example": ("observation",)}
    yield Subject(_exported, wrong=wrong, also=words, name="export_step")


def targets() -> Iterator[Target]:
    """Yields all arguments."""
    kinds = {
        **{"kitti": _drives, "car": _car, "recordings": _recordings, "lerobot": _lerobot, "corners": _corners},
        **{"ur5": _ur5, "training": _training, "pretrained": _pretrained, "packages": _packages},
    }
    for border, subjects in kinds.items():
        yield from targets_of(border, *subjects())
    names = d.of("walker", "../../etc", "/etc", "", "a\0b", 3)
    also = {"name_or_folder": ("config.json", "trained filter")}
    yield from targets_of("pretrained", Subject(from_pretrained, wrong={"name_or_folder": names}, also=also), said=True)
