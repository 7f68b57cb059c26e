"""Reads whole recordings by the package's trained sensors: KITTI's drives, and demonstrations of the UR5."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict

from torch_denkf.applications.car.kitti.drive import list_kitti_drives
from torch_denkf.applications.car.kitti.render import render_drives
from torch_denkf.applications.car.odometry.batches import mark_start
from torch_denkf.applications.car.odometry.filter import CarFilter, car_filter
from torch_denkf.applications.car.odometry.scores import first_state
from torch_denkf.applications.car.odometry.streams import Drive, all_frames, read_spans
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.filter import JOINTS, UR5TableFilter
from torch_denkf.applications.ur5.train import behind_sensor, read_demos, whole_demos
from torch_denkf.filters import Filter
from torch_denkf.pretrained import from_pretrained
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

Group = dict[str, TensorDict]  # batches of recordings of one length, [N, T], by their names joined with spaces


@dataclass(frozen=True)
class Task:
    """Recordings, and the filter for their sensor.

    Attributes:
        name: for files and tables.
        quantities: names of the scored quantities, with their units.
        dims: their dimensions of the state.
        members: sizes of the ensemble; the first is the size in training.
        draws: of the noise, for that size.
        model: returns the trained filter for a number of members.
        behind: returns the filter without its sensor.
        read: returns the sensor's readings by group of recordings; the first group is for validation.
    """

    name: str
    quantities: tuple[str, ...]
    dims: range
    members: tuple[int, ...]
    draws: int
    model: Callable[[int], Filter]
    behind: Callable[[Filter], Filter]
    read: Callable[[Filter], dict[str, Group]]

    def groups(self, members: int, folder: Path) -> dict[str, Group]:
        """Returns the readings by group, cached in a folder."""
        file = folder / f"{self.name}-{members}.pt"
        if not file.exists():
            folder.mkdir(parents=True, exist_ok=True)
            read = self.read(self.model(members))
            plain = {name: {key: batch.to_dict() for key, batch in group.items()} for name, group in read.items()}
            write_checkpoint(file, plain)
        plain = read_checkpoint(file)
        return {
            name: {key: TensorDict(batch, batch["state"].shape[:2]) for key, batch in group.items()}
            for name, group in plain.items()
        }


def kitti(root: Path, out: Path, *, smoke: bool = False) -> Task:
    """Returns drives in KITTI's layout below ``root``, and drives rendered along its eleven official trajectories.

    Eight drives rendered along synthetic trajectories are for validation. No filter or sensor was trained on them.
    """
    size = car_filter().settings.size
    frames = 30 if smoke else 600
    invented = [f"v{number}" for number in range(2 if smoke else 8)]
    official = [f"{number:02d}" for number in range(2 if smoke else 11)]

    def model(members: int) -> CarFilter:
        trained = from_pretrained("car-odometry")
        assert isinstance(trained, CarFilter)
        car = car_filter(replace(trained.settings, ensemble_size=members))
        # The members' calibrations are quantiles, one per member.
        car.load_state_dict({k: v for k, v in trained.state_dict().items() if "quantiles" not in k}, strict=False)
        return car.eval()

    def read(car: CarFilter) -> dict[str, Group]:
        render_drives(out / "validation", names=invented, frames=frames // 2, size=size, seed=1)
        render_drives(out / "rendered", poses=root / "poses", names=official, frames=frames, size=size)
        places = {
            "validation": [(out / "validation", name) for name in invented],
            "real": [(root, name) for name in list_kitti_drives(root)][: 1 if smoke else None],
            "rendered": [(out / "rendered", name) for name in official],
        }
        return {name: side_by_side((d, drive(car, r, d, out / "cache")) for r, d in of) for name, of in places.items()}

    names = ("speed m/s", "turn rate rad/s")
    return Task("kitti", names, range(3, 5), (32, 256), 4, model, CarFilter.without_sensor, read)


def drive(car: CarFilter, root: Path, name: str, cache: Path) -> TensorDict:
    """Returns the readings of a drive; the first state is the true pose with the first read velocities."""
    data = Drive(root, name, car.settings.size, cache).read()
    reading = all_frames(read_spans(car.sensor, [data], car.settings.longest))
    start = reading["state"].clone()
    start[0] = first_state(reading)
    return mark_start(reading.set("start", start))


def ur5(out: Path, *, smoke: bool = False) -> Task:
    """Returns demonstrations of the UR5 at its table: the test split, and a ninth of the others for validation."""

    def model(members: int) -> UR5TableFilter:
        trained = from_pretrained("ur5-table")
        assert isinstance(trained, UR5TableFilter)
        arm = UR5TableFilter(replace(trained.settings, ensemble_size=members))
        arm.load_state_dict(trained.state_dict())
        return arm.eval()

    def read(arm: UR5TableFilter) -> dict[str, Group]:
        demos = whole_demos(out, 10 if smoke else 60, progress=False)
        groups = {}
        for name, split in (("validation", "train"), ("test", "test")):
            replay = UR5ExperienceReplay(demos, split=split, cache=out / "cache", progress=False)
            steps = min(episode.length for episode in replay.episodes) if not smoke else 30
            chosen = replay.episodes[: max(len(replay.episodes) // 5, 1)] if split == "train" else replay.episodes
            rows = [replay[torch.arange(e.start, e.start + steps)].select("pixels", "state", "action") for e in chosen]
            read = read_demos(arm, torch.stack(rows))
            read["observed"] = torch.ones(*read.shape, 1, dtype=torch.bool)
            groups[name] = {f"{len(rows)} demos": mark_start(read)}
        return groups

    names = tuple(f"J{number} rad" for number in range(1, JOINTS + 1))
    return Task("ur5", names, range(JOINTS), (64,), 1, model, behind_sensor, read)


def side_by_side(recordings: Iterable[tuple[str, TensorDict]]) -> Group:
    """Returns recordings in batches of one length."""
    lengths: dict[int, list[tuple[str, TensorDict]]] = {}
    for name, recording in recordings:
        lengths.setdefault(len(recording), []).append((name, recording))
    return {" ".join(n for n, _ in of): TensorDict.stack([r for _, r in of]) for of in lengths.values()}


def tasks(root: Path | None, out: Path, *, smoke: bool = False) -> list[Callable[[], Task]]:
    """Returns functions that make the tasks; KITTI's only with data."""
    made: list[Callable[[], Task]] = [partial(ur5, out / "ur5", smoke=smoke)]
    return [partial(kitti, root, out / "kitti", smoke=smoke), *made] if root else made
