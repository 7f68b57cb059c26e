"""Filters with a monitor of their sensors, and filters with gating."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Unpack

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase, TensorDictSequential

from torch_denkf.filters.base import Filter
from torch_denkf.fusion.parts import StateObservation
from torch_denkf.modules.around import AugmentedBelief
from torch_denkf.monitoring.gate import GatedAnalysis, GateOptions, can_be_gated
from torch_denkf.monitoring.monitor import InnovationMonitor
from torch_denkf.running import check_module, in_sequences, is_sequence, named_modules_of, writes
from torch_denkf.submodel import Call, Entries, Sensor, SubModel, Update, role

__all__ = ["Gated", "Monitored"]


class Monitored(Filter):
    """Adds a monitor after a filter's analyses, which writes an alarm and its evidence in addition to the belief.

    It is a :class:`Filter` itself: steps, sequences, masks, resets, policies, transforms, replay buffers and compiled
    steps work as with any other. The belief equals that of the filter exactly. The modules are shared with the filter,
    not copied.

    Args:
        filter: the filter.
        monitor: monitor of the innovations, see :class:`~torch_denkf.monitoring.InnovationMonitor`.

    Raises:
        TypeError: if ``filter`` is no :class:`Filter`.
        KeyError: if the filter does not write an input of the monitor.
        ValueError: if the filter writes under the monitor's ``monitor_prefix`` already, as another monitor does.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> from torch_denkf.monitoring.monitor import MonitoredSensor
        >>> one = torch.eye(1)
        >>> kf = KalmanFilter(one, one, process_noise_cov=one, noise_cov=one, mean=torch.zeros(1), cov=one)
        >>> watched = Monitored(kf, InnovationMonitor({"gps": MonitoredSensor("info", 1)}))
        >>> reading = torch.zeros(9, 1).index_fill(0, torch.tensor([5, 6, 7, 8]), 50.0)  # the GPS jumps, and back
        >>> watched.sequence(TensorDict({"observation": reading}, [9]))["monitor", "alarm"].flatten().tolist()
        [False, False, False, False, False, True, True, True, True]
    """

    def __init__(self, filter: Filter, monitor: InnovationMonitor):
        _check_filter("Monitored", filter)
        check_module("monitor", monitor)
        read = [key for key in monitor.in_keys if key not in monitor.state_keys]
        written = filter.structure.out_keys
        missing = [key for key in map(unravel_key, read) if key not in written]
        if missing:
            raise KeyError(f"the monitor reads {missing}, which the filter does not write; it writes {written}")
        like = filter.like()
        modules = OrderedDict(named_modules_of(filter))
        taken = [key for key in monitor.state_keys if key in written]
        if taken:
            raise ValueError(
                f"the filter writes {taken[0]} already; give this monitor another name: monitor_prefix="
                f"{monitor.monitor_prefix + '2'!r}"
            )
        place = "monitor"
        while place in modules:
            place += "_"
        modules[place] = monitor if like is None else monitor.to(like.device, like.dtype)
        super().__init__(modules, initial=_with_state(filter.initial, [monitor]), **filter.options())
        self._place = place

    @property
    def monitor(self) -> InnovationMonitor:
        """Returns the monitor."""
        return self[self._place]

    def calibrate(self, clean: Sequence[TensorDictBase], **options) -> Monitored:
        """Calibrates the monitor on clean data, see :meth:`~torch_denkf.monitoring.InnovationMonitor.calibrate`.

        Args:
            clean: sequences ``[*B, T]`` that the filter can run on, not outputs.
            **options: arguments of the monitor's method.
        """
        self.monitor.calibrate([self.sequence(each.copy()) for each in clean], **options)
        return self


class Gated(Filter):
    """Gates each reading of a filter by the last normalised innovations.

    Each analysis is replaced by a :class:`~torch_denkf.monitoring.GatedAnalysis`. The result is a :class:`Filter`
    itself. :class:`Monitored` wraps it: ``Monitored(Gated(filter), monitor)``, with ``"gate"`` as the monitor's
    ``info_prefix``.

    Args:
        filter: filter of an ensemble, or of a mean and a covariance.
        observation_dim: number of components of the readings; by default that of the filter's noise models. For several
            analyses, a dict by their places.
        places: places of the analyses to gate; all by default. For different options, nest one ``Gated`` in another.
        **options: options of all gates, see :class:`~torch_denkf.monitoring.GateOptions`. With several gates the
            ``gate_prefix`` is followed by the analysis' place, ``"gate_camera"``, and by a number if a sequence in one
            place has several.

    Raises:
        TypeError: if the filter has no analysis that can be gated.
        ValueError: if the number of components is not known, an option is out of range, or ``adapt_inflation`` is used
            with a filter that observes states of the lag window, such as a :class:`FusedFilter` with a delay.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> plain = KalmanFilter(one, one, process_noise=[1.0], noise=[1.0], mean=torch.zeros(1), cov=one)
        >>> kf = Gated(plain, response="reject", window=1)
        >>> reading = torch.tensor([[0.0], [1.0], [90.0], [0.0]])
        >>> out = kf.sequence(TensorDict({"observation": reading}, [4]))
        >>> out["gate", "factor"].flatten().tolist(), out["belief", "mean"].abs().max() < 1
        ([0.0, 1.0, inf, 1.0], tensor(True))
    """

    def __init__(
        self,
        filter: Filter,
        observation_dim: int | Mapping[str, int] | None = None,
        *,
        places: Sequence[str] | None = None,
        **options: Unpack[GateOptions],
    ):
        _check_filter("Gated", filter)
        if options.get("adapt_inflation") and any(_with_past(part) for part in filter.modules()):
            raise ValueError(
                "adapt_inflation spreads the forecast of the step at which a reading is taken. A FusedFilter with "
                "delay=, or with lag= of a mean and a covariance, observes the past, too. Leave them out and put "
                "Refiltering(Gated(filter), ...) or FixedLag(Gated(filter), lag) around; or use adapt_noise."
            )
        modules = OrderedDict(named_modules_of(filter))
        found = [name for name, module in modules.items() if any(_analyses(module))]
        count = sum(1 for name in found for _ in _analyses(modules[name]))
        several = count + sum(isinstance(module, GatedAnalysis) for module in filter.modules()) > 1
        if places is not None:
            if unknown := [place for place in places if place not in found]:
                raise ValueError(f"places names {unknown}; the filter has analyses at {found}")
            found = list(places)
        if not found:
            raise TypeError(
                f"{type(filter).__name__} has no analysis that a gate goes around: EnsembleAnalysis, "
                "LocalEnsembleAnalysis, KalmanAnalysis, EKFAnalysis or UKFAnalysis."
            )
        key, gates = options.get("gate_prefix", "gate"), []
        for name in found:
            inside = list(_analyses(modules[name]))
            for number, analysis in enumerate(inside):
                own = observation_dim[name] if isinstance(observation_dim, Mapping) else observation_dim
                dim = _dim(filter, analysis) if own is None else own
                own_key = f"{key}_{name}" + (f"_{number}" if len(inside) > 1 else "")
                own_options: GateOptions = {**options, "gate_prefix": own_key if several else key}
                gates.append(GatedAnalysis(analysis, dim, **own_options))
                like = filter.like()
                gates[-1] = gates[-1] if like is None else gates[-1].to(like.device, like.dtype)
                modules[name] = _with(modules[name], analysis, gates[-1])
        super().__init__(modules, initial=_with_state(filter.initial, gates), **filter.options())

    @property
    def gates(self) -> list[GatedAnalysis]:
        """Returns the gated analyses, in order."""
        return [module for module in self.modules() if isinstance(module, GatedAnalysis)]

    def calibrate(self, clean: Sequence[TensorDictBase], **options) -> Gated:
        """Calibrates the gates on clean data, see :meth:`~torch_denkf.monitoring.GatedAnalysis.calibrate`.

        Args:
            clean: sequences ``[*B, T]`` that the filter can run on, not outputs. The gates are off meanwhile.
            **options: arguments of the gates' method.
        """
        rates = [gate.rate for gate in self.gates]
        for gate in self.gates:
            gate.rate = 0.0
        outputs = [self.sequence(each.copy()) for each in clean]
        for gate, rate in zip(self.gates, rates, strict=True):
            gate.rate = rate
            gate.calibrate(outputs, **options)
        return self


def _with_past(part: torch.nn.Module) -> bool:
    """Returns True if a module observes states of the lag window."""
    return isinstance(part, StateObservation) and part.state_dim is not None


def _check_filter(name: str, filter: object) -> None:
    if not isinstance(filter, Filter):
        raise TypeError(
            f"{name} goes around a torch_denkf Filter; got {type(filter).__name__}. A Refiltering goes outermost: "
            f"Refiltering({name}(filter, ...), ...)."
        )


def _analyses(module: TensorDictModuleBase) -> Iterator[Update]:
    """Yields the analyses in a filter's module that can be gated."""
    yield from filter(can_be_gated, in_sequences(module))


def _with(module: TensorDictModuleBase, old: SubModel, new: SubModel) -> TensorDictModuleBase:
    """Returns the module with ``old`` replaced by ``new``."""
    if not is_sequence(module):
        return new if module is old else module
    return TensorDictSequential(OrderedDict((name, _with(part, old, new)) for name, part in named_modules_of(module)))


def _dim(filter: Filter, analysis: Update) -> int:
    """Returns the number of components of an analysis' reading."""
    noise = set(map(unravel_key, analysis.reading_keys[1:]))
    for part in (part for _, module in filter.structure.modules for part in in_sequences(module)):
        dim = role(part, Sensor).observation_dim
        if dim is not None and not noise.isdisjoint(writes(part)):
            return dim
    try:
        found = analysis.reading_dims({}, Call(torch.Size()))[0]
        return found if isinstance(found, int) else found[-1]
    except KeyError:
        raise ValueError(
            f"how many components the reading of {type(analysis).__name__} has is not known; pass observation_dim"
        ) from None


def _with_state(initial: TensorDictModuleBase, owners: Sequence[InnovationMonitor | GatedAnalysis]) -> AugmentedBelief:
    """Augments an initial belief by the initial states of monitors and gates.

    Args:
        initial: the initial belief.
        owners: modules with a state, :class:`InnovationMonitor` and :class:`GatedAnalysis`.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import GaussianPrior
        >>> from torch_denkf.monitoring import InnovationMonitor, MonitoredSensor
        >>> monitor = InnovationMonitor({"gps": MonitoredSensor("info", 2)})
        >>> start = _with_state(GaussianPrior([0.0], [1.0], ensemble_size=4), [monitor])
        >>> start(TensorDict({}, [3]))["monitor", "gps", "p_value"].flatten()
        tensor([1., 1., 1.])
    """
    # The tuple keeps the owners from being registered twice: the filter has them already.
    keys = [key for owner in owners for key in owner.state_keys]
    return AugmentedBelief(initial, keys, partial(_states, tuple(owners)))


def _states(
    owners: Sequence[InnovationMonitor | GatedAnalysis], belief: Entries, batch_size: torch.Size
) -> list[torch.Tensor]:
    like = next(value for value in belief.values() if value.is_floating_point())
    states = (owner.initial_state(batch_size, device=like.device, dtype=like.dtype) for owner in owners)
    return [value for state in states for value in state]
