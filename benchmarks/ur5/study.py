"""The study's options, and the jobs of its table, each of which can be broken off and resumed."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Literal

import torch
from tensordict import TensorDict
from torch import Tensor
from tyro.conf import OmitArgPrefixes, Positional

from benchmarks.common.arguments import some_of
from benchmarks.common.jobs import once, read_rows
from benchmarks.ur5.demos import Collections, FramePool, Roles, real_roles, sequences_of, sim_roles
from benchmarks.ur5.evaluation import conditions_of, filter_rows, save_beliefs, sensor_rows, size_rows, validation_crps
from benchmarks.ur5.glimpse import COARSE
from benchmarks.ur5.laboratory import LEVELS, Pasted
from benchmarks.ur5.motion import ArmMotion, train_motion
from benchmarks.ur5.readings import read_all, read_codes
from benchmarks.ur5.recipes import FILTERS, UR5Recipe
from benchmarks.ur5.sensors import MEMBERS, SAMPLES, SENSORS, WRIST, Statistics, adopt, train_sensor
from benchmarks.ur5.training import Budget, train_filter
from torch_denkf.applications.ur5.simulation.domains import SIM, Domain
from torch_denkf.filters import Filter
from torch_denkf.modules import ImageSensor
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

TRAININGS = ("sim", "fine_tuned")
SALTED = 3  # every third tuning demo is read with salt and pepper, too
PICTURED = 3  # test demos whose beliefs are left for the plots


@dataclass(frozen=True)
class Study(Collections):
    """A UR5 that one camera watches: joints, gripper and end effector, with every filter that is registered.

    collect: demos into --root. table: collect what is missing, train, test. pictures: videos and plots of what a table
    left in --out. frontier: error against milliseconds a step of the filters that a table left there. members: DEnKFs
    that are trained with few members, by localisation. What was broken off goes on where it stopped. See the README.
    """

    command: Positional[Literal["collect", "table", "pictures", "frontier", "members"]] = "table"
    filters: some_of(sorted(FILTERS)) = tuple(sorted(FILTERS))
    sensors: some_of(sorted(SENSORS)) = ("glimpse", "paper")
    trainings: some_of(TRAININGS) = TRAININGS
    seeds: tuple[int, ...] = (0,)
    sizes: tuple[int, ...] = (4, 8, 16, 32, 64, 128, 256, 512, 1024)  # of the ensemble, for one row each
    localisations: tuple[str, ...] = ("factors", "significance")  # that members trains with
    members: int = 64  # that members trains with
    threshold: float = 1.5  # of significance in these trainings
    processes: int = 1  # that collect
    budget: OmitArgPrefixes[Budget] = field(default_factory=Budget)
    smoke: bool = False  # a tiny run of everything


class Base:
    """Holds what all filters of a sensor, a training and a seed share: sensor, statistics, motions, features of demos.

    Args:
        study: the study.
        kind: name of the sensor.
        training: ``"sim"`` or ``"fine_tuned"``, in the simulator and then on a few demos of ``real_like``.
        seed: of all random numbers.
    """

    def __init__(self, study: Study, kind: str, training: str, seed: int):
        self.study, self.kind, self.training, self.seed = study, kind, training, seed
        self.preset = SENSORS[kind]
        self.domain = "sim" if training == "sim" else "real_like"
        self.name = f"{training}-{kind}-{seed}"
        self.parent = Base(study, kind, "sim", seed) if training == "fine_tuned" else None
        self.roles: Roles = sim_roles(study) if training == "sim" else real_roles(study)
        self.sensor, self.facts = self._sensor()

    @cached_property
    def states(self) -> Tensor:
        """States of the simulator's demos that the sensor may see, ``[N, T, 10]``."""
        return sequences_of(self.study.replay("sim-frames", "train"), self.study.sequences)

    def _sensor(self) -> tuple[ImageSensor, Statistics]:
        """The trained sensor. Its statistics lie beside it, so that a resumed study does not read the pictures."""
        out = self.folder(self.kind)
        if (out / "sensor.pt").exists() and (out / "facts.pt").exists():
            facts = Statistics(**read_checkpoint(out / "facts.pt"))
            sensor = self.preset.build(facts, SAMPLES)
            sensor.load_state_dict(read_checkpoint(out / "sensor.pt")["sensor"])
            return sensor.eval(), facts
        sensor, facts = self._train_sensor(out)
        write_checkpoint(out / "facts.pt", vars(facts))
        return sensor, facts

    def _train_sensor(self, out: Path) -> tuple[ImageSensor, Statistics]:
        study, roles, budget = self.study, self.roles, self.study.budget
        name = "sim-frames" if self.training == "sim" else "real_like-sequences"
        data = study.replay(name, "train", frames_only=True)
        held_out = set(sorted({*roles.tune, *roles.validation})[::2] if self.training == "sim" else roles.validation)
        pool, checked = FramePool(data, roles.sensor), FramePool(data, held_out)
        torch.manual_seed(self.seed)
        if self.parent is not None:
            facts, sensor = self.parent.facts, deepcopy(self.parent.sensor)
            pool, look = self._pasted(pool)
            updates, lr = budget.fine_tuning, 1e-3
        else:
            facts, look = Statistics.of(self.states, pool), SIM
            sensor = self.preset.build(facts, SAMPLES)
            updates, lr = budget.sensor, 2e-3
        if self.preset.coarse is not None:
            coarse = SENSORS[self.preset.coarse]
            times = max(facts.size // COARSE, 1)
            first = coarse.build(replace(facts, size=facts.size // times), SAMPLES)
            if self.parent is not None:
                first.load_state_dict(read_checkpoint(self.parent.folder(coarse.name) / "sensor.pt")["sensor"])
            settings = {"out": self.folder(coarse.name), "seed": self.seed, "updates": updates, "lr": lr}
            train_sensor(first, coarse, pool.shrunk(times), checked.shrunk(times), times=times, **settings)
            adopt(sensor, first, pool, look)
            updates, lr = max(updates // 2, 1), 0.75 * lr
        train_sensor(sensor, self.preset, pool, checked, out=out, seed=self.seed, updates=updates, lr=lr)
        return sensor, facts

    def folder(self, kind: str) -> Path:
        """Returns the folder of the sensor of a kind with this training and seed."""
        return self.study.out / "sensors" / f"{self.training}-{kind}-{self.seed}"

    def _pasted(self, pool: FramePool) -> tuple[FramePool, Domain]:
        """Frames, and pictures of the simulator's states as the other domain's camera would take them; that camera."""
        assert self.parent is not None
        states = self.parent.states.flatten(0, 1)
        generator = torch.Generator().manual_seed(self.seed)
        states = states[torch.randint(len(states), (self.study.pasted,), generator=generator)]
        paste = Pasted(pool.pixels, pool.state, ((4, 8.0, 1),) if self.study.smoke else LEVELS)
        pixels = paste(states, self.seed)
        paste.close()
        return pool.joined(pixels, states), paste.look

    @cached_property
    def motion(self) -> ArmMotion:
        """The motion, trained on true states."""
        if self.parent is not None:
            return self.parent.motion
        torch.manual_seed(self.seed)
        motion, out = ArmMotion(self.facts), self.study.out / "motions" / f"{self.training}-{self.seed}"
        return train_motion(motion, self.states, out=out, seed=self.seed, updates=self.study.budget.motion)

    def codes(self, role: str, condition: str = "clean", domain: str | None = None) -> TensorDict:
        """Features of the demos of a role, in a domain of which they may not be."""
        domain = self.domain if domain is None else domain
        demos = getattr(self.roles if domain == self.domain else real_roles(self.study), role)
        if condition == "salt_and_pepper" and role == "tune":
            demos = demos[::SALTED]
        file = self.study.out / "codes" / f"{self.name}-{domain}-{role}-{condition}.pt"
        data = self.study.replay(f"{domain}-sequences", "test" if role == "test" else "train")
        return read_codes(self.sensor, data, demos, condition=condition, file=file)

    def recipe(self, name: str, size: int = MEMBERS) -> UR5Recipe:
        """A filter's recipe, with a sensor of its own."""
        return FILTERS[name](deepcopy(self.sensor), self.preset, self.facts, self.motion, self.error(), size)

    def error(self) -> Tensor:
        """Root mean square error of the sensor on the validation demos, ``[10]``."""
        reading = read_all(self.sensor, self.codes("validation"), MEMBERS)
        truth = reading["state"]
        read = self.preset.state_of(reading["sensor", "ensemble"].mean(-2), truth[..., WRIST])
        return (read - truth).square().mean((0, 1)).sqrt()

    def train(self, name: str, recipe: UR5Recipe | None = None) -> tuple[UR5Recipe, Filter, Path]:
        """Trains a filter, or reads it; by default that of the name's recipe."""
        recipe, out = recipe or self.recipe(name), self.study.out / "filters" / f"{name}-{self.name}"
        begin = None if self.parent is None else self.parent.train(name)[1]
        tune = [self.codes("tune"), self.codes("tune", "salt_and_pepper")]
        validation = self.codes("validation")
        model = train_filter(recipe, tune, validation, out=out, seed=self.seed, budget=self.study.budget, begin=begin)
        return recipe, model, out

    def readings(self, sensor: ImageSensor, domain: str) -> dict[str, TensorDict]:
        """Returns what a sensor reads of the test demos, in all conditions."""
        clean, salted = (self.codes("test", condition, domain) for condition in ("clean", "salt_and_pepper"))
        return conditions_of(read_all(sensor, clean, MEMBERS), read_all(sensor, salted, MEMBERS))


def run_all(study: Study) -> None:
    """Trains and tests everything: all filters with the first sensor in the simulator, the DEnKF everywhere."""
    for seed in study.seeds:
        for kind in study.sensors:
            first = kind == study.sensors[0]
            trainings = [name for name in study.trainings if first or name == "sim"]
            for training in trainings:
                chosen = [name for name in study.filters if name == "denkf" or (first and training == "sim")]
                run_jobs(study, chosen, kind, training, seed, changed=first and len(trainings) > 1)


def run_jobs(
    study: Study, filters: Sequence[str], kind: str, training: str, seed: int, *, changed: bool = False
) -> None:
    """Trains and tests what is not done already; leaves rows in ``--out/rows``.

    Args:
        study: the study.
        filters: names.
        kind: name of the sensor.
        training: see :class:`Base`.
        seed: of all random numbers.
        changed: whether DEnKF of the simulator is tested on the changed domain, too, as it is.
    """
    base, folder = Base(study, kind, training, seed), study.out / "rows"
    names = {"sensor": kind, "training": training, "seed": seed}
    for domain in ("sim", "real_like") if training == "sim" and changed else (base.domain,):
        own = {**names, "domain": domain}
        once(folder / f"sensor-{base.name}-{domain}.json", partial(_sensor, base, own))
        for name in filters if domain == base.domain else set(filters) & {"denkf"}:
            rows = partial(_filter, base, {**own, "filter": name, "ensemble_size": members_of(name)})
            once(folder / f"{name}-{base.name}-{domain}.json", rows)
    if "denkf" in filters:
        own = {**names, "domain": base.domain, "filter": "denkf"}
        once(folder / f"sizes-{base.name}.json", partial(_sizes, base, own))


def members_of(name: str) -> int:
    """Returns how many members a filter has in the table."""
    return MEMBERS if name == "denkf" else 1


def _sensor(base: Base, names: dict) -> list[dict]:
    return sensor_rows(base.preset, base.readings(base.sensor, names["domain"]), names)


def _filter(base: Base, names: dict) -> list[dict]:
    recipe, model, _ = base.train(names["filter"])
    domain = names["domain"]
    readings = base.readings(recipe.sensor, domain)
    rows = filter_rows(recipe, model, readings, names)
    own = read_all(recipe.sensor, base.codes("validation"), MEMBERS)
    rows[0]["validation_crps"] = validation_crps(recipe, model, own)
    if names["filter"] == "denkf" and domain == base.domain:
        data = base.study.replay(f"{domain}-sequences", "test")
        demos, folder = base.roles.test[:PICTURED], base.study.out / "beliefs"
        save_beliefs(recipe, model, readings, data, demos, folder, f"denkf-{base.kind}-{domain}")
    return rows


def _sizes(base: Base, names: dict) -> list[dict]:
    recipe, _, out = base.train(names["filter"])
    sizes = [size for size in base.study.sizes if size != MEMBERS]  # that one is in the table
    make = partial(base.recipe, names["filter"])
    saved, validation = read_checkpoint(out / "filter.pt"), base.codes("validation")
    return size_rows(make, recipe.sensor, base.codes("test"), sizes, saved, names, validation)


def rows_of(out: Path) -> list[dict]:
    """All rows that a study's folder holds."""
    return read_rows(sorted((out / "rows").glob("*.json")))
