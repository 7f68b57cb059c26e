r"""One base for all filters: a step on a tensordict, or a whole sequence with resets.

The order in time is predict, then update::

    belief[t-1] --transition--> forecast[t] --observation, analysis--> belief[t]
                                    ^ the sensor's reading of frame t

At a reset the forecast is the initial belief, and so is the belief unless ``update_at_reset``. Nothing is kept on
``self`` between steps: the belief lives in the tensordict.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from typing import Any, TypedDict

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs.transforms import Compose, TensorDictPrimer
from torchrl.modules.tensordict_module.rnn import recurrent_mode

from torch_denkf.filters._checks import (
    check_inputs,
    refuse_missing_actions,
    refuse_non_finite,
    refuse_two_precisions,
    refuse_unknown_noise,
    refuse_unknown_readings,
)
from torch_denkf.filters._compiled import CompiledSteps
from torch_denkf.filters._noise import draw_noise
from torch_denkf.filters._primer import LastAction, belief_primer
from torch_denkf.filters._said import say_eager, say_ignored_mask, say_once, say_up_to_date
from torch_denkf.filters._sequence import filter_rows
from torch_denkf.filters._slices import as_rows, starts_of
from torch_denkf.filters._steps import Steps, blank, previous_key, where_rows
from torch_denkf.filters._structure import Structure, submodels
from torch_denkf.filters._summaries import summaries
from torch_denkf.modules._base import Call, Entries, flat_noise, named_modules_of, reads, run_module

__all__ = ["Filter", "FilterOptions", "LastAction", "submodels", "where_rows"]

_KNOWN = ("previous", "known")


class FilterOptions(TypedDict, total=False):
    """What every filter's constructor takes beside its parts; see :class:`Filter`."""

    control_keys: Sequence[NestedKey]
    init_key: NestedKey
    update_at_reset: bool
    forecast_keys: Mapping[NestedKey, NestedKey] | None
    variance_ceiling: float | None
    check_finite: bool


class Filter(TensorDictSequential):
    """A Bayesian filter: TensorDict modules in sequence, and an initial belief.

    The modules are sorted once, by their keys: those that depend on the belief (transition, observation, analysis) are
    the step; the others (sensor, noise) read frames alone and, on a sequence, run once on all of them. The entries that
    the step reads before it writes them, and that ``initial`` provides, are the *carry*: ``("belief", "ensemble")`` for
    an ensemble, ``("belief", "mean")`` and ``("belief", "cov")`` for a Kalman filter.

    There are three ways to run it:

    * :meth:`step` in a loop: the carry in the tensordict is the belief at t-1, the frame that of t; afterwards the
      belief is that of t.
    * :meth:`sequence` on ``[*B, T]``, time last. Where an episode or a slice begins (``is_init``, or after a ``done``)
      the belief is the one that is stored there, which has seen that frame already, and the initial belief where none
      is stored. All other beliefs are one step on from their predecessor. Actions are read one step earlier, as torchrl
      stores them.
    * in a policy, behind :meth:`make_tensordict_primer`, like :class:`torchrl.modules.LSTMModule`: the belief at t-1
      comes under ``("previous", ...)``, that of t goes to ``("belief", ...)`` for the actor, and to
      ``("next", "previous", ...)`` for the next step. torchrl's losses, which turn its recurrent mode on, then filter
      the stored sequences; each begins with a step from the belief that is stored under ``("previous", ...)``.

    Args:
        modules: TensorDict modules in order, or one dict of them by name. The name (or number) of a module is its
            place; its noise is read from, and drawn to, ``("noise", place)``.
        initial: the initial belief, see :mod:`torch_denkf.modules.belief`.
        control_keys: entries that drive the transition *out of* the time they are stored at, by default the action.
        init_key: marks the first element of an episode, ``[*B, 1]`` bool, as written by
            :class:`torchrl.envs.InitTracker` and torchrl's ``SliceSampler``; one of its name in a group of agents
            counts, too.
        update_at_reset: whether the initial belief is updated with the first frame.
        forecast_keys: the forecast of each carried entry, where it cannot be told by its name.
        variance_ceiling: the belief's variances are held at it, so that an unstable system that nobody observes stays
            finite, with one warning; in the state's units squared. ``None`` for no ceiling.
        check_finite: whether :meth:`step` raises where the new belief is not finite.

    Raises:
        ValueError: if no module depends on what ``initial`` provides, or one module overwrites what another wrote
            before it is read.
        TypeError: if parameters or constants differ in precision.

    Example:
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> kf = KalmanFilter(one, one, one, one, mean=torch.zeros(1), cov=one)
        >>> kf.carry_keys
        [('belief', 'mean'), ('belief', 'cov')]
        >>> drives = TensorDict({"observation": torch.ones(4, 10, 1)}, [4, 10])
        >>> kf.sequence(drives)["belief", "mean"].shape
        torch.Size([4, 10, 1])
    """

    def __init__(
        self,
        *modules: TensorDictModuleBase | dict[str, TensorDictModuleBase],
        initial: TensorDictModuleBase,
        control_keys: Sequence[NestedKey] = ("action",),
        init_key: NestedKey = "is_init",
        update_at_reset: bool = False,
        forecast_keys: Mapping[NestedKey, NestedKey] | None = None,
        variance_ceiling: float | None = 1e12,
        check_finite: bool = True,
    ):
        if len(modules) == 1 and isinstance(modules[0], Mapping):
            modules = (OrderedDict(modules[0]),)
        super().__init__(*modules)
        self.initial = initial
        self.init_key = unravel_key(init_key)
        self.control_keys = [unravel_key(key) for key in control_keys]
        self.update_at_reset, self.forecast_keys = update_at_reset, dict(forecast_keys or {})
        self.variance_ceiling, self.check_finite = variance_ceiling, check_finite
        self.compiled: CompiledSteps | None = None
        self._said: set[str] = set()
        self._sorted_for: tuple = ()
        refuse_two_precisions(self)
        self._sort()

    @property
    def structure(self) -> Structure:
        """The modules by what they read; found anew where one of them has been replaced."""
        if self._sorted_for != (*_flat(self), self.initial, *self.control_keys):
            self._sort()
        return self._structure

    def _sort(self) -> None:
        """Sorts the modules, and says what they read and write."""
        structure = Structure.of(named_modules_of(self), self.initial, self.control_keys, self.forecast_keys)
        self._sorted_for, self._structure = (*_flat(self), self.initial, *self.control_keys), structure
        keys = [*structure.needed, *structure.controls, *structure.carry, *map(previous_key, structure.carry), _KNOWN]
        keys += [*map(previous_key, structure.controls), *structure.belief, self.init_key, *structure.optional]
        self.in_keys = list(dict.fromkeys(keys))
        of_start = [*map(unravel_key, self.initial.in_keys), *getattr(self.initial, "optional_keys", ())]
        self._all_keys = list(dict.fromkeys([*keys, *of_start]))
        self._step_keys = [*structure.needed, *structure.optional, *structure.controls, *structure.carry]
        self.out_keys = [*structure.frame_keys, *structure.step_keys]

    @property
    def carry_keys(self) -> list[NestedKey]:
        """The entries of the belief that go on from step to step."""
        return list(self.structure.carry)

    @property
    def belief_keys(self) -> list[NestedKey]:
        """All entries of the belief: the carry, and what follows from it."""
        return list(self.structure.belief)

    @property
    def log_likelihood_keys(self) -> list[NestedKey]:
        """The log-likelihoods that add up to that of all readings."""
        return list(self.structure.likelihoods)

    @property
    def frame_modules(self) -> list[TensorDictModuleBase]:
        """The modules that read frames alone, and not the belief."""
        return [module for _, module in self.structure.frames]

    @property
    def transition_module(self) -> TensorDictModuleBase:
        """The module that forecasts the carry: the first that depends on the belief."""
        return self.structure.transition[1]

    @property
    def update_modules(self) -> list[TensorDictModuleBase]:
        """The modules between the forecast and the belief."""
        return [module for _, module in self.structure.update]

    def __getitem__(self, index):
        """Returns one module, by number or name, or a plain ``TensorDictSequential`` of several."""
        if isinstance(index, str):
            return super().__getitem__(index)
        modules = list(self._module_iter())[index]
        return TensorDictSequential(*modules) if isinstance(index, slice) else modules

    def select_subsequence(self, in_keys=None, out_keys=None) -> TensorDictSequential:
        """Returns the modules between some keys; a part of a filter is a plain ``TensorDictSequential``."""
        return self[:].select_subsequence(in_keys, out_keys)

    def make_tensordict_primer(self) -> TensorDictPrimer | Compose:
        """Returns the transform that carries the belief where the filter is part of the policy.

        Like :meth:`torchrl.modules.LSTMModule.make_tensordict_primer`; where actions drive the filter, it also brings
        the last action (:class:`torch_denkf.transforms.LastAction`).
        """
        return belief_primer(self)

    def compile(self, *, chunk: int = 4, **options) -> Filter:
        """From now on runs steps, and sequences in chunks of steps, through ``torch.compile``.

        The first call of each kind (chunk, batch size, with or without gradients) compiles, later ones reuse that;
        copies and pickles of the filter compile anew. Noise is drawn outside, so a seed gives what it gives eagerly, up
        to rounding. Calls stay eager where the size of a noise is not known in advance, and in :meth:`predict` and
        ``step(without=...)``, which would compile anew for each reading that is lost; a warning says so once. On a
        policy's data they stay eager, too.

        Args:
            chunk: steps of a sequence in one compiled graph. What is left over after whole chunks runs step by step. A
                small chunk compiles sooner, a large one runs faster. 0 goes back to eager.
            **options: of ``torch.compile``. Without any, inductor on a processor writes what calls its kernels in C++,
                too, makes fewer calls, and saves fewer tensors for the backward pass, which takes longer to compile and
                about 40 % less to run; ``backend="inductor"`` alone leaves that out. On a GPU
                ``mode="reduce-overhead"`` asks for CUDA graphs.

        Returns:
            This filter.

        Raises:
            RuntimeError: if there is no C++ compiler, which processors need.
            ValueError: if ``chunk`` is negative.
        """
        if chunk < 0:
            raise ValueError(f"chunk is a number of steps, or 0 for none; got {chunk}.")
        self.compiled = CompiledSteps(chunk, options) if chunk else None
        return self

    # ----------------------------------------------------------------------------------------------- one step

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Takes one step, or filters a sequence in recurrent mode; writes into ``tensordict``."""
        if recurrent_mode():
            return self.sequence(tensordict)
        structure = self.structure
        entries = self.entries_of(tensordict)
        resumed = all(previous_key(key) in entries for key in structure.carry)
        refuse_missing_actions(structure, entries, resumed)
        for key in (*structure.carry, *structure.controls):
            if previous_key(key) in entries:
                entries[key] = entries[previous_key(key)]
        check_inputs(self, entries, tensordict)
        say_ignored_mask(self, tensordict)
        say_up_to_date(self, entries[structure.carry[0]])
        reset, known = starts_of(tensordict, self.init_key, step=True), entries.get(_KNOWN)
        if known is not None:
            known = known.reshape(*tensordict.batch_size, 1)
            reset = ~known if reset is None else reset | ~known
        call, steps = Call(tensordict.batch_size), self.steps()
        if reset is None:
            written = self.take_step(entries, tensordict.batch_size)
        else:
            written = steps.frames(entries, call)
            entries.update(written)
            start = self.initial_belief(entries, call)
            written.update(steps.advance(entries, call, reset, start))
            blank(steps, written, reset)
        write(tensordict, written)
        for key in structure.carry:
            tensordict.set(("next", *_path(previous_key(key))), written[key])
        some = written[structure.carry[0]]
        tensordict.set(("next", *_KNOWN), torch.ones(*tensordict.batch_size, 1, dtype=torch.bool, device=some.device))
        return tensordict

    def step(
        self, tensordict: TensorDictBase | Mapping[str, Any], *, without: Sequence[NestedKey] = ()
    ) -> TensorDictBase:
        """Predicts, then updates, on ``[*B]``: the carry in ``tensordict`` is the belief at t-1.

        Args:
            tensordict: carry, frame, and what else the modules read; the new belief is written there. A dictionary of
                numbers, arrays or tensors is one robot's, ``[]``, in the filter's precision; a number is an entry
                ``[1]``.
            without: keys of readings that are missing on purpose, or are of an earlier step: what reads them is left
                out, and the belief is the forecast unless another sensor has something to say.

        Returns:
            ``tensordict`` (of a dictionary, a new one), with the belief of t.

        Raises:
            KeyError: if an entry is missing, or ``without`` names what no module reads.
            ValueError: if the new belief is not finite, and ``check_finite``.
        """
        tensordict = self._of_one_robot(tensordict)
        without = refuse_unknown_readings(self.structure, without)
        entries = self.entries_of(tensordict, one_step=True)
        check_inputs(self, entries, tensordict, without)
        if without:
            say_eager(
                self,
                "predict() and step(without=...) leave readings out.",
                "Hide what is missing with a mask instead, which keeps the step compiled.",
            )
            call, steps, missing = Call(tensordict.batch_size), self.steps(), set(without)
            written = steps.frames(entries, call, missing)
            written.update(steps.advance({**entries, **written}, call, missing=missing))
            lost = [key for key in self.structure.carry if key in self.structure.step_keys and key not in written]
            if lost:
                raise KeyError(f"Without {list(without)} no module writes {lost}; give a mask that hides the reading.")
        else:
            say_ignored_mask(self, tensordict)
            written = self.take_step(entries, tensordict.batch_size)
        if self.check_finite and not torch.compiler.is_compiling():
            refuse_non_finite(self.structure, entries, written)
        write(tensordict, written)
        return tensordict

    def predict(self, tensordict: TensorDictBase | Mapping[str, Any]) -> TensorDictBase:
        """A step without any frame: the belief of t is the forecast. Takes and returns what :meth:`step` does."""
        tensordict = self._of_one_robot(tensordict)
        hidden = tensordict.copy()
        for key in dict.fromkeys(part.mask_key for part in submodels(self.module) if hasattr(part, "mask_key")):
            hidden.set(key, torch.zeros(*tensordict.batch_size, 1, dtype=torch.bool, device=tensordict.device))
        without = self.structure.readings
        out = self.step(hidden, without=without)
        written = [key for key in self.out_keys if out.get(key, None) is not None]
        return tensordict.update(out.select(*written))

    def take_step(self, entries: Entries, batch_size: torch.Size) -> Entries:
        """What one step writes where ``entries`` are, compiled or not; nothing is checked."""
        structure = self.structure
        steps = self.steps()
        if self.compiled is not None:
            drawn = draw_noise(self, entries, batch_size, (*structure.frames, structure.transition, *structure.update))
            if drawn is not None:
                written = self.compiled.step(steps, {**entries, **drawn}, batch_size)
                self._look_at_ceiling(written)
                return written
        call = Call(batch_size)
        written = steps.frames(entries, call)
        written.update(steps.advance({**entries, **written}, call))
        return written

    def initialise(
        self, tensordict: TensorDictBase | Mapping[str, Any], *, without: Sequence[NestedKey] = ()
    ) -> TensorDictBase:
        """Writes the belief at the start of an episode, for every row of ``tensordict`` ``[*B]``.

        Args:
            tensordict: what the initial belief reads, see :mod:`torch_denkf.modules.belief`.
            without: keys of readings that have not come yet. :class:`~torch_denkf.modules.FromSensor` then starts from
                its prior.

        Raises:
            KeyError: if an entry is missing, or ``without`` names what no module reads.
        """
        tensordict = self._of_one_robot(tensordict)
        entries, call, structure = self.entries_of(tensordict), Call(tensordict.batch_size), self.structure
        missing = set(refuse_unknown_readings(structure, without))
        frame_keys, written = set(structure.frame_keys), {}
        if self.update_at_reset or not frame_keys.isdisjoint(chain(*reads(self.initial))):
            written = self.steps().frames(entries, call, missing)
            entries.update(written)
        entries = {key: value for key, value in entries.items() if key not in missing}
        start = self.initial_belief(entries, call._replace(missing=frozenset(missing)))
        if self.update_at_reset:
            written.update(self.steps().first(entries, call, start, in_sequence=False, missing=missing))
        else:
            written.update(start)
            written.update({forecast: start[key] for key, forecast in structure.forecast_of.items()})
        write(tensordict, written)
        return tensordict

    def summarise(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the other entries of the belief, e.g. mean and variance, from its carry."""
        carry = {key: tensordict.get(key) for key in self.structure.carry}
        write(tensordict, summaries(carry, self.structure.belief))
        return tensordict

    # --------------------------------------------------------------------------------------------- a sequence

    def draw_noise(self, tensordict: TensorDictBase, *, generator: torch.Generator | None = None) -> TensorDictBase:
        """Writes the noise that the modules will need on ``tensordict`` (one step or a sequence), drawn in bulk.

        Noise that is there already is kept. Noise that depends on a size which only the step knows is drawn there.
        """
        entries, size, structure = self.entries_of(tensordict), tensordict.batch_size, self.structure
        modules = (*structure.frames, structure.transition, *structure.update, ("initial", self.initial))
        drawn = draw_noise(self, entries, size, modules, time=len(size) > 0, generator=generator, as_far_as_known=True)
        write(tensordict, drawn or {})
        return tensordict

    def sequence(
        self,
        tensordict: TensorDictBase,
        *,
        detach_every: int | None = None,
        keep: Sequence[NestedKey] | None = None,
    ) -> TensorDictBase:
        """Filters a sequence ``[*B, T]`` and writes what a step writes, for every time.

        Slices of one length in a flat ``[N]``, as torchrl's ``SliceSampler`` returns them, are filtered side by side
        where their beginnings are marked.

        Args:
            tensordict: frames, and optionally ``is_init``, actions, masks, noise, and stored beliefs (see the class).
            detach_every: truncates back-propagation through time: the belief is detached every so many steps.
            keep: the outputs to write; all by default. Ensembles of long sequences are large.

        Returns:
            ``tensordict``, with the outputs.

        Raises:
            ValueError: if there is no time dimension, no step, or ``keep`` names what the filter does not write.
            KeyError: if an entry is missing.
        """
        size = tensordict.batch_size
        if not size or not size[-1]:
            raise ValueError(
                "A sequence has time as its last batch dimension, and at least one step; this tensordict has "
                f"batch_size {list(size)}."
            )
        self.structure  # noqa: B018 - sorts the modules anew where one has been replaced
        keep = list(self.out_keys) if keep is None else [unravel_key(key) for key in keep]
        unknown = [key for key in keep if key not in self.out_keys]
        if unknown:
            raise ValueError(f"keep names {unknown}; the filter writes {list(self.out_keys)}.")
        new = starts_of(tensordict, self.init_key)
        rows, new = as_rows(tensordict, new)
        outputs = filter_rows(self, rows, new, detach_every, keep)
        if self.compiled is not None:
            self._look_at_ceiling(outputs)
        if rows is not tensordict:
            outputs = {key: value.flatten(0, 1) for key, value in outputs.items()}
        write(tensordict, {key: outputs[key] for key in keep})
        return tensordict

    def stepped(self, tensordict: TensorDictBase) -> Tensor:
        """``False`` for elements that hold an initial or stored belief, ``[*B, T]``; see :meth:`sequence`."""
        size = tensordict.batch_size
        new, first = starts_of(tensordict, self.init_key), torch.zeros(size, dtype=torch.bool, device=tensordict.device)
        first[..., 0] = True
        new = first if new is None else first | new.reshape(size)
        if all(tensordict.get(previous_key(key), None) is not None for key in self.structure.carry):
            known = tensordict.get(_KNOWN, None)  # a policy's data: every element with a belief before it is a step
            return torch.ones_like(new) if known is None else known.reshape(size)
        return ~new

    # -------------------------------------------------------------------------------------------------- helpers

    def like(self) -> Tensor | None:
        """A tensor of the filter's precision and device; ``None`` where it has no parameters or constants."""
        return next((p for p in chain(self.parameters(), self.buffers()) if p.is_floating_point()), None)

    def steps(self, update_at_reset: bool | None = None) -> Steps:
        """What one step does, on entries; ``update_at_reset`` as the filter's by default."""
        update_at_reset = self.update_at_reset if update_at_reset is None else update_at_reset
        return Steps(self._structure, update_at_reset, self.variance_ceiling, self._say_ceiling)

    def entries_of(self, tensordict: TensorDictBase, *, one_step: bool = False) -> Entries:
        """What the modules may read, as far as it is there; for ``one_step`` not what starts a sequence."""
        self.structure  # noqa: B018 - sorts the modules anew where one has been replaced
        entries = {}
        for key in self._step_keys if one_step else self._all_keys:
            value = tensordict.get(key, None)
            if value is not None:
                entries[key] = value
        noise = flat_noise(tensordict.get("noise", None))
        if noise:
            refuse_unknown_noise(self, noise)
            entries.update(noise)
        return entries

    def initial_belief(self, entries: Entries, call: Call) -> Entries:
        """The belief at the start of an episode."""
        belief = self.structure.belief
        hidden = {key: value for key, value in entries.items() if key not in belief}
        return summaries(run_module(self.initial, hidden, call.part("initial")), belief)

    def _of_one_robot(self, tensordict: TensorDictBase | Mapping[str, Any]) -> TensorDictBase:
        if isinstance(tensordict, TensorDictBase):
            return tensordict
        like = self.like()
        out = TensorDict(dict(tensordict), batch_size=[])
        out = out.apply(lambda value: value.reshape(1) if value.ndim == 0 else value)  # a number is an entry of one
        if like is None:
            return out
        return out.apply(lambda value: value.to(like.device, like.dtype if value.is_floating_point() else None))

    def _look_at_ceiling(self, written: Entries) -> None:
        """Says whether a variance is held at its ceiling, where a compiled graph could not."""
        if self.variance_ceiling is None or "ceiling" in self._said or torch.compiler.is_compiling():
            return
        for key in self.steps().variance_keys():
            value = written.get(key)
            if value is not None and not value.is_cuda and (value >= 0.999 * self.variance_ceiling).any():
                self._say_ceiling(key)

    def _say_ceiling(self, key: NestedKey) -> None:
        say_once(
            self,
            "ceiling",
            f"The variance in {key!r} has reached variance_ceiling={self.variance_ceiling:g} and is held there: "
            "nothing observes what grows.",
        )


def _flat(sequence: TensorDictSequential) -> Iterator[Any]:
    """The modules of a filter, and those of the plain sequences among them."""
    for module in sequence._modules["module"]._modules.values():
        yield module
        if type(module) is TensorDictSequential:
            yield from _flat(module)


def write(tensordict: TensorDictBase, written: Entries) -> None:
    """Sets entries, looking up each nested tensordict once."""
    owners: dict[tuple, Any] = {}
    for key, value in written.items():
        prefix = () if isinstance(key, str) else key[:-1]
        owner = tensordict if not prefix else owners.get(prefix)
        if owner is None:
            owner = tensordict.get(prefix, None) if type(tensordict) is TensorDict else None
        if isinstance(owner, TensorDictBase):
            owners[prefix] = owner
            owner.set(key[-1] if prefix else key, value)
        else:  # not there yet
            tensordict.set(key, value)


def _path(key: NestedKey) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key
