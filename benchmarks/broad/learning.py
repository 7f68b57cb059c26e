"""Learns the parameters of ``torch_denkf.applications.imu``, in three folds over the kinds of motion: numbers.json.

    python -m benchmarks.broad.learning --out benchmarks/broad/numbers.json

The filter's equations run in C (``equations.c``, by the compiler ``cc``): five minutes of one core. The lag of the
magnetometer and the latency of the readings are least squares. The place's field is the median over the trials. All
other parameters are found by an evolution strategy. It minimises, averaged over the trials, the total error plus the
inclination error, in degrees, plus 0.3 times the negative logarithm of Student's density of heading and inclination;
and on every second trial, with 6 axes, the inclination error plus 0.2 times the total error. Factors on the standard
deviations then set the coverage of the 90 % intervals to 90 %; they are larger if the factors from all other kinds are
too small for a kind. The parameters for new kinds, ``all``, are geometric means of the three sets; ``anywhere``, the
library's, has factors for an unknown field of the place.
"""

from __future__ import annotations

import ctypes
import json
import math
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from benchmarks.broad.task import LEVEL, Trial, read_trials, simulated_trial
from benchmarks.common.arguments import command, parse
from torch_denkf.applications.imu.filter import ImuFilter, ImuSettings, moves
from torch_denkf.applications.imu.log import astray, block_size, imu_rows
from torch_denkf.deployment.files import write_text
from torch_denkf.functional.manifolds import SO3

__all__ = ["Equations", "Rows", "beliefs", "learn", "minimised"]

#: Parameters that the strategy optimises, together with the three poles.
FREE = (
    *("gyro", "gyro_rate", "gyro_walk", "motion", "motion_unrest", "accelerometer", "gyro_scale", "gyro_skew"),
    *("magnetic_bias", "magnetic_walk", "magnetometer", "magnetometer_rate", "field_walk"),
    *("stray", "stray_unrest", "stray_time"),
    *("lag_std", "lever", "lever_walk", "heading", "heading_scale", "heading_floor", "tilt_scale", "tilt_floor"),
)
START = ImuSettings()
FIELD, LAG = 27, 29  # indices in a tangent
#: Kinds that are left out together.
FOLDS = (
    ("attached magnet", "slow rotation", "fast translation"),
    ("stationary magnet", "tapping", "fast rotation"),
    ("phone vibration", "fast combined", "slow translation"),
)
LARGE = 0.15  # rad: larger errors are not used to estimate the latency
FREEDOM = 4.0  # of Student's t


@dataclass(frozen=True)
class Learning:
    """Learns the parameters of the inertial sensor's filter."""

    data: Path = Path("../shared/data/broad")  # folder with .npz files of BROAD
    out: Path | None = None  # numbers.json
    start: Path | None = None  # numbers.json of the same folds to continue from, else the library's defaults
    generations: int = 22  # of the evolution strategy
    seed: int = 0
    smoke: bool = False  # one simulated trial, one generation


class Rows:
    """A trial's rows in the layout of the equations in C.

    Args:
        trial: with the truth.
        settings: of the filter; only the lag and the block are read.
        every: one of so many blocks is scored.
        six: whether the magnetometer is excluded.
        short: whether rows after the last scored one are dropped.
    """

    def __init__(self, trial: Trial, settings: ImuSettings, every: int = 3, *, six: bool = False, short: bool = False):
        field = None if six else trial.magnetometer
        rows = imu_rows(settings, trial.gyro, trial.acceleration, field, rate=trial.rate)
        names = ("gyro", "accelerometer", "magnetometer", "unrest", "disturbance", "lever")
        self.values = [np.ascontiguousarray(rows[name].numpy()) for name in names]
        self.rest = np.ascontiguousarray(rows["rest_observed"].numpy(), np.uint8)
        self.count, self.dt, self.state = len(rows), rows["dt"][0].item(), rows["start"][0].numpy().copy()
        size = block_size(settings, trial.rate)
        last = np.arange(self.count) * size + size - 1
        self.scored = np.flatnonzero(trial.scored.numpy()[last])[::every]
        self.truth = SO3().normalise(trial.orientation[torch.as_tensor(last[self.scored])])
        self.rate = trial.gyro[torch.as_tensor(last[self.scored])]
        if short:
            self.count = int(self.scored[-1]) + 1


class Equations:
    """The filter in C."""

    def __init__(self):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "equations.so"
            source = Path(__file__).parent / "equations.c"
            options = ["-O3", "-march=native", "-shared", "-fPIC", "-lm"]
            subprocess.run(["cc", source, *options[:-1], "-o", file, options[-1]], check=True)
            self.library = ctypes.CDLL(str(file))

    def __call__(self, rows: Rows, s: ImuSettings, *, nine: bool = True) -> tuple[ndarray, ndarray, ndarray]:
        """Returns orientations ``[N, 4]``, covariances ``[N, 9]`` about the world's axes, and states ``[N, 36]``.

        Args:
            rows: of the trial.
            s: the filter's parameters.
            nine: whether the magnetometer is read.
        """
        numbers = [s.gyro, s.gyro_rate, s.gyro_walk, 2 * sum(s.poles), s.motion, s.motion_unrest, s.accelerometer]
        numbers += [s.magnetometer, s.magnetometer_rate, s.magnetic_walk, s.field_walk, s.rest, s.gravity]
        numbers += [s.stray, s.stray_unrest, s.stray_time, s.lever_walk]
        start, step = ImuFilter(s).initial.std.double().numpy(), moves(s.poles, rows.dt).numpy().copy()
        found = np.empty((rows.count, 4)), np.empty((rows.count, 9)), np.zeros((rows.count, len(start)))
        given = [step, np.array(numbers), np.ascontiguousarray(start), rows.state, *found]
        arrays = (*map(_pointer, [*rows.values, rows.rest]), int(nine), *map(_pointer, given))
        self.library.filter(rows.count, ctypes.c_double(rows.dt), *arrays)
        return found


def beliefs(run: Equations, trial: Trial, settings: ImuSettings, *, six: bool = False) -> tuple[Tensor, Tensor]:
    """Returns means ``[N, 37]`` and covariances of the orientation ``[N, 3, 3]``, as the filter writes them."""
    quaternion, cov, states = map(torch.as_tensor, run(Rows(trial, settings, six=six), settings, nine=not six))
    return torch.cat([quaternion, states[:, 3:]], -1), cov.unflatten(-1, (3, 3))


def _pointer(array: ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


def measures(run: Equations, rows: Rows, s: ImuSettings, *, nine: bool = True) -> dict:
    """Returns root mean square errors in degrees, the negative log density of Student's t, and the factors of each row.

    The factors scale the variances of heading and inclination so that the 90 % interval just contains the error.
    """
    quaternion, cov, states = run(rows, s, nine=nine)
    found = SO3().plus(torch.as_tensor(quaternion[rows.scored]), rows.rate * s.latency)
    error = SO3().compose(found, SO3().inverse(rows.truth)).numpy()
    error = error * np.where(error[:, :1] < 0, -1, 1)
    w, x, y, z = error.T
    world = np.degrees(1) ** 2 * cov[rows.scored].reshape(-1, 3, 3)
    total, heading = np.degrees(2 * np.arccos(np.clip(w, 0, 1))), np.degrees(2 * np.arctan2(z, w))
    tilt = np.degrees(2 * np.arccos(np.clip(np.hypot(w, z), 0, 1)))
    off = astray(s, torch.nn.functional.pad(torch.as_tensor(states[rows.scored]), (1, 0))).numpy()  # as points
    variance = s.heading_scale**2 * world[:, 2, 2] + s.heading_floor**2 + np.degrees(1) ** 2 * off[..., 2]
    a, b = (s.tilt_scale**2 * world[:, i, i] + s.tilt_floor**2 for i in (0, 1))
    c = s.tilt_scale**2 * world[:, 0, 1]
    size = a * b - c * c
    two = np.degrees(2) ** 2 * (b * x * x + a * y * y - 2 * c * x * y) / size
    one, nu = heading**2 / variance, FREEDOM
    own = variance - np.degrees(1) ** 2 * off[..., 2]  # without the part that comes from the place's field
    return {
        "heading_need": (heading**2 / 2.7055 - variance + own) / own,
        "tilt_need": two / 4.6052,
        "total": np.sqrt((total**2).mean()),
        "inclination": np.sqrt((tilt**2).mean()),
        "surprise": ((nu + 1) / 2 * np.log1p(one / nu) + 0.5 * np.log(variance)).mean()
        + ((nu + 2) / 2 * np.log1p(two / nu) + 0.5 * np.log(size)).mean(),
    }


def minimised(
    loss: Callable[[ndarray], float], start: ndarray, step: float, generations: int, seed: int, size: int = 14
) -> ndarray:
    """Minimises by separable CMA-ES (Ros & Hansen 2008, PPSN X) with mirrored samples; returns the best found."""
    rng, n = np.random.default_rng(seed), len(start)
    parents = size // 2
    weights = math.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    weights /= weights.sum()
    mass = 1 / (weights**2).sum()
    c_path, c_size = (4 + mass / n) / (n + 4 + 2 * mass / n), (mass + 2) / (n + mass + 5)
    c_one = min(1.0, 2 / ((n + 1.3) ** 2 + mass) * (n + 2) / 3)
    c_rank = min(1 - c_one, 2 * (mass - 2 + 1 / mass) / ((n + 2) ** 2 + mass) * (n + 2) / 3)
    usual = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n))
    middle, spread, path, length = start.copy(), np.ones(n), np.zeros(n), np.zeros(n)
    best = (math.inf, start)
    for _ in range(generations):
        draws = rng.standard_normal((parents, n))
        steps = np.concatenate([draws, -draws]) * np.sqrt(spread)
        losses = np.array([loss(middle + step * each) for each in steps])
        order = np.argsort(losses)
        if losses[order[0]] < best[0]:
            best = losses[order[0]], middle + step * steps[order[0]]
        chosen = steps[order[:parents]]
        mean = weights @ chosen
        middle = middle + step * mean
        length = (1 - c_size) * length + math.sqrt(c_size * (2 - c_size) * mass) * mean / np.sqrt(spread)
        path = (1 - c_path) * path + math.sqrt(c_path * (2 - c_path) * mass) * mean
        spread = (1 - c_one - c_rank) * spread + c_one * path**2 + c_rank * (weights @ chosen**2)
        step *= math.exp(min(0.3, c_size / (1 + c_size) * (np.linalg.norm(length) / usual - 1)))
    return middle if loss(middle) < best[0] else best[1]


def _numbers(s: ImuSettings) -> ndarray:
    return np.log([getattr(s, name) for name in FREE] + list(s.poles))


def _with(s: ImuSettings, logs: ndarray) -> ImuSettings:
    values = np.exp(logs).tolist()
    return replace(s, poles=values[len(FREE) :], **dict(zip(FREE, values, strict=False)))


def latency(run: Equations, rows: Sequence[Rows], s: ImuSettings) -> float:
    """Returns the time by which the orientations are late, by least squares of their errors on the rate of turn."""
    above = below = 0.0
    for each in rows:
        found = torch.as_tensor(run(each, s)[0][each.scored])
        error = SO3().log(SO3().compose(SO3().inverse(each.truth), found))
        near = error.abs().amax(-1) < LARGE
        above -= (error * each.rate)[near].sum().item()
        below += each.rate[near].square().sum().item()
    return above / below


def learn(run: Equations, trials: Sequence[Trial], generations: int, seed: int, start: ImuSettings) -> ImuSettings:
    """Learns the parameters from some trials."""
    plain = [Rows(trial, replace(start, lag=0.0)) for trial in trials]
    weights = [np.square(each.values[0]).sum() for each in plain]
    lags = [run(each, replace(start, lag_std=0.01))[2][-1, LAG] for each in plain]
    start = replace(start, lag=float(np.average(lags, weights=weights)))
    rows = [Rows(trial, start, short=True) for trial in trials]
    six = [Rows(trial, start, short=True, six=True) for trial in trials[::2]]
    place = np.median([run(each, start)[2][each.scored, FIELD : FIELD + 2].mean(0) for each in rows], 0)
    s = replace(start, place=place.tolist(), latency=latency(run, rows, start))

    def loss(logs: ndarray) -> float:
        tried = _with(s, logs)
        nine = [measures(run, each, tried) for each in rows]
        other = [measures(run, each, tried, nine=False) for each in six]
        value = np.mean([each["total"] + each["inclination"] + 0.3 * each["surprise"] for each in nine])
        value = float(value + np.mean([each["inclination"] + 0.2 * each["total"] for each in other]))
        return value if math.isfinite(value) else 1e3

    s = _with(s, minimised(loss, _numbers(s), 0.2, generations, seed))
    return calibrated(run, trials, replace(s, latency=latency(run, rows, s)))


def calibrated(run: Equations, trials: Sequence[Trial], s: ImuSettings) -> ImuSettings:
    """Returns the settings with factors on the standard deviations for a coverage of 90 %."""
    found = [measures(run, Rows(trial, s, short=True), s) for trial in trials]
    kinds = [trial.kind for trial in trials]
    for name in ("heading", "tilt"):
        needs = [each[f"{name}_need"] for each in found]
        strange = []  # factors that a kind needs in addition to the factor from all other kinds
        for kind, need in zip(kinds, needs, strict=True):
            others = [each for its, each in zip(kinds, needs, strict=True) if its != kind]
            strange.append(need / factor(others or needs))
        both = math.sqrt(factor(needs) * factor(strange))
        s = replace(s, **{f"{name}_{part}": both * getattr(s, f"{name}_{part}") for part in ("scale", "floor")})
    return s


def factor(needs: Sequence[ndarray]) -> float:
    """Returns the factor that suffices for 90 % of the rows, with the same weight for each trial."""
    values, weights = np.concatenate(needs), np.concatenate([np.full(len(each), 1 / len(each)) for each in needs])
    order = np.argsort(values)
    return float(values[order][np.searchsorted(weights[order].cumsum(), LEVEL * len(needs))])


def _means(sets: Sequence[ImuSettings]) -> dict:
    """Returns geometric means of all parameters except the place."""
    names = [name for name in asdict(sets[0]) if name != "place"]
    return {name: np.exp(np.mean(np.log([getattr(each, name) for each in sets]), 0)).tolist() for name in names}


def main(arguments: Sequence[str] | None = None) -> None:
    """Learns the parameters, and writes them."""
    options = parse(Learning, arguments)
    run = Equations()
    if options.smoke:
        print(learn(run, [simulated_trial()], 1, options.seed, START))
        return
    trials, numbers, sets, anywhere = read_trials(options.data), {}, [], []
    before = {} if options.start is None else json.loads(options.start.read_text())["numbers"]
    for fold in FOLDS:
        rest = [each for each in trials if each.kind not in fold]
        start = ImuSettings(**before[fold[0]]) if before else START
        sets.append(learn(run, rest, options.generations, options.seed, start))
        anywhere.append(calibrated(run, rest, replace(sets[-1], place=None)))
        numbers |= dict.fromkeys(fold, asdict(sets[-1]))
        print(fold, sets[-1], anywhere[-1], flush=True)
    place = np.mean([each.place for each in sets], 0).tolist()  # type: ignore[arg-type]
    numbers["all"] = {**_means(sets), "place": place}
    numbers["anywhere"] = _means(anywhere)
    page = {"command": command("broad.learning"), "seed": options.seed, "numbers": numbers}
    if options.out is not None:
        write_text(options.out, json.dumps(page, indent=1) + "\n")


if __name__ == "__main__":
    main()
