"""A log of one robot: milliseconds per row, eagerly and compiled, and seconds of the first compiled call.

The attitude filter is compared with the same equations in numpy. The first call is timed in a new process with an empty
cache of torch's compiler, and again in a second process with the filled cache.

python -m benchmarks.speed.one_row attitude     # one first call in this process: wall and processor time, in seconds
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from statistics import median

import numpy as np
import torch
from tensordict import TensorDict

from benchmarks.common.quaternions import exp, matrix, product, right_jacobian, skew
from benchmarks.speed.pairs import Row, interleave
from benchmarks.speed.workload import make_filter, make_frames, make_gaussian_filter
from torch_denkf.filters import Filter, KalmanFilter
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.modules import MomentPrior
from torch_denkf.motions import AttitudeMotion, Gravity, Magnetic

DT, GYRO_NOISE, GYRO_WALK = 0.01, 1e-3, 1e-5  # s, rad/s/sqrt(Hz), rad/s^2/sqrt(Hz)
FORCE_STD, FIELD_STD, FIELD = 0.5, 1.0, (0.0, 20.0, -40.0)  # m/s^2, uT, uT
START = [0.1] * 3 + [0.01] * 3  # variances: rad^2, (rad/s)^2
#: Targets: ms of an eager row; s of a first call with an empty cache, and in a second process.
WANTED_MS = {"Kalman, 2 states": 0.2, "EKF, Table I": 1.0, "DEnKF, Table I, 32 members": 0.75, "attitude EKF": 1.2}
WANTED_S = (15.0, 4.0)
SHORT = {"kalman": "Kalman, 2 states", "ekf": "EKF, Table I", "denkf": "DEnKF, Table I, 32 members"}
SHORT["attitude"] = "attitude EKF"


def kalman() -> tuple[Filter, TensorDict]:
    move, read = torch.tensor([[1.0, 0.1], [0.0, 1.0]]), torch.tensor([[1.0, 0.0]])
    q, start = torch.diag(torch.tensor([0.01, 0.1])), {"mean": torch.zeros(2), "cov": torch.eye(2)}
    filter = KalmanFilter(move, read, process_noise_cov=q, noise_cov=torch.eye(1), **start)
    return filter, TensorDict({"observation": torch.ones(1, 1)}, [1])


def attitude() -> tuple[Filter, TensorDict]:
    motion = AttitudeMotion(DT, gyro_noise=GYRO_NOISE, gyro_walk=GYRO_WALK)
    sensors = {
        "force": FusedSensor(Gravity(motion.space), [FORCE_STD] * 3),
        "field": FusedSensor(Magnetic(motion.space, FIELD), [FIELD_STD] * 3),
    }
    initial = MomentPrior(motion.space.neutral(), torch.diag(torch.tensor(START)), space=motion.space)
    noise = motion.process_noise
    filter = FusedFilter(motion, sensors, initial=initial, process_noise=noise, control_keys=("gyro",))
    readings = {"gyro": [0.1, 0.2, 0.3], "force": [0.1, 0.2, 9.8], "field": [1.0, 20.0, -40.0]}
    return filter, TensorDict({key: torch.tensor([value]) for key, value in readings.items()}, [1])


def ekf() -> tuple[Filter, TensorDict]:
    return make_gaussian_filter("EKF"), make_frames(1, 1, samples=False)[:, 0]


def denkf() -> tuple[Filter, TensorDict]:
    return make_filter(), make_frames(1, 1)[:, 0]


FILTERS: dict[str, Callable[[], tuple[Filter, TensorDict]]] = {
    "kalman": kalman,
    "ekf": ekf,
    "denkf": denkf,
    "attitude": attitude,
}


def numpy_attitude() -> Callable[[], np.ndarray]:
    """Returns a call that runs the attitude filter on one row, in double precision: numpy is no faster in single."""
    row = {key: value.numpy().astype(float) for key, value in attitude()[1].items()}
    constants = [(row["force"], np.array([0.0, 0.0, 9.81]), FORCE_STD), (row["field"], np.array(FIELD), FIELD_STD)]
    q = np.diag([GYRO_NOISE**2 * DT] * 3 + [GYRO_WALK**2 * DT] * 3)
    state = [np.array([[1.0, 0.0, 0.0, 0.0]]), np.zeros((1, 3)), np.diag(START)[None]]

    def call() -> np.ndarray:
        turn, bias, cov = state
        angles = (row["gyro"] - bias) * DT
        turn, move = product(turn, exp(angles)), np.eye(6)[None].copy()
        move[:, :3, :3] = matrix(exp(-angles))
        move[:, :3, 3:] = -DT * right_jacobian(angles)
        cov = move @ cov @ move.mT + q
        for reading, direction, std in constants:
            expected = matrix(turn).mT @ direction
            reads = np.concatenate([skew(expected), np.zeros((1, 3, 3))], -1)
            noise = std**2 * np.eye(3)
            gain = cov @ reads.mT @ np.linalg.inv(reads @ cov @ reads.mT + noise)
            change = (gain @ (reading - expected)[..., None])[..., 0]
            keep, reset = np.eye(6) - gain @ reads, np.eye(6)[None].copy()
            reset[:, :3, :3] = right_jacobian(change[:, :3])
            cov = reset @ (keep @ cov @ keep.mT + gain @ noise @ gain.mT) @ reset.mT
            cov = 0.5 * (cov + cov.mT)
            turn, bias = product(turn, exp(change[:, :3])), bias + change[:, 3:]
        state[:] = turn, bias, cov
        return turn

    return call


def eager(name: str) -> Callable[[], TensorDict]:
    """Returns a call that runs one row eagerly."""
    filter, row = FILTERS[name]()
    filter.initialise(row)

    def call() -> TensorDict:
        with torch.no_grad():
            return filter.step(row)

    return call


def first_call(name: str, chunk: int = 1) -> dict[str, float]:
    """Returns the seconds of a filter's first compiled sequence in this process, and then milliseconds per row."""
    filter, row = FILTERS[name]()
    filter.compile(chunk=chunk)
    log = torch.stack([row] * 200, 1)
    before, begun = os.times(), time.perf_counter()
    with torch.no_grad():
        filter.sequence(log.clone())
        wall, after, rounds = time.perf_counter() - begun, os.times(), []
        for _ in range(15):
            begun = time.process_time()
            filter.sequence(log.clone())
            rounds.append(1e3 * (time.process_time() - begun) / log.shape[1])
    return {"wall": wall, "processor": sum(after[:4]) - sum(before[:4]), "row": median(rounds)}


def rows(seconds: float) -> list[Row]:
    """Returns rows of the table."""
    calls: dict[str, Callable[[], object]] = {name: eager(name) for name in FILTERS}
    timings = interleave({**calls, "numpy": numpy_attitude()}, seconds=seconds)
    found = []
    for name in FILTERS:
        ms, wanted = timings.micro(name) / 1e3, WANTED_MS[SHORT[name]]
        note = "milliseconds, no ratio"
        found.append(Row(f"eager row, {SHORT[name]}, B=1, ms", ms, target=wanted, ours_us=1e3 * ms, note=note))
    found.append(timings.row("eager attitude EKF / numpy, B=1", "attitude", "numpy", target=4.0))
    if os.environ.get("SPEED_COMPILE") == "0":
        return found
    for name in FILTERS:
        with tempfile.TemporaryDirectory() as cache:
            command = [sys.executable, "-m", "benchmarks.speed.one_row", name]
            both = [
                json.loads(subprocess.run(command, env=env, check=True, capture_output=True, text=True).stdout)
                for env in [{**os.environ, "TORCHINDUCTOR_CACHE_DIR": cache}] * 2
            ]
        for which, run, wanted in zip(("empty cache", "second process"), both, WANTED_S, strict=True):
            note = (
                f"seconds, no ratio; processor time {run['processor']:.1f} s; then {run['row']:.3f} ms per row, chunk=1"
            )
            found.append(Row(f"first compiled call, {SHORT[name]}, {which}, s", run["wall"], target=wanted, note=note))
    return found


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(first_call(*sys.argv[1:2], *map(int, sys.argv[2:3]))))
