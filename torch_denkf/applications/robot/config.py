"""robot_localization's YAML: which sensor reads what, covariances, and what cannot be honoured here."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from torch_denkf._checks import check_number

__all__ = ["PLANE", "Config", "SensorConfig", "read_config", "write_config"]

EXTRA = "pip install 'torch_denkf[ros]'"
_LASTS = 30.0  # s, that errors last of which nothing is said
#: States that are zero in the plane.
PLANE = (2, 3, 4, 8, 9, 10, 14)
_GROUPS = {"pose": range(6), "twist": range(6, 12), "acceleration": range(12, 15)}
_KINDS = {
    "odom": ("pose", "twist"),
    "pose": ("pose",),
    "twist": ("twist",),
    "imu": ("pose", "twist", "acceleration"),
}
_Q = (0.05, 0.05, 0.06, 0.03, 0.03, 0.06, 0.025, 0.025, 0.04, 0.01, 0.01, 0.02, 0.01, 0.01, 0.015)
#: Parameters that say nothing of what is estimated from a log.
_SILENT = re.compile(
    r"frequency|sensor_timeout|transform_.*|print_diagnostics|debug.*|publish_.*|use_sim_time|.*_frame|.*_queue_size|"
    r".*_nodelay|history_length|smooth_lagged_data|predict_to_current_time|permit_corrected_publication|.*_qos.*|"
    r"reset_on_time_jump|disabled_at_startup|diagnostics_.*|qos_overrides|imu\d+_remove_gravitational_acceleration"
)


@dataclass(frozen=True)
class SensorConfig:
    """One sensor.

    Attributes:
        name: such as ``odom0``.
        topic: of the bag, or the name of a stream of the log.
        groups: by ``pose``, ``twist`` and ``acceleration``: the states that are read.
        differential: whether changes of its poses are read as velocities.
        relative: whether its poses count from its first one.
        without_gravity: whether gravity is taken out of its accelerations.
        delay: by how many seconds its stamps are late.
        variances: of its readings, by state, where messages bring none; empty where they are not known.
        drifts: standard deviations of the slow errors of its readings, by state, 0 for none; that of a forward speed is
            of its scale. Empty for none.
        drift_time: seconds that they last, by state.
    """

    name: str
    topic: str
    groups: Mapping[str, tuple[int, ...]]
    differential: bool = False
    relative: bool = False
    without_gravity: bool = False
    delay: float = 0.0
    variances: tuple[float, ...] = ()
    drifts: tuple[float, ...] = ()
    drift_time: tuple[float, ...] = ()


@dataclass(frozen=True)
class Config:
    """Settings of an estimator.

    Attributes:
        sensors: in the order of their kinds and numbers.
        two_d: whether the robot moves in the plane.
        process_noise: covariance of a second, ``[15, 15]``.
        initial_cov: ``[15, 15]``.
        initial_state: ``[15]``.
        dynamic: whether the pose's process noise grows with the speed.
        gravity: m/s^2.
        frequency: Hz.
        held: whether velocities are means of the coming step, see :class:`~.motion.RobotMotion`.
        sigma: alpha, kappa and beta of the unscented filter.
        unheeded: what is not honoured, and why.
        given: the parameters as they were.
    """

    sensors: tuple[SensorConfig, ...]
    two_d: bool
    process_noise: np.ndarray
    initial_cov: np.ndarray
    initial_state: np.ndarray
    dynamic: bool
    gravity: float
    frequency: float
    held: bool
    sigma: tuple[float, float, float]
    unheeded: tuple[str, ...]
    given: Mapping[str, Any] = field(repr=False)


def read_config(config: Mapping[str, Any] | str | Path) -> Config:
    """Reads settings.

    Args:
        config: a file, or its content: parameters, or nodes with ``ros__parameters``, of which there is one.

    Raises:
        FileNotFoundError: without the file.
        ImportError: for a file, without PyYAML.
        ValueError: for lists of another length, or without a sensor.
    """
    given = config
    if isinstance(config, (str, Path)):
        try:
            import yaml
        except ImportError as error:
            raise ImportError(f"{config} is YAML, which needs PyYAML: {EXTRA}") from error
        path = Path(config).expanduser()
        if not path.is_file():
            raise FileNotFoundError(f"no configuration {path}; check the path")
        given = yaml.load(path.read_text("utf-8"), _numbers_of(yaml))
    if not isinstance(given, Mapping):
        raise ValueError(f"{config} holds no parameters by name; it is {type(given).__name__}")
    while len(given) == 1 and isinstance(next(iter(given.values())), Mapping):
        given = next(iter(given.values()))
    heeded = {"two_d_mode", "process_noise_covariance", "initial_estimate_covariance", "initial_state"}
    heeded |= {"dynamic_process_noise_covariance", "gravitational_acceleration", "alpha", "kappa", "beta"}
    heeded.add("held_velocities")
    sensors = []
    for name in given:
        if re.fullmatch(rf"({'|'.join(_KINDS)})\d+", name):
            sensors.append(_sensor(name, given))
            ends = ("", "_config", "_differential", "_relative", "_delay", "_variances", "_drifts", "_drift_time")
            heeded |= {name + end for end in ends}
    if not sensors:
        raise ValueError(
            f"{config} names no sensor, such as odom0: a topic, and odom0_config: fifteen of true and false"
        )
    unheeded = []
    for name, value in given.items():
        if name in heeded or _SILENT.fullmatch(name) or value in (False, None, [], ""):
            continue
        why = "put Gated(model.filter, ...) around the filter" if name.endswith("threshold") else "it is not known here"
        why = "there is no control here" if "control" in name or "celeration" in name else why
        unheeded.append(f"{name}: {why}")
    check_number("frequency", float(given.get("frequency", 30.0)), above=0)
    return Config(
        tuple(sensors),
        bool(given.get("two_d_mode", False)),
        _matrix("process_noise_covariance", given.get("process_noise_covariance", _Q)),
        _matrix("initial_estimate_covariance", given.get("initial_estimate_covariance", [1e-9] * 15)),
        _row("initial_state", given.get("initial_state", [0.0] * 15)),
        bool(given.get("dynamic_process_noise_covariance", False)),
        float(given.get("gravitational_acceleration", 9.80665)),
        float(given.get("frequency", 30.0)),
        bool(given.get("held_velocities", False)),
        (float(given.get("alpha", 0.001)), float(given.get("kappa", 0.0)), float(given.get("beta", 2.0))),
        tuple(unheeded),
        dict(given),
    )


def write_config(config: Config, path: Path, changed: Mapping[str, Any]) -> None:
    """Writes the parameters as they were given, except for some, for robot_localization to read.

    Raises:
        ImportError: without PyYAML.
    """
    try:
        import yaml
    except ImportError as error:
        raise ImportError(f"{path} is YAML, which needs PyYAML: {EXTRA}") from error
    parameters = {**config.given, **changed}
    text = yaml.safe_dump(
        {"ekf_filter_node": {"ros__parameters": parameters}}, default_flow_style=None, sort_keys=False
    )
    path.write_text(text, "utf-8")


def _sensor(name: str, given: Mapping[str, Any]) -> SensorConfig:
    chosen = given.get(f"{name}_config")
    if chosen is None or len(chosen) != 15:
        raise ValueError(f"{name}_config must be fifteen of true and false; got {chosen!r}")
    flags = [bool(each) for each in chosen]
    kind = name.rstrip("0123456789")
    groups = {group: tuple(place for place in _GROUPS[group] if flags[place]) for group in _KINDS[kind]}
    rows = {}
    for what in ("variances", "drifts"):
        values = given.get(f"{name}_{what}")
        rows[what] = () if values is None or not len(values) else tuple(_row(f"{name}_{what}", values).tolist())
    time = given.get(f"{name}_drift_time", _LASTS)
    time = _row(f"{name}_drift_time", [time] * 15 if np.ndim(time) == 0 else time).tolist()
    check_number(f"{name}_drift_time", min(time), above=0)
    return SensorConfig(
        name,
        str(given[name]),
        {group: places for group, places in groups.items() if places},
        bool(given.get(f"{name}_differential", False)),
        bool(given.get(f"{name}_relative", False)),
        bool(given.get(f"{name}_remove_gravitational_acceleration", False)),
        float(given.get(f"{name}_delay", 0.0)),
        **rows,
        drift_time=tuple(time),
    )


def _row(name: str, values: Any) -> np.ndarray:
    row = np.asarray(values, float).reshape(-1)
    if len(row) != 15:
        raise ValueError(f"{name} must be 15 numbers; got {len(row)}")
    return row


def _matrix(name: str, values: Any) -> np.ndarray:
    numbers = np.asarray(values, float).reshape(-1)
    if len(numbers) not in (15, 225):
        raise ValueError(f"{name} must be 15 numbers, or 15 rows of 15; got {len(numbers)}")
    return np.diag(numbers) if len(numbers) == 15 else numbers.reshape(15, 15)


def _numbers_of(yaml: Any) -> Any:
    """Returns a loader that reads 1e-3, which YAML 1.1 takes for text, as a number, as ROS does."""
    loader: Any = type("Loader", (yaml.SafeLoader,), {})
    pattern = re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$")
    loader.add_implicit_resolver("tag:yaml.org,2002:float", pattern, list("-+0123456789."))
    return loader
