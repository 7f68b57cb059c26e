"""Stage of a training: loss, batches, parameters, number of updates and learning rate."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torch.optim.lr_scheduler import CosineAnnealingLR, LambdaLR, LRScheduler, OneCycleLR

from torch_denkf._checks import check_count, check_number

__all__ = ["Stage", "parameters_without"]

_SCHEDULES = ("one_cycle", "cosine", "constant")


@dataclass(frozen=True, eq=False)
class Stage:
    """Stage of a training: AdamW on some parameters of a model, all others frozen.

    Args:
        name: letters, digits, ``_`` and ``-``; it names files and log entries.
        loss: maps a batch to a mapping (a tensordict, a dict) of scalars. Those whose name starts with ``"loss"`` are
            summed and minimised; the others are logged only. Any torchrl loss module will do.
        sample: ``sample(generator, length)`` draws a training batch. All its randomness must come from the generator
            (on the CPU), so that a resumed training has the same batches. ``length`` is from ``lengths``, or ``None``.
        updates: number of optimiser steps.
        parameters: parameters to train, or groups of torch's optimisers, ``[{"params": ..., "lr": ...}, ...]``. By
            default all parameters of ``loss`` (if that is a module, else of the trainer's model) that require
            gradients.
        frozen: names of modules of the model (places of a filter) to freeze, such as ``["camera_sensor"]``. On its
            training data a sensor that overfits is too accurate, so that noise learned there is too small: freeze the
            sensor, and learn the noise on other episodes.
        lr: learning rate; the peak for ``"one_cycle"``, the start for ``"cosine"``.
        weight_decay: weight decay of AdamW, per unit of learning rate.
        schedule: ``"one_cycle"``, ``"cosine"`` (to zero), ``"constant"``, or ``schedule(optimiser, updates)``, which
            returns one of torch's schedulers; it is stepped after each update.
        clip: largest norm of the gradient; ``None`` for no limit.
        lengths: sequence lengths, ``{from_update: length}``, e.g. ``{0: 4, 500: 16}``: short ones first.
        validate: replaces the trainer's, e.g. for training a sensor alone.
        monitor: replaces the trainer's.

    Raises:
        ValueError: for an invalid name, no updates, an unknown schedule, or lengths without update 0.
        TypeError: if ``frozen`` is a name instead of a list.

    Example:
        >>> from tensordict import TensorDict
        >>> net = nn.Linear(1, 1)
        >>> loss = lambda batch: {"loss_fit": (net(batch["x"]) - 2.0).square().mean()}
        >>> sample = lambda generator, length: TensorDict({"x": torch.rand(8, length, 1, generator=generator)}, [8])
        >>> stage = Stage("fit", loss, sample, updates=100, lengths={0: 4, 50: 16})
        >>> [stage.length(update) for update in (0, 49, 50)]
        [4, 4, 16]
    """

    name: str
    loss: Callable[[TensorDictBase], Mapping[str, torch.Tensor]]
    sample: Callable[[torch.Generator, int | None], TensorDictBase]
    updates: int
    parameters: Iterable[nn.Parameter] | Iterable[dict] | None = None
    lr: float = 2e-3
    weight_decay: float = 0.0
    schedule: str | Callable[[torch.optim.Optimizer, int], LRScheduler] = "one_cycle"
    clip: float | None = 1.0
    lengths: Mapping[int, int] | None = None
    validate: Callable[[], Mapping[str, float]] | None = None
    monitor: str | None = None
    frozen: Iterable[str] = ()

    def __post_init__(self):
        if not isinstance(self.name, str) or not re.fullmatch(r"[\w-]+", self.name):
            raise ValueError(f"A stage's name names files: letters, digits, _ and - only; got {self.name!r}.")
        check_count(f"updates of stage {self.name!r}", self.updates)
        check_number(f"lr of stage {self.name!r}", self.lr, above=0)
        check_number(f"weight_decay of stage {self.name!r}", self.weight_decay, least=0)
        if self.clip is not None:
            check_number(f"clip of stage {self.name!r}", self.clip, above=0, cure="None is for no limit")
        if not callable(self.schedule) and self.schedule not in _SCHEDULES:
            raise ValueError(f"Stage {self.name!r}: schedule is one of {_SCHEDULES} or a function; {self.schedule!r}.")
        if self.lengths is not None and not isinstance(self.lengths, Mapping):
            raise TypeError(f"Stage {self.name!r}: lengths map updates to lengths, {{0: 4}}; got {self.lengths!r}.")
        for length in (self.lengths or {}).values():
            check_count(f"one of the lengths of stage {self.name!r}", length)
        if self.lengths is not None and 0 not in self.lengths:
            raise ValueError(f"Stage {self.name!r}: lengths {dict(self.lengths)} lack the length from update 0 on.")
        if isinstance(self.frozen, str):
            raise TypeError(f"Stage {self.name!r}: frozen is a list of names, [{self.frozen!r}].")
        object.__setattr__(self, "frozen", tuple(self.frozen))
        if self.parameters is not None:  # generators could be used only once
            parameters = [
                {**entry, "params": list(entry["params"])} if isinstance(entry, dict) else entry
                for entry in self.parameters
            ]
            object.__setattr__(self, "parameters", parameters)

    def length(self, update: int) -> int | None:
        """Returns the sequence length of an update, counted from zero; ``None`` without ``lengths``."""
        if self.lengths is None:
            return None
        return self.lengths[max(start for start in self.lengths if start <= update)]

    def groups(self, model: nn.Module) -> list[dict]:
        """Returns the trained parameters as an optimiser's groups.

        Raises:
            ValueError: if there are none, or ``model`` lacks some, which checkpoints would miss.
        """
        given: list[Any]
        if self.parameters is None:
            source = self.loss if isinstance(self.loss, nn.Module) else model
            given = [parameter for parameter in source.parameters() if parameter.requires_grad]
        else:
            given = list(self.parameters)
        groups = given if given and isinstance(given[0], dict) else [{"params": given}]
        groups = [dict(group) for group in groups]  # the optimiser adds its settings to them
        if self.frozen:
            frozen = {*map(id, model.parameters())} - {*map(id, parameters_without(model, self.frozen))}
            for group in groups:
                group["params"] = [parameter for parameter in group["params"] if id(parameter) not in frozen]
        trained, held = [p for group in groups for p in group["params"]], {id(p) for p in model.parameters()}
        if not trained:
            raise ValueError(f"Stage {self.name!r} has no parameters to train; give parameters=...")
        strange = sum(id(parameter) not in held for parameter in trained)
        if strange:
            raise ValueError(
                f"Stage {self.name!r} trains {strange} parameters that the trainer's model does not hold, so that its "
                "checkpoints would lose them; give the trainer a model that holds them, e.g. an nn.ModuleList."
            )
        return groups

    def optimiser(self, groups: list[dict]) -> tuple[torch.optim.Optimizer, LRScheduler]:
        """Returns AdamW for :meth:`groups`, and its schedule."""
        optimiser = torch.optim.AdamW(groups, lr=self.lr, weight_decay=self.weight_decay)
        if callable(self.schedule):
            return optimiser, self.schedule(optimiser, self.updates)
        if self.schedule == "one_cycle":
            peaks = [group["lr"] for group in optimiser.param_groups]
            return optimiser, OneCycleLR(optimiser, peaks, total_steps=self.updates)
        if self.schedule == "cosine":
            return optimiser, CosineAnnealingLR(optimiser, self.updates)
        return optimiser, LambdaLR(optimiser, lambda update: 1.0)

    def settings(self, model: nn.Module) -> dict:
        """Returns the settings that must equal those of a checkpoint to resume; plain values."""
        names = {id(parameter): name for name, parameter in model.named_parameters()}
        schedule = self.schedule if isinstance(self.schedule, str) else getattr(self.schedule, "__qualname__", "custom")
        return {
            "name": self.name,
            "updates": self.updates,
            "lr": self.lr,
            "weight_decay": self.weight_decay,
            "schedule": schedule,
            "clip": self.clip,
            "lengths": None if self.lengths is None else dict(sorted(self.lengths.items())),
            "parameters": [[names[id(p)] for p in group["params"]] for group in self.groups(model)],
        }


def why_no_gain(stage: Stage, first: float, value: float, update: int) -> str:
    """Returns advice for a stage that lowered the error by less than 1 %, else an empty text.

    Args:
        stage: the stage.
        first: the monitored error before its first update.
        value: the best error.
        update: number of updates at the best error.

    Example:
        >>> why_no_gain(Stage("whole", dict, dict, 100, lengths={0: 6}), 2.0, 2.0, 0)[:67]
        "Stage 'whole' gained nothing: the error is 2 as before it. Likely: "
    """
    if not first - value < 0.01 * abs(first):
        return ""
    said = f"made the error worse, {first:.4g} to {value:.4g}" if value > first else "gained nothing: the error is "
    if value <= first:
        said += f"{value:.4g} as before it" if update == 0 else f"{value:.4g}, and {first:.4g} before it"
    causes = [f"lr={stage.lr:g} is too high" if update == 0 or value > first else f"lr={stage.lr:g} is too low"]
    if stage.lengths is not None:
        longest = max(stage.lengths.values())
        causes.append(f"windows of {longest} steps are too short to show what the filter does later")
    causes.append("the loss and the validation ask for different things, or the training batches are learned by heart")
    return f"Stage {stage.name!r} {said}. Likely: {'; '.join(causes)}."


@contextmanager
def only_trainable(model: nn.Module, parameters: Iterable[nn.Parameter]) -> Iterator[None]:
    """Freezes all of ``model`` except ``parameters``, and restores ``requires_grad`` afterwards."""
    before = [(parameter, parameter.requires_grad) for parameter in model.parameters()]
    trained = {id(parameter) for parameter in parameters}
    try:
        for parameter, _ in before:
            parameter.requires_grad_(id(parameter) in trained)
        yield
    finally:
        for parameter, flag in before:
            parameter.requires_grad_(flag)
            parameter.grad = None


def parameters_without(model: nn.Module, names: Iterable[str]) -> list[nn.Parameter]:
    """Returns the parameters of a filter without those of some of its modules.

    Args:
        model: a filter, or another model with named modules.
        names: names of the modules to leave out, as in ``model[name]``.

    Returns:
        the parameters, in the model's order.

    Raises:
        KeyError: if the model has no module of a name.

    Example:
        >>> from tensordict.nn import TensorDictModule, TensorDictSequential
        >>> from collections import OrderedDict
        >>> line = lambda: TensorDictModule(nn.Linear(1, 1), ["x"], ["x"])
        >>> model = TensorDictSequential(OrderedDict(sensor=line(), noise=line()))
        >>> len(parameters_without(model, ["noise"])), len(parameters_without(model, []))
        (2, 4)
    """
    names = list(names)
    modules = dict([*model.named_children(), *getattr(model, "module", model).named_children()])
    strange = sorted(set(names) - modules.keys())
    if strange:
        raise KeyError(f"the filter has no module {strange}; it has {list(modules)}.")
    left_out = {id(parameter) for name in names for parameter in modules[name].parameters()}
    return [parameter for parameter in model.parameters() if id(parameter) not in left_out]
