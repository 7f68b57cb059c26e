r"""Base class of all filters: runs a step on a tensordict, or a whole sequence with resets.

The order in time is predict, then update::

    belief[t-1] --transition--> forecast[t] --observation, analysis--> belief[t]
                                    ^ the sensor's reading of frame t

Nothing is kept on ``self`` between steps: the belief lives in the tensordict.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from itertools import chain
from typing import Any, Unpack, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import TensorDictPrimer
from torchrl.modules import set_recurrent_mode
from torchrl.modules.tensordict_module.rnn import recurrent_mode

from torch_denkf._arguments import Checked, check_arguments
from torch_denkf._checks import check_count
from torch_denkf._registered import compiler, diagnosis, primers
from torch_denkf._slices import as_rows, device_of, starts_of
from torch_denkf.filters.finish import RUNS, Record, check_belief, own
from torch_denkf.filters.gather import gather_rows, of_one_robot
from torch_denkf.filters.noise import Draws
from torch_denkf.filters.options import FilterOptions
from torch_denkf.filters.scan import Steps, where_rows
from torch_denkf.filters.structure import HAS_PREVIOUS, Structure, previous_key
from torch_denkf.modules.variance_ceiling import VarianceCeiling
from torch_denkf.running import check_module, named_modules_of, reads, run_module
from torch_denkf.submodel import Call, Entries, Initial, Transition, flat_noise, in_role, role

__all__ = ["Filter"]

#: Called with each run of a filter before anything is written; it may warn, count, or raise.
Observer = Callable[["Filter", Record], None]


class Filter(Checked, TensorDictSequential):
    """A Bayesian filter: TensorDict modules in sequence, and an initial belief.

    The modules are sorted once, by their keys: those that depend on the belief (transition, observation, analysis) are
    the step; the others (sensor, noise) read only frames and, on a sequence, run once on all of them. The entries that
    the step reads before it writes them, and that ``initial`` provides, are the *carry*: ``("belief", "ensemble")`` for
    an ensemble, ``("belief", "mean")`` and ``("belief", "cov")`` for a Kalman filter.

    There are three ways to run it:

    * :meth:`step` in a loop: the tensordict has the belief at t-1 (the carry) and the frame of t; the step replaces
      that belief by the belief at t.
    * :meth:`sequence` on ``[*B, T]``, time last. At the first element of an episode or a slice (``is_init``, or after a
      ``done``) the belief is the stored one, which has seen that frame already, or the initial belief if none is
      stored. Each later belief is one step on from its predecessor. Actions are read one step earlier, as torchrl
      stores them.
    * in a policy, with :meth:`make_tensordict_primer`, like :class:`torchrl.modules.LSTMModule`: the belief at t-1 is
      read from ``("previous", ...)``, that of t is written to ``("belief", ...)`` for the actor, and to
      ``("next", "previous", ...)`` for the next step. In torchrl's recurrent mode, which its losses turn on, the filter
      runs over the stored sequences. Each begins with a step from the belief stored under ``("previous", ...)``, and
      ``("next", "previous", ...)`` is not overwritten.

    Args:
        modules: TensorDict modules in order, or one dict of them by name. The name (or number) of a module is its
            place; its noise is read from and written to ``("noise", place)``.
        initial: the initial belief, see :mod:`torch_denkf.modules.belief`.
        control_keys: entries that drive the transition *out of* the time at which they are stored, by default the
            action.
        init_key: marks the first element of an episode, ``[*B, 1]`` bool, as written by
            :class:`torchrl.envs.InitTracker` and torchrl's ``SliceSampler``; an entry of the same name in a group of
            agents marks it, too.
        update_at_reset: whether the initial belief is updated with the first frame.
        forecast_keys: the forecast of each carried entry, if the names are ambiguous.
        variance_ceiling: upper bound of the belief's variances, in the state's units squared, which keeps an unstable
            and unobserved system finite; the first clamped variance warns. ``None`` for no ceiling.
        check_finite: whether a step raises if its new belief is not finite, and any run if the noise of a reading
            is no covariance. In a sequence a belief that diverges stays NaN to the end, and one warning names the
            cause. Readings are checked, or rejected, by ``torch_denkf.imperfect.RejectReadings`` in front of the
            filter. A GPU skips these checks, for which each step would have to wait.
        keep_noise: whether a step in a policy writes the noise that it drew, under ``("drawn", place)``. Recurrent mode
            then filters the collected data with the same draws, so that the policy's probabilities equal those at
            collection until its parameters change.
        prefix: first name of the keys of all outputs, carried entries and noise of the filter: with ``"imu"`` the
            mean is ``("imu", "belief", "mean")``. Two filters of one environment or policy need one. ``None`` for none.

    Raises:
        ValueError: if no module depends on the outputs of ``initial``, or one module overwrites the output of another
            before it is read; or if ``prefix`` is ``"next"``.
        TypeError: if parameters or constants differ in precision.

    Example:
        >>> from torch_denkf.filters import KalmanFilter
        >>> from tensordict import TensorDict
        >>> one = torch.eye(1)
        >>> kf = KalmanFilter(one, one, process_noise_cov=one, noise_cov=one, mean=torch.zeros(1), cov=one)
        >>> kf.carry_keys
        [('belief', 'mean'), ('belief', 'cov')]
        >>> drives = TensorDict({"observation": torch.ones(4, 10, 1)}, [4, 10])
        >>> kf.sequence(drives)["belief", "mean"].shape
        torch.Size([4, 10, 1])

        torch's forward hooks run in each step, also of a sequence, in an environment or a policy. A compiled filter
        skips hooks that are registered after compilation; ``filter.compile(chunk=0)`` makes it eager again:

        >>> innovations = []
        >>> look = lambda module, read, out: innovations.append(out["info", "innovation"])
        >>> hook = kf["analysis"].register_forward_hook(look)
        >>> _ = kf.sequence(drives)
        >>> hook.remove()
        >>> len(innovations), innovations[0].shape
        (10, torch.Size([4, 1]))
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
        keep_noise: bool = True,
        prefix: str | None = None,
    ):
        if len(modules) == 1 and isinstance(modules[0], Mapping):
            modules = (OrderedDict(modules[0]),)
            for name, part in modules[0].items():
                check_module(str(name), part)
        else:
            for number, part in enumerate(modules):
                check_module(f"modules[{number}]", part)
        check_module("initial", initial)
        super().__init__(*modules)
        self.initial = initial
        fixed = {"update_at_reset": update_at_reset, "variance_ceiling": variance_ceiling, "prefix": prefix}
        self._set_options(control_keys, init_key, forecast_keys, check_finite, keep_noise, **fixed)
        self.compiled: Any = None
        #: Called with the filter and a :class:`Record` of each run, before anything is written.
        self.observers: list[Observer] = diagnosis().default_observers()
        diagnosis().check_precision(self)
        self._sort()

    def _set_options(self, control_keys, init_key, forecast_keys, check_finite, keep_noise, **fixed: Any) -> None:
        if fixed["prefix"] == "next":
            raise ValueError('prefix="next" is reserved by torchrl for the next step: give the filter another prefix')
        self.init_key, self.control_keys = unravel_key(init_key), list(control_keys)
        self.forecast_keys, self.check_finite, self.keep_noise = dict(forecast_keys or {}), check_finite, keep_noise
        self.fixed_options = fixed

    def _sort(self) -> None:
        """Sorts the modules, and caches the keys that each run reads and writes."""
        modules = named_modules_of(self)
        controls = [unravel_key(key) for key in self.control_keys]
        structure = Structure.of(modules, self.initial, controls, self.forecast_keys)
        diagnosis().check_composition(modules, structure)
        if self.variance_ceiling is not None:
            ceiling = VarianceCeiling(structure.kinds, structure.belief, self.variance_ceiling)
            structure = structure._replace(posterior=(*structure.update, ("variance_ceiling", ceiling)))
        self.structure, self.steps = structure, Steps(structure, self.update_at_reset)
        self.draws, written = Draws(self), structure.out_keys
        self._own_keys = {*written, *map(unravel_key, self.initial.out_keys)}
        self.in_keys = [self.outer(key) for key in structure.in_keys(self.init_key)]
        self.out_keys = [self.outer(key) for key in written]
        self._noise_key, self._drawn_key = self.outer("noise"), self.outer("drawn")
        self.keeps_noise = self.keep_noise and bool(self.draws.places)
        self.in_keys += [self._drawn_key] * self.keeps_noise
        everything = [*structure.in_keys(self.init_key), *chain(*reads(self.initial))]
        a_step = [*structure.needed, *structure.optional, *structure.controls, *structure.carry]
        self._all_keys, self._step_keys = ({key: self.outer(key) for key in keys} for keys in (everything, a_step))

    @property
    def update_at_reset(self) -> bool:
        """Tells whether the initial belief is updated with the first frame."""
        return self.fixed_options["update_at_reset"]

    @property
    def variance_ceiling(self) -> float | None:
        """Returns the ceiling of the belief's variances."""
        return self.fixed_options["variance_ceiling"]

    @property
    def prefix(self) -> str | None:
        """Returns the prefix of the filter's own keys."""
        return self.fixed_options["prefix"]

    def with_options(self, **options: Unpack[FilterOptions]) -> Filter:
        """Returns a filter of the same modules with other options, see the class.

        Raises:
            TypeError: if there is no such option, or it has the wrong type.
            ValueError: if an option is out of range.

        Example:
            >>> from torch_denkf.filters import KalmanFilter
            >>> one = torch.eye(1)
            >>> kf = KalmanFilter(one, one, process_noise_cov=one, noise_cov=one, mean=torch.zeros(1), cov=one)
            >>> kf.with_options(prefix="imu").carry_keys
            [('imu', 'belief', 'mean'), ('imu', 'belief', 'cov')]
        """
        names = [*FilterOptions.__annotations__]
        unknown = [name for name in options if name not in names]
        if unknown:
            raise TypeError(f"{type(self).__name__} has no option {unknown[0]!r}; it has {', '.join(names)}")
        check_arguments(Filter, (), options)
        new = _shallow(self)
        new._set_options(**{**self.options(), **options})
        return new._renewed(self)

    def with_modules(
        self, modules: Mapping[str, TensorDictModuleBase] | None = None, /, **others: TensorDictModuleBase
    ) -> Filter:
        """Returns a filter with other modules in some places; all other modules are shared with this one.

        Keys, spaces and inflation are those of the new modules, and are not copied from the old ones.

        Args:
            modules: new modules by name or number of their place; a place inside a sequence is ``"second.1"``, the
                initial belief ``"initial"``.
            **others: the same, by name.

        Raises:
            KeyError: if there is no such place.
            TypeError: if one is no TensorDict module.
            ValueError: if a new module does not fit the others.

        Example:
            >>> from torch_denkf.filters import KalmanFilter
            >>> from torch_denkf.modules import KalmanAnalysis
            >>> one = torch.eye(1)
            >>> kf = KalmanFilter(one, one, process_noise_cov=one, noise_cov=one, mean=torch.zeros(1), cov=one)
            >>> other = kf.with_modules(analysis=KalmanAnalysis(one, 4 * one))
            >>> kf["analysis"].noise, other["analysis"].noise
            (tensor([[1.]]), tensor([[4.]]))
        """
        new = _shallow(self)
        for place, module in {**(modules or {}), **others}.items():
            check_module(place := str(place), module)
            where: torch.nn.Module = new
            *path, name = [place] if place == "initial" else ["module", *".module.".join(place.split(".")).split(".")]
            for step in path:
                where._modules[step] = where = _shallow(where._modules.get(step) or torch.nn.Module())
            if where._modules.get(name) is None:
                places = [*(name for name, _ in named_modules_of(self)), "initial"]
                raise KeyError(f"{type(self).__name__} has no module at {place!r}; it has {places}.")
            where._modules[name] = module
        return new._renewed(self)

    def _renewed(self, old: Filter) -> Filter:
        self.observers, self.compiled = list(old.observers), copy(old.compiled)
        self._sort()
        return self

    @property
    def carry_keys(self) -> list[NestedKey]:
        """Returns the keys of the belief that are carried from step to step."""
        return [self.outer(key) for key in self.structure.carry]

    @property
    def belief_keys(self) -> list[NestedKey]:
        """Returns the keys of the belief: the carry, and entries computed from it, such as mean and variance."""
        return [self.outer(key) for key in self.structure.belief]

    @property
    def transition_module(self) -> TensorDictModuleBase:
        """Returns the module that forecasts the carry: the first that depends on the belief."""
        return self.structure.transition[1]

    def outer(self, key: NestedKey) -> NestedKey:
        """Returns the key of an entry outside of the filter, with the prefix if the filter writes the entry."""
        if self.prefix is None:
            return key
        names = (key,) if isinstance(key, str) else key
        if names[0] == "next":
            return ("next", self.prefix, *names[1:])
        own = key in self._own_keys or names[0] in ("noise", "drawn", "previous")
        return (self.prefix, *names) if own else key

    def inside(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns a shallow copy in which the filter's own entries have no prefix."""
        out = tensordict.copy()
        return out if self.prefix is None else out.update(tensordict.get(self.prefix))

    def __setitem__(self, index, module) -> None:
        """Raises ``TypeError``: :meth:`with_modules` returns a filter with another module.

        Raises:
            TypeError: always.
        """
        raise TypeError(f"Filters keep their modules; make a new filter: filter.with_modules({{{index!r}: module}})")

    def __getitem__(self, index):
        """Returns one module, by number or name, or a plain ``TensorDictSequential`` of several."""
        if isinstance(index, str):
            return super().__getitem__(index)
        modules = list(self._module_iter())[index]
        return TensorDictSequential(*modules) if isinstance(index, slice) else modules

    def select_subsequence(self, in_keys=None, out_keys=None) -> TensorDictSequential:
        """Returns the modules between some keys as a plain ``TensorDictSequential``."""
        return self[:].select_subsequence(in_keys, out_keys)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Returns the transform that carries the belief of a filter inside a policy.

        It is the counterpart of :meth:`torchrl.modules.LSTMModule.make_tensordict_primer`. If actions drive the filter,
        it also carries the last action (:class:`torch_denkf.transforms.LastAction`).
        """
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            belief = run_module(self.initial, self.draws.nothing(()), Call(torch.Size(), "initial"))
        found = Composite()
        for key in self.structure.carry:
            value = belief[key]
            kept = self.outer(previous_key(key))
            found[kept] = Unbounded(shape=value.shape, dtype=value.dtype, device=value.device)
        found[self.outer(HAS_PREVIOUS)] = Unbounded(shape=(1,), dtype=torch.bool, device=value.device)
        actions = {key: self.outer(previous_key(key)) for key in self.structure.controls}
        return primers().LastAction(actions, primers=found)

    def compile(self, *, chunk: int | None = None, **options) -> Filter:
        """Runs steps, and sequences in chunks of steps, through ``torch.compile`` from now on.

        The first call of each kind (batch size, with or without gradients) compiles, later calls reuse the result;
        copies and pickles of the filter compile again. Noise is drawn outside: a seed gives the eager result, up to
        rounding. Some calls stay eager: :meth:`predict`; ``step(without=...)``; in a policy, steps in which rows may
        reset.

        The first call also runs eagerly, to detect compiler errors, and raises if the results differ by more than
        rounding. If a reading is zero or missing, the comparison is repeated with random numbers in it. For a sequence
        with gradients, the gradients are compared, too.

        On a GPU an eager step is limited by kernel launches. ``mode="graph"`` compiles nothing: it records the kernels
        of the eager steps, and of their backward pass, in CUDA graphs, in about the time of a few eager calls. Python
        numbers, such as an inflation, are constants of the recording. On a processor this mode warns, and runs
        eagerly. With further options, such as ``backend="inductor"``, the graphs record a compiled step.

        ``mode="in time"`` compiles nothing: a :class:`~torch_denkf.filters.KalmanFilter` then processes all times of a
        sequence in parallel, in the order of log2 T calls. From some hundred rows on that is 25 to 50 times faster.

        Args:
            chunk: steps of a sequence in one compiled graph, 4 by default; one graph serves sequences of any length. A
                small chunk compiles sooner, a large one runs faster. 0 goes back to eager. With ``mode="graph"`` by
                default all steps are in one.
            **options: of ``torch.compile``. Without any, inductor on a processor also generates the calling code in
                C++, makes fewer calls, and saves fewer tensors for the backward pass: compilation takes longer, a run
                about 40 % less. ``backend="inductor"`` alone turns this off. On a GPU ``mode="reduce-overhead"`` uses
                CUDA graphs.

        Returns:
            This filter.

        Raises:
            RuntimeError: if there is no C++ compiler, which processors need; in the first call, if the compiled result
                differs from the eager one.
            ValueError: if ``chunk`` is negative.
        """
        self.compiled = None if chunk == 0 else compiler().strategy(chunk, options)
        return self

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Takes one step, or filters a sequence in recurrent mode; writes into ``tensordict``."""
        if recurrent_mode():
            return self.sequence(tensordict)
        structure, size = self.structure, tensordict.batch_size
        entries = self.entries_of(tensordict)
        given = list(entries.values())
        resumed = all(previous_key(key) in entries for key in structure.carry)
        if resumed and not all(previous_key(key) in entries for key in structure.required_controls):
            diagnosis().check_actions(structure, entries)
        for key in (*structure.carry, *structure.controls):
            if previous_key(key) in entries:
                entries[key] = entries[previous_key(key)]
        if not structure.must.issubset(entries):
            diagnosis().check_inputs(structure, type(self).__name__, entries, tensordict)
        # is_init may mark a slice of data, which continues from the belief before it.
        known = entries.get(HAS_PREVIOUS)
        reset = starts_of(tensordict, self.init_key, step=True) if known is None else ~known.reshape(*size, 1)
        drawn: Entries = {}
        if self.keeps_noise:
            places = (*dict(structure.modules), *([] if reset is None else ["initial"]))
            entries.update(drawn := self.draws.missing(entries, size, places=places))
        if reset is None:
            written = self.take_step(entries, size)
        else:
            call = Call(size)
            written = self.steps.step(entries, call, reset=reset, start=lambda now: self.initial_belief(now, call))
            self.steps.blank(written, reset)
            # A reset row has no previous belief.
            entries.update({key: where_rows(reset, written[key], entries[key]) for key in structure.carry})
        following = {("next", *previous_key(key)): written[key] for key in structure.carry}
        following["next", *HAS_PREVIOUS] = written[structure.carry[0]].new_ones(*size, 1, dtype=torch.bool)
        following.update({("drawn", *key[1:]): value for key, value in drawn.items()})
        record = Record("policy", tensordict, size, entries, {**written, **following})
        return self.write(tensordict, self.finished(record, given))

    def step(
        self, tensordict: TensorDictBase | Mapping[str, Any], *, without: Sequence[NestedKey] = ()
    ) -> TensorDictBase:
        """Predicts, then updates, on ``[*B]``: the carry in ``tensordict`` is the belief at t-1.

        Args:
            tensordict: carry, frame, and other inputs of the modules; the new belief is written there. A dictionary of
                numbers, arrays or tensors stands for one robot, batch size ``[]``, in the filter's precision; a number
                becomes an entry ``[1]``.
            without: keys of readings that are missing in this step, or are of an earlier step: their updates are
                skipped, and without any update the belief is the forecast. Such a step runs eagerly, also of a
                compiled filter.

        Returns:
            ``tensordict`` (of a dictionary, a new one), with the belief of t.

        Raises:
            KeyError: if an entry is missing, or a key in ``without`` is read by no module.
            ValueError: with ``check_finite``, if the new belief is not finite; or if one update uses several readings,
                and ``without`` names some of them, not all.
        """
        if not isinstance(tensordict, TensorDictBase):
            tensordict = self.of_one_robot(tensordict)
        entries, size = self.entries_of(tensordict, one_step=True), tensordict.batch_size
        if without:
            without = diagnosis().readings_to_leave_out(self.structure, without)
            diagnosis().check_joined_readings(self.structure, without)
            entries = {key: value for key, value in entries.items() if key not in without}
        if not self.structure.must.issubset(entries):
            diagnosis().check_inputs(self.structure, type(self).__name__, entries, tensordict, without)
        if without:
            written = self.steps.step(entries, Call(size), partial=True)
        else:
            written = (self.steps if self.compiled is None else self.compiled.of(self)).step(entries, Call(size))
        return self.write(tensordict, self.finished(Record("step", tensordict, size, entries, written)))

    def predict(self, tensordict: TensorDictBase | Mapping[str, Any]) -> TensorDictBase:
        """Runs a step without any frame: the belief of t is the forecast. Arguments and result are as in :meth:`step`.

        Raises:
            KeyError: if an analysis does not declare which entries are its readings.
        """
        diagnosis().check_named_readings(self.structure)
        tensordict = self.of_one_robot(tensordict)
        hidden = tensordict.copy()
        for key in {part.mask_key for part in in_role(self.module, Transition)} - {None}:
            hidden.set(key, torch.zeros(*tensordict.batch_size, 1, dtype=torch.bool, device=device_of(tensordict)))
        out = self.step(hidden, without=self.structure.readings)
        written = [key for key in self.out_keys if out.get(key, None) is not None]
        return tensordict.update(out.select(*written))

    def take_step(self, entries: Entries, batch_size: torch.Size) -> Entries:
        """Runs one step on unchecked ``entries``, eagerly or compiled, and returns its outputs."""
        strategy = self.steps if self.compiled is None else self.compiled.of(self)
        return strategy.step(entries, Call(batch_size))

    def finished(self, record: Record, given: Iterable[Tensor] | None = None, *, check: bool | None = None) -> Entries:
        """Ends every run: checks the new belief, clones outputs that share the caller's memory, calls the observers.

        Args:
            record: inputs and outputs of the run.
            given: tensors that the caller keeps; the inputs by default.
            check: whether a belief that is not finite raises; by default ``check_finite``, and not in a sequence.

        Returns:
            The entries to write.

        Raises:
            ValueError: if the new belief is not finite.
        """
        if torch.compiler.is_compiling():
            return record.written
        if self.check_finite and record.way != "sequence" if check is None else check:
            check_belief(self.structure, record.entries, record.written)
        record = record._replace(written=own(record.written, record.entries.values() if given is None else given))
        self.observe(record)
        return record.written

    def observe(self, record: Record) -> None:
        """Calls the observers of this kind of run; an observer without ``ways`` is called for all in ``RUNS``."""
        for observe in self.observers:
            if record.way in getattr(observe, "ways", RUNS):
                observe(self, record)

    def initialise(
        self, tensordict: TensorDictBase | Mapping[str, Any], *, without: Sequence[NestedKey] = ()
    ) -> TensorDictBase:
        """Writes the belief at the start of an episode, for every row of ``tensordict`` ``[*B]``.

        Args:
            tensordict: inputs of the initial belief, see :mod:`torch_denkf.modules.belief`.
            without: keys of readings that have not arrived yet. :class:`~torch_denkf.modules.FromSensor` then starts
                from its prior.

        Raises:
            KeyError: if an entry is missing, or a key in ``without`` is read by no module.
        """
        tensordict, structure, steps = self.of_one_robot(tensordict), self.structure, self.steps
        entries, call = self.entries_of(tensordict), Call(tensordict.batch_size)
        given, written = list(entries.values()), {}
        without = diagnosis().readings_to_leave_out(structure, without)
        entries = {key: value for key, value in entries.items() if key not in without}
        if self.update_at_reset or not set(structure.frame_keys).isdisjoint(chain(*reads(self.initial))):
            written = steps.run(structure.frames, entries, call, bool(without))
        hidden, mask = dict(entries), role(self.initial, Initial).observed_key
        if without and mask is not None and not entries.keys() >= {*reads(self.initial)[0]}:
            hidden = {**self.draws.nothing(call.batch_size), **entries}
            hidden[mask] = torch.zeros(*call.batch_size, 1, dtype=torch.bool, device=device_of(tensordict))
        start = self.initial_belief(hidden, call)
        if self.update_at_reset:
            written.update(steps.begin(entries, call, start, bool(without)))
        else:
            written.update(start)
            written.update({forecast: start[key] for key, forecast in structure.forecast_of.items()})
        return self.write(tensordict, own(written, given))

    def summarise(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the entries of the belief that are computed from its carry, e.g. mean and variance."""
        stored = {key: tensordict.get(self.outer(key), None) for key in self.structure.belief}
        stored = {key: value for key, value in stored.items() if value is not None}
        carry = {key: tensordict.get(self.outer(key)) for key in self.structure.carry}
        return self.write(tensordict, own(self.structure.completed(carry, stored)))

    def draw_noise(self, tensordict: TensorDictBase, *, generator: torch.Generator | None = None) -> TensorDictBase:
        """Writes the noise of all modules for ``tensordict`` (one step or a sequence), drawn in bulk.

        Noise that is already in the tensordict is kept.
        """
        size, entries = tensordict.batch_size, self.entries_of(tensordict)
        places, time = (*dict(self.structure.modules), "initial"), len(size) > 0
        noise = self.draws.missing(entries, size, places=places, time=time, generator=generator)
        return self.write(tensordict, noise)

    def sequence(
        self, tensordict: TensorDictBase, *, detach_every: int | None = None, keep: Sequence[NestedKey] | None = None
    ) -> TensorDictBase:
        """Filters a sequence ``[*B, T]`` and writes the outputs of a step for every time.

        Slices of one length in a flat ``[N]``, as torchrl's ``SliceSampler`` returns them, are filtered in parallel if
        ``is_init`` marks their beginnings.

        Args:
            tensordict: frames, and optionally ``is_init``, actions, masks, noise, and stored beliefs (see the class).
            detach_every: number of steps after which the belief is detached (truncated back-propagation through time).
            keep: the outputs to write; all by default. Ensembles of long sequences are large.

        Returns:
            ``tensordict``, with the outputs.

        Raises:
            ValueError: if there is no time dimension, no step, or the filter does not write a key in ``keep``.
            KeyError: if an entry is missing.
        """
        if detach_every is not None:
            check_count("detach_every", detach_every)
        size = tensordict.batch_size
        if not size or not size[-1]:
            raise ValueError(
                "A sequence has time as its last batch dimension, and at least one step; this tensordict has "
                f"batch_size {list(size)}."
            )
        inner = {self.outer(key): key for key in (*self.structure.frame_keys, *self.structure.step_keys)}
        kept = list(inner.values()) if keep is None else [inner.get(key, key) for key in map(unravel_key, keep)]
        unknown = [key for key in kept if key not in inner.values()]
        if unknown:
            raise ValueError(f"keep names {unknown}; the filter writes {list(inner)}.")
        outputs, rows = self._scan(tensordict, detach_every, kept)
        if rows is not tensordict:
            outputs = {key: value.flatten(0, 1) for key, value in outputs.items()}
        return self.write(tensordict, {key: outputs[key] for key in kept})

    def _scan(
        self, tensordict: TensorDictBase, detach_every: int | None, keep: Sequence[NestedKey]
    ) -> tuple[Entries, TensorDictBase]:
        """Returns the outputs ``keep`` of sequences ``[*B, T]``, and the tensordict with slices in rows."""
        rows, marks = as_rows(tensordict, starts_of(tensordict, self.init_key))
        structure, steps, size = self.structure, self.steps, rows.batch_size
        entries, call = self.entries_of(rows), Call(size, time=True)
        given = list(entries.values())
        if structure.must - entries.keys() - {*structure.carry}:
            diagnosis().check_inputs(structure, type(self).__name__, entries, rows, carry=False)
        with set_recurrent_mode(True):  # for recurrent modules of torchrl and of users
            frames = steps.run(structure.frames, entries, call)
        gathered = gather_rows(structure, entries, marks, size, self.initial_belief)
        later = [place for place, _ in (structure.transition, *structure.update)]
        gathered.inputs.update(self.draws.missing({**entries, **gathered.starts}, size, places=later, time=True))
        cuts = [detach_every is not None and t > 0 and t % detach_every == 0 for t in range(size[-1])]
        if gathered.stored:  # stored beliefs have seen their frame
            steps = steps._replace(update_at_reset=False)
        strategy = steps if self.compiled is None else self.compiled.of(self, steps)
        with set_recurrent_mode(False):
            kept, one = tuple(key for key in keep if key in structure.step_keys), Call(torch.Size(size[:-1]))
            starts = gathered.begins, gathered.starts
            outputs = strategy.scan(gathered.before, gathered.inputs, one, *starts, cuts, kept)[1]
        steps.blank(outputs, gathered.fresh)
        outputs.update({key: frames[key] for key in keep if key in frames})
        return self.finished(Record("sequence", tensordict, size, entries, outputs), given), rows

    def stepped(self, tensordict: TensorDictBase) -> Tensor:
        """Returns ``False`` for elements with an initial or stored belief, ``[*B, T]``; see :meth:`sequence`."""
        size = tensordict.batch_size
        marks = starts_of(tensordict, self.init_key)
        first = torch.zeros(size, dtype=torch.bool, device=device_of(tensordict))
        first[..., 0] = True
        first = first if marks is None else first | marks.reshape(size)
        if any(tensordict.get(self.outer(previous_key(key)), None) is None for key in self.structure.carry):
            return ~first
        known = tensordict.get(self.outer(HAS_PREVIOUS), None)  # for a policy: rows with a previous belief
        return torch.ones_like(first) if known is None else known.reshape(size)

    def like(self) -> Tensor | None:
        """Returns a tensor with the filter's dtype and device; ``None`` without parameters or constants."""
        return next((p for p in chain(self.parameters(), self.buffers()) if p.is_floating_point()), None)

    def entries_of(self, tensordict: TensorDictBase, *, one_step: bool = False) -> Entries:
        """Returns all available inputs and noise of the modules; ``one_step`` leaves out inputs of initial beliefs.

        Raises:
            KeyError: if the tensordict has noise that no module draws.
        """
        keys = self._step_keys if one_step else self._all_keys
        entries = {}
        for key, outer in keys.items():
            value = tensordict.get(outer, None)
            if value is not None:
                entries[key] = value
        drawn = tensordict.get(self._drawn_key, None) if recurrent_mode() and self.keeps_noise else None
        if drawn is not None:  # draws of other modules are not this filter's
            entries.update((key, value) for key, value in flat_noise(drawn).items() if key[1] in self.draws.places)
        given = tensordict.get(self._noise_key, None)
        if given is not None:
            noise = flat_noise(given)
            if any(len(key) < 2 or key[1] not in self.draws.places for key in noise):
                diagnosis().check_noise(self.draws.places, type(self).__name__, noise)
            entries.update(noise)
        return entries

    def initial_belief(self, entries: Entries, call: Call) -> Entries:
        """Returns the belief at the start of an episode."""
        structure = self.structure
        given = {key: value for key, value in entries.items() if key not in structure.belief}
        start = run_module(self.initial, given, call.part("initial"))
        return own(structure.completed(start), entries.values())

    def write(self, tensordict: TensorDictBase, written: Entries) -> TensorDictBase:
        """Writes entries under their outer keys, with one look-up for each nested tensordict."""
        owners: dict[tuple, Any] = {}
        for key, value in written.items():
            if self.fixed_options["prefix"] is not None:
                key = self.outer(key)
            prefix = () if isinstance(key, str) else key[:-1]
            owner = tensordict if not prefix else owners.get(prefix)
            if owner is None:
                owner = tensordict.get(prefix, None) if type(tensordict) is TensorDict else None
            if isinstance(owner, TensorDictBase):
                owners[prefix] = owner
                owner.set(key[-1] if prefix else key, value)
            else:  # not there yet
                tensordict.set(key, value)
        return tensordict

    def options(self) -> FilterOptions:
        """Returns the options of the filter."""
        return cast(FilterOptions, {key: getattr(self, key) for key in FilterOptions.__annotations__})

    def of_one_robot(self, tensordict: TensorDictBase | Mapping[str, Any]) -> TensorDictBase:
        """Converts a dictionary to a tensordict ``[]`` of the filter's dtype and device."""
        return of_one_robot(type(self).__name__, self.like(), tensordict)


def _shallow(module: torch.nn.Module) -> Any:
    """Returns a shallow copy of a module, whose sub-modules can be replaced without changing the original."""
    new = copy(module)
    for name, value in vars(module).items():
        if isinstance(value, dict) and name.startswith("_"):  # parameters, buffers, modules and hooks
            vars(new)[name] = value.copy()
    return new
