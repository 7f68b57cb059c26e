"""The study's options, and the jobs of its table, each of which can be interrupted and resumed."""

from __future__ import annotations

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
from benchmarks.common.arm import JOINTS, Roles, scores
from benchmarks.common.arm.motion import train_motion, with_rates
from benchmarks.common.arm.readings import fail, read_all, read_codes
from benchmarks.common.arm.sensors import Statistics
from benchmarks.common.jobs import once
from benchmarks.common.scores import processor_ms
from benchmarks.common.training import read_filter
from benchmarks.ur5.demos import STATE, Collections, FramePool, real_roles, sequences_of, sim_roles
from benchmarks.ur5.laboratory import LEVELS, Pasted
from benchmarks.ur5.motion import AHEAD, Motion
from benchmarks.ur5.recipes import FILTERS, UR5Recipe
from benchmarks.ur5.sensors import COARSE, MEMBERS, SAMPLES, SENSORS, WRIST, Preset, adopt, train_preset, unit_of
from benchmarks.ur5.training import Budget, train_filter, with_missing
from torch_denkf.applications.ur5.simulation.domains import SIM, Domain
from torch_denkf.envs import SaltAndPepper
from torch_denkf.filters import Filter
from torch_denkf.modules import ImageSensor
from torch_denkf.training import hold_last
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

TRAININGS = ("sim", "fine_tuned")
CONDITIONS = ("clean", "black20", "missing", "salt_and_pepper")
SALTED = 3  # every third tuning demo is also read with salt and pepper
NAMES = tuple(f"J{number + 1}" for number in range(JOINTS))
score_row = partial(scores.score_row, names=NAMES, unit=unit_of(STATE), circular=range(6))  # the gripper's is no angle


@dataclass(frozen=True)
class Study(Collections):
    """Estimates joints, gripper and end effector of a UR5 from one camera, with every registered filter.

    collect: demos into --root. table: collect what is missing, train, test. pictures: plots of a finished table in
    --out. frontier: error against milliseconds per step of its filters. members: DEnKFs trained with few members, by
    localisation. An interrupted run resumes. See the README.
    """

    command: Positional[Literal["collect", "table", "pictures", "frontier", "members"]] = "table"
    filters: some_of(sorted(FILTERS)) = tuple(sorted(FILTERS))
    sensors: some_of(sorted(SENSORS)) = ("glimpse", "paper")
    trainings: some_of(TRAININGS) = TRAININGS
    seeds: tuple[int, ...] = (0,)
    sizes: tuple[int, ...] = (4, 8, 16, 32, 64, 128, 256, 512, 1024)  # of the ensemble, for one row each
    localisations: tuple[str, ...] = ("factors", "significance")  # in the trainings of the command members
    members: int = 64  # in the trainings of the command members
    threshold: float = 1.5  # of significance in these trainings
    processes: int = 1  # that collect demos
    budget: OmitArgPrefixes[Budget] = field(default_factory=Budget)
    smoke: bool = False  # a tiny run of everything


class Base:
    """Sensor, statistics, motion and features of demos, shared by all filters of a sensor, a training and a seed.

    Args:
        study: the study.
        kind: name of the sensor.
        training: ``"sim"`` or ``"fine_tuned"``, in the simulator and then on a few demos of ``real_like``.
        seed: of all random numbers.
    """

    def __init__(self, study: Study, kind: str, training: str, seed: int):
        self.study, self.kind, self.training, self.seed = study, kind, training, seed
        self.preset, self.domain = SENSORS[kind], "sim" if training == "sim" else "real_like"
        self.name = f"{training}-{kind}-{seed}"
        self.parent = Base(study, kind, "sim", seed) if training == "fine_tuned" else None
        self.roles: Roles = sim_roles(study) if training == "sim" else real_roles(study)
        self.sensor, self.facts = self._sensor()

    @cached_property
    def states(self) -> Tensor:
        """Returns states of the simulator's demos for the sensor's training, ``[N, T, 10]``."""
        return sequences_of(self.study.replay("sim-frames", "train"), self.study.sequences)

    def _sensor(self) -> tuple[ImageSensor, Statistics]:
        """Returns the trained sensor, whose statistics are saved with it, so that a resumed study reads no images."""
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
        held_out = sorted({*roles.tune, *roles.validation})[::2] if self.training == "sim" else roles.validation
        pool, checked = FramePool.of(data, roles.sensor), FramePool.of(data, held_out)
        torch.manual_seed(self.seed)
        if self.parent is not None:
            facts, sensor, updates, lr = self.parent.facts, deepcopy(self.parent.sensor), budget.fine_tuning, 1e-3
            pool, look = self._pasted(pool)
        else:
            facts, look, updates, lr = Statistics.of(list(self.states), pool.pixels), SIM, budget.sensor, 2e-3
            sensor = self.preset.build(facts, SAMPLES)
        if self.preset.coarse is not None:
            coarse, times = SENSORS[self.preset.coarse], max(facts.size[0] // COARSE, 1)
            first = coarse.build(replace(facts, size=tuple(side // times for side in facts.size)), SAMPLES)
            if self.parent is not None:
                first.load_state_dict(read_checkpoint(self.parent.folder(coarse.name) / "sensor.pt")["sensor"])
            small = [one.shrunk(times) for one in (pool, checked)]
            settings = {"out": self.folder(coarse.name), "seed": self.seed, "updates": updates, "lr": lr}
            train_preset(first, coarse, *small, times, **settings)
            adopt(sensor, first, pool, look)
            updates, lr = max(updates // 2, 1), 0.75 * lr
        settings = {"out": out, "seed": self.seed, "updates": updates, "lr": lr}
        return train_preset(sensor, self.preset, pool, checked, **settings), facts

    def folder(self, kind: str) -> Path:
        """Returns the folder of the sensor of a kind with this training and seed."""
        return self.study.out / "sensors" / f"{self.training}-{kind}-{self.seed}"

    def _pasted(self, pool: FramePool) -> tuple[FramePool, Domain]:
        """Returns frames, images of the simulator's states by the other domain's camera, and that camera."""
        assert self.parent is not None
        states = self.parent.states.flatten(0, 1)
        generator = torch.Generator().manual_seed(self.seed)
        states = states[torch.randint(len(states), (self.study.pasted,), generator=generator)]
        paste = Pasted(pool.pixels, pool.state, ((4, 8.0, 1),) if self.study.smoke else LEVELS)
        pixels = paste(states, self.seed)
        paste.close()
        return FramePool(torch.cat([pool.pixels, pixels]), torch.cat([pool.state, states])), paste.look

    @cached_property
    def motion(self) -> Motion:
        """Returns the motion, trained on true states."""
        if self.parent is not None:
            return self.parent.motion
        torch.manual_seed(self.seed)
        motion, out = Motion(self.facts), self.study.out / "motions" / f"{self.training}-{self.seed}"
        paths = list(with_rates(self.states, 2))
        return train_motion(motion, paths, AHEAD, out=out, seed=self.seed, updates=self.study.budget.motion)

    def codes(self, role: str, condition: str = "clean", domain: str | None = None) -> TensorDict:
        """Returns features of the demos of a role in a domain, with rates and accelerations."""
        domain = self.domain if domain is None else domain
        demos = getattr(self.roles if domain == self.domain else real_roles(self.study), role)
        salt = SaltAndPepper(generator=torch.Generator().manual_seed(0))
        if condition == "salt_and_pepper" and role == "tune":
            demos = demos[::SALTED]

        def see(rows: TensorDict) -> TensorDict:
            rows = rows.select("pixels", "state")
            return salt(rows) if condition == "salt_and_pepper" else rows

        file = self.study.out / "codes" / f"{self.name}-{domain}-{role}-{condition}.pt"
        data = self.study.replay(f"{domain}-sequences", "test" if role == "test" else "train")
        rows = {e.demo: torch.arange(e.start, e.start + e.length) for e in data.episodes}
        codes = read_codes([self.sensor], data, [rows[number] for number in demos], see, file)
        return codes.set("motion", with_rates(codes["state"], 2))

    @cached_property
    def error(self) -> Tensor:
        """Returns the root mean square error of the sensor on the validation demos, ``[10]``."""
        reading = read_all([self.sensor], self.codes("validation"), MEMBERS)
        truth = reading["state"]
        read = self.preset.state_of(reading["sensor", "ensemble"].mean(-2), truth[..., WRIST])
        return (read - truth).square().mean((0, 1)).sqrt()

    def recipe(self, name: str, size: int = MEMBERS) -> UR5Recipe:
        """Returns a filter's recipe, with a copy of the sensor."""
        return FILTERS[name](deepcopy(self.sensor), self.preset, self.facts, self.motion, self.error, size)

    def train(self, name: str, recipe: UR5Recipe | None = None) -> tuple[UR5Recipe, Filter, Path]:
        """Trains a filter, or loads it; by default that of the name's recipe."""
        recipe, out = recipe or self.recipe(name), self.study.out / "filters" / f"{name}-{self.name}"
        begin = None if self.parent is None else self.parent.train(name)[1]
        tune = [self.codes("tune"), self.codes("tune", "salt_and_pepper")]
        settings = {"seed": self.seed, "budget": self.study.budget, "begin": begin}
        model = train_filter(recipe, tune, self.codes("validation"), out=out, **settings)
        return recipe, model, out

    def readings(self, sensor: ImageSensor, domain: str) -> dict[str, TensorDict]:
        """Returns a sensor's readings of the test demos, in all conditions."""
        clean, salted = (
            read_all([sensor], self.codes("test", name, domain), MEMBERS) for name in ("clean", "salt_and_pepper")
        )
        return {name: salted if name == "salt_and_pepper" else fail(clean, name) for name in CONDITIONS}


def run_all(study: Study) -> None:
    """Trains and tests everything: all filters with the first sensor in the simulator, the DEnKF everywhere.

    The simulator's DEnKF is also tested on the changed domain without fine-tuning. Writes rows to ``--out/rows``.
    """
    for seed in study.seeds:
        for kind in study.sensors:
            first = kind == study.sensors[0]
            trainings = [name for name in study.trainings if first or name == "sim"]
            for training in trainings:
                base, folder = Base(study, kind, training, seed), study.out / "rows"
                names = {"sensor": kind, "training": training, "seed": seed}
                changed = first and training == "sim" and len(trainings) > 1
                for domain in ("sim", "real_like") if changed else (base.domain,):
                    own, all_filters = {**names, "domain": domain}, first and training == "sim" and domain == "sim"
                    once(folder / f"sensor-{base.name}-{domain}.json", partial(_sensor, base, own))
                    for name in [name for name in study.filters if all_filters or name == "denkf"]:
                        rows = partial(_filter, base, {**own, "filter": name, "ensemble_size": members_of(name)})
                        once(folder / f"{name}-{base.name}-{domain}.json", rows)
                if "denkf" in study.filters:
                    own = {**names, "domain": base.domain, "filter": "denkf"}
                    once(folder / f"sizes-{base.name}.json", partial(_sizes, base, own))


def members_of(name: str) -> int:
    """Returns the number of members of a filter in the table."""
    return MEMBERS if name == "denkf" else 1


def sensor_rows(preset: Preset, readings: dict[str, TensorDict], names: dict) -> list[dict]:
    """Returns rows of the sensor alone, with a zero-order hold."""
    rows = []
    for condition, reading in readings.items():
        truth, samples, seen = reading["state"], reading["sensor", "ensemble"], reading["observed"]
        near = preset.side_of(samples.mean(-2))
        near = near + 2 * torch.pi * ((truth[..., WRIST] - near) / (2 * torch.pi)).round()  # removes whole turns
        read = preset.state_of(samples.mean(-2), near)
        var = preset.state_of(samples, near.unsqueeze(-1).expand(samples.shape[:-1])).var(-2)
        out = scores.estimated(reading, hold_last(read, seen, truth[:, 0]), hold_last(var, seen, var[:, 0]))
        rows.append({**names, "filter": "sensor", "ensemble_size": MEMBERS, **score_row(out, condition)})
    return rows


def size_row(base: Base, recipe: UR5Recipe, saved: dict, names: dict, chunk: int | None = None) -> dict:
    """Returns a row of a trained filter with other members on clean demos, and its CRPS on the validation demos.

    With ``chunk``, ``ms_per_step`` is processor time of compiled chunks of that many steps, and ``eager_ms_per_step``
    of eager steps; 0 compiles nothing.
    """
    model, outs = read_filter(recipe, recipe.build(), saved), []
    for part in base.codes("test").split(8):  # a large ensemble of all demos takes gigabytes
        readings = read_all([recipe.sensor], part, recipe.members)
        outs.append(scores.run_filter(recipe, model, readings).exclude("sensor"))
    if chunk is None:
        times = scores.cost_of(recipe, model, readings)
    else:
        row, behind, times = readings[:1, : scores.TIMED], recipe.behind(model), {}
        for column, steps in (("eager_ms_per_step", 0), ("ms_per_step", chunk)):
            behind.compile(chunk=steps)
            times[column] = processor_ms(lambda: behind.sequence(row.copy()), row.shape[1])
    crps = scores.filter_error(recipe, model, with_missing(recipe, base.codes("validation")))["crps"]
    out = torch.cat(outs)
    return {**names, **score_row(out, "clean"), **times, "ensemble_size": recipe.members, "validation_crps": crps}


def trained(base: Base, name: str, recipe: UR5Recipe | None = None) -> dict:
    """Trains or loads a filter, and returns its weights, with those of its sensor's head, and its inflation."""
    return read_checkpoint(base.train(name, recipe)[2] / "filter.pt")


def _sensor(base: Base, names: dict) -> list[dict]:
    return sensor_rows(base.preset, base.readings(base.sensor, names["domain"]), names)


def _filter(base: Base, names: dict) -> list[dict]:
    recipe, model, _ = base.train(names["filter"])
    readings = base.readings(recipe.sensor, names["domain"])
    rows = scores.filter_rows(recipe, model, readings, lambda out, condition: {**names, **score_row(out, condition)})
    error = scores.filter_error(recipe, model, with_missing(recipe, base.codes("validation")))
    rows[0]["validation_crps"] = error["crps"]
    if names["filter"] == "denkf" and names["domain"] == base.domain:
        scores.save_beliefs(recipe, model, readings, f"denkf-{base.kind}-{base.domain}", base.study.out / "beliefs")
    return rows


def _sizes(base: Base, names: dict) -> list[dict]:
    saved = trained(base, "denkf")
    sizes = [size for size in base.study.sizes if size != MEMBERS]  # that one is in the table
    return [size_row(base, base.recipe("denkf", size), saved, names) for size in sizes]
