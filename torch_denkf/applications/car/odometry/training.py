"""Trains a car filter: the sensor, then the filter on readings of other drives, then both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf._checks import check_count, check_number
from torch_denkf.applications.car.odometry.batches import PairSampler, ReadingSampler
from torch_denkf.applications.car.odometry.filter import VELOCITIES, CarFilter, CarSettings
from torch_denkf.applications.car.odometry.roles import drives_by_role, recorded_drives, rendered_drives
from torch_denkf.applications.car.odometry.scores import (
    EndToEndLoss,
    SensorLoss,
    belief_error,
    belief_loss,
    calibrate,
    gain_of,
    sensor_error,
)
from torch_denkf.applications.car.odometry.streams import Drive, read_spans
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.deployment.progress import progress_bar
from torch_denkf.pretrained.folders import save_pretrained
from torch_denkf.training import FilterTrainer, Stage

__all__ = ["Updates", "train_car_filter"]


@dataclass(frozen=True)
class Updates:
    """Number of updates of each training stage.

    Attributes:
        sensor: updates of the sensor alone.
        filter: updates of the filter on the sensor's readings.
        end_to_end: updates of both together.
        length: steps of the windows that the filter is trained on.
    """

    sensor: int = 3000
    filter: int = 300
    end_to_end: int = 40
    length: int = 24

    def __post_init__(self):
        for name, least in (("sensor", 1), ("filter", 1), ("end_to_end", 1), ("length", 2)):
            check_count(f"{name} of Updates", getattr(self, name), least=least)


def train_car_filter(
    out: str | Path,
    *,
    root: str | Path | None = None,
    drives: Sequence[str] | None = None,
    leave_out: Sequence[str] = (),
    rendered: int = 0,
    frames: int = 160,
    size: tuple[int, int] = (100, 300),
    height: float = KITTI_HEIGHT,
    updates: Updates | None = None,
    seed: int = 0,
    device: str = "cpu",
    processes: int | None = 1,
    command: str = "",
    progress: bool = True,
) -> CarFilter:
    """Trains a car filter on recorded drives, rendered ones, or both.

    The filter must learn the sensor's errors on unseen drives, so that sensor and filter are trained on different
    drives, and validated on others (:func:`torch_denkf.applications.car.odometry.roles.assign_roles`). The stages:

    1. the sensor alone, by the CRPS of its samples against the true velocities;
    2. the filter on the frozen sensor's readings, by the CRPS of its belief. Some frames are dropped, and windows begin
       at a wrong velocity, as otherwise the filter would learn to ignore its sensor;
    3. both end to end, except for the noise model, which has learned the sensor's errors on unseen drives;
    4. the inflation, by the CRPS of the velocities times the path error on the validation drives.

    A repeated call resumes an interrupted training, also after a kill, and gives the same weights.

    Args:
        out: folder; gets the filter (see :func:`torch_denkf.pretrained.save_pretrained`), checkpoints and logs below
            ``training``, rendered drives below ``rendered``, and optical flow of all drives below ``cache``.
        root: folder of recorded drives in KITTI's layout, with ``sequences`` and ``poses``.
        drives: names of the drives below ``root``; all by default.
        leave_out: names of drives below ``root`` that must not be used.
        rendered: number of drives to render.
        frames: frames of a rendered drive.
        size: (H, W) of the scaled images.
        height: height of the recorded drives' camera over the road, in m.
        updates: length of the stages.
        seed: seed of all random numbers, and of the rendered drives.
        device: device of the networks.
        processes: number of rendering processes; ``None`` stands for one per core.
        command: command line, for the record.
        progress: whether to show progress bars, or without a terminal a line every ten seconds.

    Returns:
        The trained filter, on the CPU.

    Raises:
        FileNotFoundError: if there are no drives below ``root``.
        ValueError: if there are too few drives, names of drives without a root, drives of different frame times,
            windows longer than the drives, or a training with other settings in ``out``.

    Example:
        >>> import tempfile
        >>> few = Updates(sensor=1, filter=1, end_to_end=1, length=2)
        >>> options = {"rendered": 3, "frames": 4, "size": (25, 75), "progress": False}
        >>> train_car_filter(tempfile.mkdtemp(), updates=few, **options).settings.dt
        0.103
    """
    check_number("height", height, above=0, cure="It is that of the recording camera over the road, in m")
    check_count("seed", seed, least=0)
    named = {name: list(given) for name, given in (("drives", drives), ("leave_out", leave_out)) if given}
    if root is None and named:
        raise ValueError(f"{named} name recorded drives, but there is no folder of them; pass root (--root), too")
    out, updates, longest = Path(out).expanduser(), updates or Updates(), CarSettings.longest
    common: dict[str, Any] = {"size": (int(size[0]), int(size[1])), "cache": out / "cache", "two_view": True}
    recorded = recorded_drives(root, drives, leave_out, height=height, **common) if root is not None else []
    options: dict[str, Any] = {"frames": frames, "seed": seed, "processes": processes, "progress": progress}
    roles = drives_by_role(recorded, rendered_drives(out / "rendered", rendered, **options, **common))
    alone = [each for drive in roles["sensor"] for each in (*drive.disturbed(), *drive.longer(longest))]
    others = [part for role in ("filter", "validation") for drive in roles[role] for part in drive.disturbed()]
    data = _read([*alone, *(each for part in others for each in part.spans(longest))], progress)

    torch.manual_seed(seed)
    car = CarFilter(_settings(alone, data))
    trainer = {"seed": seed, "device": device, "save_every": 100, "progress": progress}
    pairs = PairSampler(alone, [data[drive] for drive in alone], longest)
    _train_sensor(car, pairs, _groups(roles["validation"], data, longest), updates, out / "training/sensor", trainer)
    gain, value = _train_filter(car, pairs, roles, data, updates, out / "training/filter", trainer, progress)
    car = car.cpu()
    validation = _groups(roles["validation"], data, longest)
    car.inflation = calibrate(car, [read_spans(car.sensor, group, longest) for group in validation])
    record = {
        "command": command,
        "seed": seed,
        "updates": asdict(updates),
        "roles": {role: [f"{drive.root.name}/{drive.name}" for drive in parts] for role, parts in roles.items()},
        "validation_crps": value,
        "sensor_gain_error": gain,
    }
    save_pretrained(car, out, training=record)
    return car.eval()


# ---------------------------------------------------------------------------------------------------------- the drives


def _read(drives: Sequence[Drive], progress: bool) -> dict[Drive, TensorDict]:
    """Returns flow, road correlation and ground truth of each drive; takes 10 to 30 ms per frame without a cache."""
    data = {}
    with progress_bar("optical flow", len(drives), unit=" drives", shown=progress) as bar:
        for drive in drives:
            data[drive] = drive.read()
            bar.update()
    dt = torch.stack([each["dt"][0, 0] for each in data.values()])
    if (dt / dt[0] - 1).abs().max() > 0.01:
        raise ValueError(f"the drives have frame times of {dt.unique().tolist()} s; a filter needs the same in all")
    return data


def _groups(drives: Sequence[Drive], data: dict[Drive, TensorDict], longest: int) -> list[list[TensorDict]]:
    """Returns each drive under each condition, as a list of its spans."""
    return [[data[each] for each in part.spans(longest)] for drive in drives for part in drive.disturbed()]


def _settings(drives: Sequence[Drive], data: dict[Drive, TensorDict]) -> CarSettings:
    """Returns settings with statistics of the sensor's drives and their mirror images: turn rates have mean zero."""
    clean = [data[drive] for drive in drives if drive.condition == "clean" and drive.steps == 1]
    v, theta_dot = torch.cat([each["state"][:, VELOCITIES] for each in clean]).unbind(-1)
    focal = max(float(each["calibration"][0, 0]) for each in clean)
    return CarSettings(
        dt=round(float(clean[0]["dt"][0, 0]), 6),
        velocity_mean=(float(v.mean()), 0.0),
        velocity_std=(float(v.std()), float(theta_dot.square().mean().sqrt())),
        two_view=drives[0].two_view,
        size=drives[0].size,
        focal=focal,
    )


# ---------------------------------------------------------------------------------------------------------- the stages


def _train_sensor(
    car: CarFilter,
    pairs: PairSampler,
    validation: Sequence[Sequence[TensorDict]],
    updates: Updates,
    out: Path,
    trainer: dict[str, Any],
) -> None:
    unit, longest = car.settings.unit, car.settings.longest
    neighbours = [group[0] for group in validation]
    stage = Stage(
        "sensor",
        SensorLoss(car.sensor, unit),
        lambda generator, _: pairs.frames(generator),
        updates.sensor,
        lr=2e-3,
        weight_decay=0.02,
        validate=lambda: sensor_error(car.sensor, neighbours, unit, longest),
    )
    model = nn.ModuleDict({"sensor": car.sensor})
    FilterTrainer(model, [stage], out=out, validate_every=max(updates.sensor // 4, 1), **trainer).fit()


def _train_filter(
    car: CarFilter,
    pairs: PairSampler,
    roles: dict[str, list[Drive]],
    data: dict[Drive, TensorDict],
    updates: Updates,
    out: Path,
    trainer: dict[str, Any],
    progress: bool,
) -> tuple[float, float]:
    """Trains the filter on readings, then end to end; returns the sensor's gain error and the last validation."""
    settings, longest = car.settings, car.settings.longest
    unit, start_std = settings.unit, settings.start_std
    groups, parts = _groups(roles["filter"], data, longest), [p for d in roles["filter"] for p in d.disturbed()]
    held_out = _groups(roles["validation"], data, longest)
    with progress_bar("the sensor reads", 2 * len(groups) + len(held_out), unit=" drives", shown=progress) as bar:

        def read(group, mirrored=False):
            bar.update()
            return read_spans(car.sensor, group, longest, mirrored=mirrored)

        readings = [read(group, mirrored) for group in groups for mirrored in (False, True)]
        checked = [read(group) for group in held_out]
    clean = [number for number, part in enumerate(parts) if part.condition == "clean"]
    gain_error = float(torch.stack([gain_of(readings[2 * number]) for number in clean]).square().mean().sqrt())
    weights = [part.weight for part in parts for _ in range(2)]
    windows = ReadingSampler(readings, weights, updates.length, gain_error)
    third = max(updates.end_to_end // 3, 1)
    stages = [
        Stage(
            "filter",
            belief_loss(car.without_sensor(), unit),
            lambda generator, _: windows.windows(generator, start_std),
            updates.filter,
            lr=5e-3,
            validate=lambda: belief_error(car, checked),
        ),
        Stage(
            "end_to_end",
            EndToEndLoss(belief_loss(car, unit), SensorLoss(car.sensor, unit)),
            lambda generator, length: pairs.windows(generator, length, start_std),
            updates.end_to_end,
            # The noise model is frozen: on the sensor's training drives it would unlearn the errors on unseen drives.
            parameters=[p for name, p in car.named_parameters() if not name.startswith("module.noise.")],
            lr=1e-4,
            lengths={start: min(steps, updates.length) for start, steps in ((0, 4), (third, 8), (2 * third, 16))},
            validate=lambda: belief_error(car, [read_spans(car.sensor, group, longest) for group in held_out]),
        ),
    ]
    every = max(updates.filter // 3, 1)
    results = FilterTrainer(car, stages, out=out, validate_every=every, **trainer).fit()
    return gain_error, results["end_to_end"]["value"]
