"""Describes both tasks, and the faults of a sensor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.modules import SubModel

#: Faults of a sensor, which no mask announces.
FAULTS = ("frozen", "offset", "noise")
STARTUP = 0.5  # seconds, in which the first readings come
FEATURE_STEPS = 5  # readings of which the spread is a feature


@dataclass(frozen=True)
class Task:
    """One task.

    Attributes:
        name: of the task.
        rate: of the filter's steps, in Hz.
        offsets: by sensor, bias of the fault "offset", in the reading's units.
        noises: by sensor, standard deviations of the readings.
        failing: sensors from which the faulty one of a training window is drawn; a repeated name is drawn more often.
        slope: of the weights before training, see :class:`~torch_denkf.fusion.SensorAttention`.
        updates: of the noise and of the weights.
        late: by sensor, additional latency in steps in the tests of delays.
        train: windows ``[N, T]`` on which noise and weights are trained.
        test: recordings ``[N, T]``.
        parts: the trainable modules of the noise.
        build: makes a filter of these from the network of its weights, and a flag that enables its model of delays.
        heeds: whether the usual filter models delays.
        loss: training loss of a filter's output.
        error: of a belief against the truth, ``[N, T, D]``, in ``unit``.
        unit: of the errors.
    """

    name: str
    rate: float
    offsets: dict[str, Tensor]
    noises: dict[str, Tensor]
    failing: tuple[str, ...]
    slope: float
    updates: tuple[int, int]
    late: dict[str, int]
    train: TensorDict
    test: TensorDict
    parts: nn.ModuleDict
    build: Callable[[nn.Module | None, bool], FusedFilter]
    heeds: bool
    loss: Callable[[TensorDict], Tensor]
    error: Callable[[TensorDict], Tensor]
    unit: str

    @property
    def sensors(self) -> list[str]:
        """Returns names of all sensors."""
        return list(self.offsets)

    @property
    def settled(self) -> slice:
        """Returns the scored steps: all but those of the start-up."""
        return slice(round(min(STARTUP * self.rate, self.test.shape[1] // 4)), None)


def fused_sensors(
    models: Mapping[str, SubModel], parts: Mapping[str, SubModel], delays: Mapping[str, int], weighted: bool, heed: bool
) -> dict[str, FusedSensor]:
    """Returns the sensors of a filter with their models and noises, and optionally with features and delays."""
    return {
        name: FusedSensor(
            model,
            parts[name],
            delay=delays[name] if heed else 0,
            late_key=f"{name}_late" if heed else None,
            features_key=f"{name}_features" if weighted else None,
        )
        for name, model in models.items()
    }


def without(data: TensorDict, *sensors: str) -> TensorDict:
    """Returns the recordings without some sensors' readings."""
    out = data.copy()
    for name in sensors:
        out[f"{name}_observed"] = torch.zeros_like(data[f"{name}_observed"])
    return out


def faulty(
    task: Task, data: TensorDict, sensor: str, fault: str, begin: Tensor, end: Tensor, generator: torch.Generator
) -> TensorDict:
    """Returns the recordings with an unmasked fault of one sensor from ``begin`` to ``end`` ``[N]``."""
    time = torch.arange(data.shape[1]).unsqueeze(0)
    bad = ((time >= begin.unsqueeze(-1)) & (time < end.unsqueeze(-1))).unsqueeze(-1)
    reading = data[sensor]
    if fault == "frozen":
        index = last_seen(data, sensor).gather(1, (begin - 1).clamp(min=0).reshape(-1, 1, 1))
        wrong = reading.gather(1, index.expand(-1, 1, reading.shape[-1])).expand_as(reading)
    elif fault == "offset":
        wrong = reading + task.offsets[sensor]
    else:
        wrong = reading + 10 * task.noises[sensor] * torch.randn(reading.shape, generator=generator)
    out = data.copy()
    out[sensor] = torch.where(bad, wrong, reading)
    return add_features(out, {sensor: task.noises[sensor]})


def delayed(data: TensorDict, sensor: str, steps: int) -> TensorDict:
    """Returns the recordings with one sensor's readings ``steps`` late."""
    out = data.copy()
    for key in (sensor, f"{sensor}_observed", f"{sensor}_features"):
        out[key] = data[key].roll(steps, 1)
    out[f"{sensor}_observed"][:, :steps] = False
    out[f"{sensor}_late"] = data[f"{sensor}_late"] + steps
    return out


def add_features(data: TensorDict, noises: Mapping[str, Tensor]) -> TensorDict:
    """Adds features ``NAME_features`` ``[N, T, O + 1]`` that detect a frozen or a noisy sensor.

    They are the logarithm of the mean change of each component over the last readings, in standard deviations, and the
    number of last readings that equal the present one exactly. Between readings the features stay the same.

    Args:
        data: recordings ``[N, T]``.
        noises: standard deviations of the readings of those sensors.
    """
    out = data.copy()
    for name, noise in noises.items():
        last = last_seen(data, name)
        index = last
        present = before = data[name].gather(1, index.expand_as(data[name]))
        spread, same = torch.zeros_like(present), torch.zeros_like(present[..., :1])
        still = torch.ones_like(same, dtype=torch.bool)
        for _ in range(FEATURE_STEPS):
            earlier = last.gather(1, (index - 1).clamp(min=0))
            # Before its first reading a sensor has not repeated itself.
            still = still & (earlier < index)
            index = earlier
            value = data[name].gather(1, index.expand_as(data[name]))
            still = still & (value == present).all(-1, keepdim=True)
            spread, same = spread + (before - value).abs() / FEATURE_STEPS, same + still
            before = value
        out[f"{name}_features"] = torch.cat([(spread / noise + 0.01).log(), same], -1)
    return out


def last_seen(data: TensorDict, sensor: str) -> Tensor:
    """Returns the step of a sensor's last reading at each time, ``[N, T, 1]``; 0 before the first."""
    seen = data[f"{sensor}_observed"]
    time = torch.arange(data.shape[1]).reshape(1, -1, 1).expand_as(seen)
    return torch.where(seen, time, 0).cummax(1).values
