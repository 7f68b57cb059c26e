r"""One base for all filters: a step on a tensordict, or a whole sequence with resets.

The order in time is predict, then update::

    belief[t-1] --transition--> forecast[t] --observation, analysis--> belief[t]
                                    ^ the sensor's reading of frame t

At a reset the forecast is the initial belief, and so is the belief unless ``update_at_reset``. Nothing is kept on
``self`` between steps: the belief lives in the tensordict.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import TensorDictPrimer
from torchrl.modules.tensordict_module.rnn import recurrent_mode

from torch_denkf.filters._compiled import CompiledSteps
from torch_denkf.filters._parts import Known, inputs_of, submodels
from torch_denkf.filters._recursion import Recursion, run, where_rows
from torch_denkf.functional import ensemble_mean, ensemble_var, weighted_mean, weighted_var
from torch_denkf.modules._row import Row, RowPlan, on_rows

__all__ = ["Filter", "submodels", "where_rows"]

#: What follows from what: the summaries of a belief that a filter carries under these names.
_SUMMARIES = {
    "ensemble": {"mean": ensemble_mean, "var": ensemble_var},
    "particles": {"mean": weighted_mean, "var": weighted_var},
    "cov": {"var": lambda cov: cov.diagonal(dim1=-2, dim2=-1)},
}


class Filter(TensorDictSequential):
    """A Bayesian filter: TensorDict modules in sequence, and an initial belief.

    The modules are sorted once, by their keys: those that depend on the belief (transition, observation,
    analysis) form the *recursion*; the others (sensor, noise) read frames alone and, on a sequence, run once on
    all of them. The entries that the recursion reads before it writes them, and that ``initial`` provides, are the
    *carry*: ``("belief", "ensemble")`` for an ensemble, ``("belief", "mean")`` and ``("belief", "cov")`` for a
    Kalman filter.

    Called outside torchrl's recurrent mode, a filter takes one step on a tensordict ``[*B]``: the carry there is
    the belief at t-1, the frame is that of t, and afterwards the belief is that of t, also under ``("next", ...)``
    so that a policy hands it on like :class:`torchrl.modules.LSTMModule` does its hidden state. In recurrent mode
    (``with set_recurrent_mode(True)``; every torchrl loss does it) it takes a sequence ``[*B, T]``, time last. Its
    first element starts from the belief that is stored there, which has seen that frame already, or from the
    initial belief where none is stored; elements with ``is_init`` start anew from the initial belief; all others
    are one step on from their predecessor. Actions are read one step earlier, as torchrl stores them.

    Args:
        modules: TensorDict modules in order, or one dict of them by name.
        initial: the initial belief, see :mod:`torch_denkf.modules.belief`.
        control_keys: entries that drive the transition *out of* the time they are stored at, by default the action.
        init_key: marks the first element of an episode, ``[*B, 1]`` bool, as written by
            :class:`torchrl.envs.InitTracker` and torchrl's ``SliceSampler``; a sequence without it starts anew
            after every ``("next", "done")``.
        update_at_reset: whether the initial belief is updated with the first frame.

    Raises:
        ValueError: if no module depends on what ``initial`` provides.

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
    ):
        super().__init__(*modules)
        self.initial = initial
        self.init_key = unravel_key(init_key)
        self.control_keys = [unravel_key(key) for key in control_keys]
        self.update_at_reset = update_at_reset
        self._plan: RowPlan | None = None
        self._known: Known | None = None
        self._compiled: CompiledSteps | None = None
        self._sort_modules()

    def _sort_modules(self) -> None:
        provided = [unravel_key(key) for key in self.initial.out_keys]
        self.carry_keys = [key for key in map(unravel_key, self.in_keys) if key in provided]
        if not self.carry_keys:
            raise ValueError(
                f"No module of the filter reads what its initial belief writes ({provided}); the filter reads "
                f"{list(self.in_keys)}. Give both the same keys."
            )
        modules = list(self._module_iter())
        dependent = {*self.carry_keys, *self.control_keys}
        self._recursion = []
        for index, module in enumerate(modules):
            if not dependent.isdisjoint(map(unravel_key, module.in_keys)):
                self._recursion.append(index)
                dependent.update(map(unravel_key, module.out_keys))
        recursion = [modules[index] for index in self._recursion]
        self.recursion_out_keys = list(dict.fromkeys(unravel_key(k) for m in recursion for k in m.out_keys))
        self.belief_keys = [key for key in provided if key in self.recursion_out_keys]
        # The first module of the recursion is the transition; what it writes is the forecast of the carry, in order.
        self._forecast_of = dict(zip(self.carry_keys, map(unravel_key, recursion[0].out_keys), strict=False))
        self._share_size("ensemble_size", (self.initial,))
        # A transition may hold process noise, whose width is another.
        self._share_size("observation_dim", [module for module in modules if module is not recursion[0]])

    def _share_size(self, name: str, sources: Iterable[TensorDictModuleBase]) -> None:
        """Tells the sub-models that leave ``name`` open the size on which all ``sources`` agree, if they do."""
        sizes = {getattr(part, name, None) for source in sources for part in submodels(source)} - {None}
        if len(sizes) != 1:
            return
        for part in submodels(self.module):
            if hasattr(part, name) and getattr(part, name) is None:
                setattr(part, name, *sizes)

    def __getitem__(self, index):
        """Returns one module, by number or name, or a plain ``TensorDictSequential`` of several."""
        if isinstance(index, str):
            return super().__getitem__(index)
        modules = list(self._module_iter())[index]
        return TensorDictSequential(*modules) if isinstance(index, slice) else modules

    def select_subsequence(self, in_keys=None, out_keys=None) -> TensorDictSequential:
        """Returns the modules between some keys; a part of a filter is a plain ``TensorDictSequential``."""
        return self[:].select_subsequence(in_keys, out_keys)

    @property
    def frame_modules(self) -> list[TensorDictModuleBase]:
        """The modules that read frames alone, and not the belief."""
        return [module for index, module in enumerate(self._module_iter()) if index not in self._recursion]

    @property
    def transition_module(self) -> TensorDictModuleBase:
        """The module that forecasts the carry: the first that depends on the belief."""
        return list(self._module_iter())[self._recursion[0]]

    @property
    def update_modules(self) -> list[TensorDictModuleBase]:
        """The modules between the forecast and the belief."""
        modules = list(self._module_iter())
        return [modules[index] for index in self._recursion[1:]]

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Returns the transform that keeps the carry in the environment's tensordict where the filter is a policy's.

        Like :meth:`torchrl.modules.LSTMModule.make_tensordict_primer`; needs torchrl's ``InitTracker`` in the
        environment, too, so that the filter knows where an episode begins.
        """
        probe = TensorDict({}, batch_size=[])
        for key in self.initial.in_keys:
            probe.set(key, torch.zeros(getattr(self.initial, "observation_dim", getattr(self.initial, "state_dim", 1))))
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            belief = self.initial(probe)
        primers = Composite()
        for key in self.carry_keys:
            value = belief.get(key)
            primers[key] = Unbounded(shape=value.shape, dtype=value.dtype, device=value.device)
        return TensorDictPrimer(primers, expand_specs=True)

    # ----------------------------------------------------------------------------------------------- one step

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Takes one step, or filters a sequence in recurrent mode; writes into ``tensordict``."""
        if recurrent_mode():
            return self.sequence(tensordict)
        is_init = tensordict.get(self.init_key, None)
        if is_init is None:
            tensordict = self.step(tensordict)
        else:
            self._check_carry(tensordict)
            tensordict = run(self.frame_modules, tensordict)
            recursion, starts = self._make_recursion(self.update_at_reset), self._initial_of(tensordict)
            tensordict = recursion.advance(tensordict, is_init, starts)
        for key in self.carry_keys:
            tensordict.set(("next", key) if isinstance(key, str) else ("next", *key), tensordict.get(key))
        return tensordict

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Predicts, then updates, on ``[*B]``: the carry in ``tensordict`` is the belief at t-1.

        Raises:
            KeyError: if the carry is missing.
        """
        plan = on_rows(self.module._modules.values(), self._plan) if type(tensordict) is TensorDict else None
        if plan is None:
            self._check_carry(tensordict)
            return run(self._module_iter(), tensordict)
        self._plan, row = plan, Row.of(tensordict, plan.reads)
        self._check_carry(row)
        if self._compiled is None:
            row = run(plan.modules, row)
        else:
            row = self._compiled.step(plan, row, row.get(self.carry_keys[0]).dtype)
        return row.write(tensordict, plan.writes)

    def compile(self, *, chunk: int = 4, **options) -> Filter:
        """From now on runs steps, and sequences in chunks of steps, through ``torch.compile``.

        The first call of each kind (chunk, batch size, with or without gradients) compiles for up to minutes, later
        ones reuse that; copies and pickles of the filter compile anew. Noise is drawn outside, so a seed gives what it
        gives eagerly, up to rounding. Filters with a part that needs a TensorDict (see ``SubModel.runs_on_rows``) and
        noise that is not a tensor (flipout) stay eager.

        Args:
            chunk: steps of a sequence in one compiled graph. What is left over after whole chunks runs step by step.
                0 goes back to eager.
            **options: of ``torch.compile``. Without any, inductor on a processor writes what calls its kernels in C++,
                too, makes fewer calls, and saves fewer tensors for the backward pass, which takes longer to compile
                and about 40 % less to run. On a GPU ``mode="reduce-overhead"`` asks for CUDA graphs (never run here).

        Returns:
            This filter.

        Raises:
            RuntimeError: if there is no C++ compiler, which processors need.
            ValueError: if ``chunk`` is negative.
        """
        if chunk < 0:
            raise ValueError(f"chunk is a number of steps, or 0 for none; got {chunk}.")
        self._compiled = CompiledSteps(chunk, options) if chunk else None
        return self

    def initialise(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the belief at the start of an episode, for every row of ``tensordict`` ``[*B]``."""
        frame_outputs = {unravel_key(key) for module in self.frame_modules for key in module.out_keys}
        if self.update_at_reset or not frame_outputs.isdisjoint(map(unravel_key, self.initial.in_keys)):
            tensordict = run(self.frame_modules, tensordict)
        tensordict = self.initial(tensordict)
        if self.update_at_reset:
            for key, forecast_key in self._forecast_of.items():
                tensordict.set(forecast_key, tensordict.get(key))
            tensordict = run(self.update_modules, tensordict)
        return tensordict

    def summarise(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the other entries of the belief, e.g. mean and variance, from its carry."""
        for key in self.belief_keys:
            if key not in self.carry_keys:
                source = next(k for k in self.carry_keys if k[-1] in _SUMMARIES and key[-1] in _SUMMARIES[k[-1]])
                kind, values = source[-1], [tensordict.get(source)]
                if (*source[:-1], "log_weight") in self.carry_keys:  # an ensemble with weights
                    kind, values = "particles", [*values, tensordict.get((*source[:-1], "log_weight"))]
                tensordict.set(key, _SUMMARIES[kind][key[-1]](*values))
        return tensordict

    def _check_carry(self, tensordict: TensorDictBase | Row) -> None:
        for key in self.carry_keys:
            if tensordict.get(key, None) is None:
                raise KeyError(
                    f"{type(self).__name__} carries its belief in {key!r}, which the tensordict lacks. Call "
                    "filter.initialise(tensordict) at the start of an episode; in an environment append "
                    "DEnKFTransform(filter), or InitTracker() and filter.make_tensordict_primer() where the filter is "
                    "part of the policy."
                )

    def _initial_of(self, frames: TensorDictBase) -> TensorDictBase:
        """The initial belief for every element of ``frames``, which is left as it is."""
        return self.initial(frames.copy()).select(*self.belief_keys, *self.carry_keys)

    def _lookup(self) -> Known:
        """What follows from the modules alone, looked up anew when one of them is another."""
        modules = (*self.module._modules.values(), self.initial)
        if self._known is None or self._known.modules != modules:
            recursion = (self.transition_module, *self.update_modules)
            inputs = inputs_of(recursion, {*self.recursion_out_keys, *self.carry_keys})
            self._known = Known(modules, tuple(submodels(self)), inputs)
        return self._known

    def _make_recursion(self, update_at_reset: bool) -> Recursion:
        modules, known = list(self._module_iter()), self._lookup()
        recursion = Recursion(
            [modules[index] for index in self._recursion],
            plans=known.plans,
            carry_keys=self.carry_keys,
            belief_keys=self.belief_keys,
            forecast_of=self._forecast_of,
            out_keys=self.recursion_out_keys,
            update_at_reset=update_at_reset,
        )
        known.plans = recursion.plans
        return recursion

    # --------------------------------------------------------------------------------------------- a sequence

    def draw_noise(self, tensordict: TensorDictBase, *, generator: torch.Generator | None = None) -> TensorDictBase:
        """Writes the noise that the modules will need on ``tensordict`` (one step or a sequence), drawn in bulk.

        Noise that is there already is kept.
        """
        dtype = next((p.dtype for p in chain(self.parameters(), self.buffers()) if p.is_floating_point()), None)
        for module in self._lookup().parts:
            key = module.noise_key
            if key is not None and tensordict.get(key, None) is None:
                size, device = tensordict.batch_size, tensordict.device
                noise = module.draw_noise(size, device=device, dtype=dtype, generator=generator)
                if noise is not None:
                    tensordict.set(key, noise)
        return tensordict

    def sequence(self, tensordict: TensorDictBase, *, detach_every: int | None = None) -> TensorDictBase:
        """Filters a sequence ``[*B, T]`` and writes what a step writes, for every time.

        Args:
            tensordict: frames, and optionally ``is_init``, actions, masks, noise, and stored beliefs (see the class).
            detach_every: truncates back-propagation through time: the belief is detached every so many steps.

        Returns:
            ``tensordict``, with the outputs of all modules.

        Raises:
            ValueError: if there is no time dimension.
        """
        if not tensordict.ndim:
            raise ValueError("A sequence has time as its last batch dimension; this tensordict has batch_size [].")
        work = run(self.frame_modules, self.draw_noise(tensordict.copy()))
        is_init = self._starts(tensordict)
        stored = all(tensordict.get(key, None) is not None for key in self.belief_keys)
        if stored:  # these have seen their frame
            starts = tensordict.select(*self.belief_keys, *self.carry_keys)
        else:  # where only the first element starts, only its initial belief is needed
            starts = self._initial_of(work if is_init is not None else work[..., :1])
        recursion = self._make_recursion(self.update_at_reset and not stored)
        inputs = {key: work.get(key) for key in self._recursion_inputs(work)}
        if recursion.on_rows and self._compiled is not None and self._compiled.takes(inputs):
            outputs = self._compiled.sequence(recursion, self.control_keys, inputs, is_init, starts, detach_every)
        else:
            outputs = self._eager_sequence(recursion, inputs, is_init, starts, work, detach_every)
        frame_keys = [unravel_key(key) for module in self.frame_modules for key in module.out_keys]
        outputs = {**{key: work.get(key) for key in frame_keys}, **outputs}
        return Row(outputs, tensordict.batch_size, tensordict.device).write(tensordict, outputs)

    def _eager_sequence(self, recursion, inputs, is_init, starts, work, detach_every) -> dict[NestedKey, torch.Tensor]:
        """All outputs of the recursion, ``[*B, T, ...]`` each."""
        time, steps = work.ndim - 1, work.shape[-1]
        values = {key: value.unbind(time) for key, value in inputs.items()}
        resets, starts = None if is_init is None else is_init.unbind(time), starts.unbind(time)
        rows = []
        for t in range(steps):
            now = {key: value[max(t - 1, 0) if key in self.control_keys else t] for key, value in values.items()}
            if recursion.on_rows:
                rows.append(Row(now, work.batch_size[:-1], work.device))
            else:
                rows.append(TensorDict({}, batch_size=work.batch_size[:-1], device=work.device).update(now))
        first = recursion.first(rows[0], starts[0])
        cuts = [bool(detach_every) and t % detach_every == 0 for t in range(1, steps)]
        belief = first.select(*self.carry_keys)
        _, later = recursion.roll(belief, rows[1:], None if resets is None else resets[1:], starts[1:], cuts)
        outputs = [first.select(*recursion.out_keys), *later]
        return {key: torch.stack([output.get(key) for output in outputs], time) for key in recursion.out_keys}

    def _starts(self, tensordict: TensorDictBase) -> torch.Tensor | None:
        """Marks the first elements of episodes or slices: ``is_init``, or what follows a ``("next", "done")``."""
        is_init = tensordict.get(self.init_key, None)
        done = tensordict.get(("next", "done"), None)
        if is_init is not None or done is None:
            return is_init
        time = tensordict.ndim - 1
        return torch.cat([torch.ones_like(done.narrow(time, 0, 1)), done.narrow(time, 0, done.shape[time] - 1)], time)

    def _recursion_inputs(self, tensordict: TensorDictBase) -> list[NestedKey]:
        """The entries of ``tensordict`` that the recursion reads and does not write."""
        return [key for key in self._lookup().inputs if tensordict.get(key, None) is not None]
