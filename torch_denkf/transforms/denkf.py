"""The transform that carries a filter's belief through an environment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform
from torchrl.modules import set_recurrent_mode

from torch_denkf._arguments import Checked
from torch_denkf._registered import deployment, diagnosis
from torch_denkf.beliefs import is_summary
from torch_denkf.filters import Filter
from torch_denkf.filters.finish import Record, check_belief
from torch_denkf.filters.scan import where_rows
from torch_denkf.submodel import Entries
from torch_denkf.transforms.primer import check_no_group_resets

__all__ = ["DEnKFTransform"]


class DEnKFTransform(Checked, Transform):
    """Filters an environment's observations, and adds the belief to them.

    At reset the belief is the filter's initial belief (in the rows that reset; the others are unchanged).
    At each step the belief at t and the action lead to the forecast, the new observation to the belief at t+1::

        root:  observation[t]    belief[t]    action[t]
        next:  observation[t+1]  belief[t+1]            <- filter.step(belief[t], action[t], observation[t+1])

    The belief is part of the observation spec and of the state spec, so batched environments, collectors, partial
    resets and replay buffers carry it; nothing is stored in the transform. A belief that is passed to
    ``env.reset(tensordict)`` without a ``"_reset"`` mask is used as the prior. Randomness comes from torch's global
    generator and does not depend on ``.training``. Workers differ; *forked* workers (spawning is torchrl's
    default) start from copies of one generator and draw the same noise until ``env.set_seed`` is called.

    In a replay buffer (or called on a tensordict ``[*B, T]``, time last) the transform filters whole sequences, see
    :class:`~torch_denkf.filters.Filter`.

    A filter belongs either here or into the policy, not both: a policy's filter would start from a belief that has seen
    the frame already, and use each reading twice. In one process this raises a warning; across processes, or if the
    belief is copied in between, it is not detected. After this transform, torchrl's ``FrameSkipTransform`` makes one
    step of the belief a skip, with the last frame; put it before this one, where it repeats only the environment's
    steps. With groups of agents, the belief is the environment's, and is reset by the environment's own ``done``; an
    environment without one raises an error.

    Args:
        filter: any :class:`~torch_denkf.filters.Filter`, also one inside a :class:`~torch_denkf.smoothers.FixedLag` or
            a :class:`~torch_denkf.monitoring.Monitored`; or a ``TensorDictSequential`` of TensorDict modules with its
            ``initial`` belief.
        initial: the initial belief of a plain ``TensorDictSequential``.
        diagnostics: further outputs of the filter to keep, e.g. ``[("info", "nis")]``; zero at reset.
        store_ensemble: if ``False``, rollouts and collected data have only means and variances; the
            ensemble still passes from step to step, as ``("belief", "_ensemble")``, a private key that torchrl's
            collectors leave out of their data. Only outside a ``SerialEnv`` or ``ParallelEnv``.
        no_grad: whether environment steps record no graph (training recomputes the sequence). A graph through a
            rollout grows with every step, so this is on by default.
        check_finite: whether a belief that is not finite raises; not on a GPU, for which a step would have to wait.
            If an environment emits readings that are not finite, put ``torch_denkf.imperfect.RejectReadings``
            before this transform.
        ahead: also writes the belief of a later time: :class:`~torch_denkf.fusion.BeliefAhead`.
        packaged: the filter's step compiled ahead of time, from :func:`torch_denkf.deployment.load_step` (native code:
            load only what you would execute). At B=1 it is ten times as fast as the filter itself. It has the
            parameters of its export, supports only the batch size of the export, and cannot be used inside a
            worker, because it cannot be pickled. Resets and specs come from ``filter``.

    Raises:
        TypeError: if ``filter`` is neither a filter nor a ``TensorDictSequential`` with ``initial``.
        KeyError: if the environment does not emit the inputs of the filter, or the belief was lost between steps.
        ValueError: if the filter's result is not finite, or shapes do not fit.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(7)
        >>> kf = KalmanFilter(one, one, process_noise_cov=one, noise_cov=one, mean=torch.zeros(7), cov=one)
        >>> env = TransformedEnv(ContinuousActionVecMockEnv(), DEnKFTransform(kf))
        >>> env.rollout(3)["next", "belief", "mean"].shape
        torch.Size([3, 7])
    """

    def __init__(
        self,
        filter: Filter | TensorDictSequential,
        *,
        initial: TensorDictModuleBase | None = None,
        diagnostics: Sequence[NestedKey] = (),
        store_ensemble: bool = True,
        no_grad: bool = True,
        check_finite: bool = True,
        ahead: TensorDictModuleBase | None = None,
        packaged: Callable[[Mapping[str, torch.Tensor]], Mapping[str, torch.Tensor]] | None = None,
    ):
        if not isinstance(filter, Filter):
            if not isinstance(filter, TensorDictSequential) or initial is None:
                raise TypeError(
                    "DEnKFTransform takes a torch_denkf Filter, or a TensorDictSequential together with its initial "
                    f"belief (initial=...); got {type(filter).__name__} and initial={initial!r}."
                )
            filter = Filter(*filter._module_iter(), initial=initial)
        elif initial is not None:
            raise TypeError("A Filter has its initial belief already; pass initial= only with a TensorDictSequential.")
        structure, written = filter.structure, filter.structure.out_keys
        inner = {filter.outer(key): key for key in written}
        further = [inner.get(key, key) for key in map(unravel_key, diagnostics)]
        unknown = [key for key in further if key not in written]
        if unknown:
            raise KeyError(f"diagnostics {unknown} are not written by the filter; it writes {list(inner)}.")
        self._keep = [*structure.belief, *further]
        self.store_ensemble, self.no_grad, self.check_finite = store_ensemble, no_grad, check_finite
        later = [] if ahead is None else list(ahead.out_keys)
        dropped = [] if store_ensemble else [key for key in structure.belief if not is_summary(key)]
        super().__init__(
            in_keys=list(structure.needed),
            out_keys=[*(filter.outer(key) for key in self._keep if key not in dropped), *later],
        )
        self._dropped_keys = dropped
        names = {key: (*key[:-1], "_" + key[-1]) if key in dropped else key for key in self._keep}
        self._names = {key: filter.outer(key)[:-1] + names[key][-1:] for key in self._keep}
        self.filter, self.ahead = filter, ahead
        self._controls, self._optional = list(structure.controls), list(structure.optional)
        if packaged is not None and not no_grad:
            raise ValueError("A packaged step records no graph; leave out packaged=, or no_grad=False.")
        self._packaged = None
        if packaged is not None:
            self._packaged = deployment().PackagedRun(
                packaged,
                carry={key: self._names[key] for key in structure.carry},
                controls=self._controls,
                frames=self.in_keys,
                optional=self._optional,
                keep=self._keep,
            )

    # ----------------------------------------------------------------------------------------- in an environment

    def _grad_mode(self):
        return torch.no_grad() if self.no_grad else nullcontext()

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self._packaged is not None:
            kept = self._packaged(tensordict, next_tensordict)
            if kept is not None:  # otherwise the code below raises for the missing entry
                return self._emit({}, kept, next_tensordict)
        entries = {}
        for key in self.filter.structure.carry:
            name = self._names[key]
            value = tensordict.get(name, None)
            if value is None:
                raise KeyError(
                    f"DEnKFTransform carries the belief in {name!r}, but the tensordict passed to env.step() lacks it. "
                    "Start from env.reset(), and pass on the result of step_mdp() or env.step_and_maybe_reset()."
                )
            entries[key] = value
        self._copy(tensordict, entries, self._controls, "the tensordict passed to env.step()")
        self._copy(next_tensordict, entries, self.in_keys, "the environment")
        for key in self._optional:
            value = next_tensordict.get(key, None)
            if value is not None:
                entries[key] = value
        with self._grad_mode(), set_recurrent_mode(False):
            written = self.filter.take_step(entries, next_tensordict.batch_size)
        return self._emit(entries, written, next_tensordict)

    def _emit(
        self, entries: Entries, written: Mapping[NestedKey, torch.Tensor], next_tensordict: TensorDictBase
    ) -> TensorDictBase:
        kept = {key: written[key] for key in self._names}
        record = Record("environment", next_tensordict, next_tensordict.batch_size, entries, kept, self.parent)
        kept = self.filter.finished(record, check=self.check_finite)
        for key, name in self._names.items():
            next_tensordict.set(name, kept[key])
        return self._look_ahead(kept, next_tensordict)

    def _look_ahead(self, belief: Mapping[NestedKey, torch.Tensor], tensordict: TensorDictBase) -> TensorDictBase:
        if self.ahead is None:
            return tensordict
        now = tensordict.copy()
        for key, value in belief.items():
            now.set(self.filter.outer(key), value)
        with self._grad_mode():
            return tensordict.update(self.ahead(now).select(*self.ahead.out_keys))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        with self._grad_mode(), set_recurrent_mode(False):
            start = self.filter.initialise(tensordict_reset.copy())
            lacking = [key for key in self._keep if start.get(self.filter.outer(key), None) is None]
            if lacking:
                # Diagnostics of an update that did not take place: zeros in the shapes of an update.
                template = self._trial(start.copy())
                for key in lacking:
                    start.set(self.filter.outer(key), torch.zeros_like(template[key]))
        given = {key: tensordict.get(key, None) for key in self.filter.carry_keys} if tensordict is not None else {}
        lacking = [key for key, value in given.items() if value is None]
        if lacking and len(lacking) < len(given) and not self._dropped_keys:
            cure = "Pass a complete belief to env.reset(), or none."
            raise diagnosis().missing_entry(type(self).__name__, lacking, tensordict.keys(True, True), cure)
        if given and not lacking:
            mask = self._reset_mask(tensordict)
            for key, value in given.items():
                start.set(key, value.clone() if mask is None else where_rows(mask, start.get(key), value))
            start = self.filter.summarise(start.exclude(*(key for key in self.filter.belief_keys if key not in given)))
        if self.check_finite:
            entries = self.filter.entries_of(start, one_step=True)
            check_belief(self.filter.structure, entries, entries)
        for key, name in self._names.items():
            tensordict_reset.set(name, start.get(self.filter.outer(key)))
        return self._look_ahead({key: start.get(self.filter.outer(key)) for key in self._names}, tensordict_reset)

    def _reset_on_native_autoreset(self, tensordict, tensordict_reset):
        return self._reset(tensordict, tensordict_reset)

    def _reset_mask(self, tensordict: TensorDictBase) -> torch.Tensor | None:
        keys = ["_reset"] if self.parent is None else self.parent.reset_keys
        masks = [mask for mask in (tensordict.get(key, None) for key in keys) if mask is not None]
        if not masks:
            return None
        # The belief is the environment's: it is reset if any group or agent is reset.
        return torch.stack([mask.reshape(*tensordict.batch_size, -1).any(-1) for mask in masks]).any(0)

    def _trial(self, row: TensorDictBase) -> dict[NestedKey, torch.Tensor]:
        """Returns all outputs of a step from ``row`` without actions."""
        if self._controls:
            actions = self.parent.full_action_spec.zero()
            self._copy(actions, row, self._controls, "the environment's action spec")
        return self.filter.take_step(self.filter.entries_of(row), row.batch_size)

    def _copy(self, source: TensorDictBase, target: dict | TensorDictBase, keys, owner: str) -> None:
        for key in keys:
            value = source.get(key, None)
            if value is None:
                cure = (
                    f"It was expected in {owner}. Rename the key in the filter's sub-model, or put a transform that "
                    "writes it before DEnKFTransform. That transform must also declare it, in its "
                    "transform_observation_spec; a function in the place of a transform declares nothing."
                )
                raise diagnosis().missing_entry("The filter", [key], source.keys(True, True), cure)
            target[key] = value

    # ------------------------------------------------------------------------------------------------- the specs

    def _add_specs(self, spec: Composite, keys: Sequence[NestedKey], observation_spec: Composite) -> Composite:
        """Adds to ``spec`` the outputs of the filter under ``keys``, for observations that are all zero."""
        dtypes = {p.dtype for p in (*self.filter.parameters(), *self.filter.buffers()) if p.is_floating_point()}
        probe = observation_spec.zero()
        row = TensorDict({}, observation_spec.shape, device=observation_spec.device)
        self._copy(probe, row, self.in_keys, f"{type(self.parent.base_env).__name__}'s observation spec")
        for key in self.in_keys:
            value = row.get(key)
            if value.is_floating_point() and dtypes and value.dtype not in dtypes:
                raise TypeError(
                    f"The environment emits {key!r} as {value.dtype}, the filter computes in {dtypes.pop()}. Put "
                    "torchrl's DoubleToFloat() before DEnKFTransform, or convert the filter with filter.double()."
                )
        row.update(probe)
        # The shapes come from a trial step, which must not consume random numbers.
        cuda = [row.device] if row.device is not None and row.device.type == "cuda" else []
        with torch.no_grad(), torch.random.fork_rng(devices=cuda), set_recurrent_mode(False):
            written = self._trial(self.filter.initialise(row))
            told = {self.filter.outer(key): written[key] for key in keys}
            if spec is observation_spec and self.ahead is not None:
                out = self._look_ahead(written, row)
                told.update((key, out.get(key)) for key in self.ahead.out_keys)
        for key, value in told.items():
            spec[key] = Unbounded(shape=value.shape, dtype=value.dtype, device=value.device)
        return spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the belief and the diagnostics.

        Raises:
            ValueError: if the environment emits an entry of the same name already, or resets only groups of agents; or
                if a later transform overwrites the belief from which the filter continues.
        """
        keys = [key for key in self._keep if key not in self._dropped_keys]
        check_no_group_resets(self.parent.reset_keys, self.out_keys)
        diagnosis().check_behind(self, [self._names[key] for key in self.filter.structure.carry])
        taken = [name for name in self.out_keys if name in observation_spec.keys(True, True)]
        if taken:
            raise ValueError(
                f"The environment emits {taken[0]!r} already, for another filter: one would start from the "
                'belief of the other. Give this filter a prefix, prefix="imu" for example.'
            )
        return self._add_specs(observation_spec, keys, observation_spec)

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Adds the carry of the filter to the state spec."""
        if input_spec.get("full_state_spec", None) is None:
            input_spec["full_state_spec"] = Composite(shape=input_spec.shape, device=input_spec.device)
        observation_spec = self.parent.full_observation_spec.clone()
        keys = [key for key in self.filter.structure.carry if key not in self._dropped_keys]
        self._add_specs(input_spec["full_state_spec"], keys, observation_spec)
        return input_spec

    # --------------------------------------------------------------------------------------------------- storage

    def _post_step_mdp_hooks(self, tensordict, tensordict_):
        # The ensemble is removed from the stored data in place, because collectors read that object, and is added here
        # to the input of the next step, because torchrl's step_mdp keeps only entries of the specs.
        if not self._dropped_keys:
            return tensordict, tensordict_
        names = [self._names[key] for key in self._dropped_keys]
        next_names = [unravel_key(("next", name)) for name in names]
        values = [tensordict.get(name) for name in next_names]
        tensordict.exclude(*names, *next_names, inplace=True)
        for name, value in zip(names, values, strict=True):
            tensordict_.set(name, value)
        return tensordict, tensordict_

    def _check_batched_worker_compat(self) -> None:
        if not self.store_ensemble:
            raise RuntimeError(
                "DEnKFTransform(store_ensemble=False) drops the ensemble after the outermost environment's step, so "
                "it cannot live inside a SerialEnv or ParallelEnv worker. Append it outside: "
                "TransformedEnv(ParallelEnv(...), DEnKFTransform(filter, store_ensemble=False))."
            )

    # ------------------------------------------------------------------------------------------ in a replay buffer

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Filters a sequence ``[*B, T]``, e.g. a sample of a replay buffer; see :class:`Filter`.

        torchrl's buffers apply their transforms before ``SliceSampler`` marks the slices: a buffer of flat slices is
        an error. Filter its samples instead, or store whole windows ``[T]`` as its items.

        Raises:
            ValueError: if a flat batch seems to have several unmarked sequences.
        """
        self.filter.observe(Record("data", tensordict, tensordict.batch_size, {}, {}))
        with self._grad_mode(), set_recurrent_mode(True):
            out = self.filter(tensordict)
            return out if self.ahead is None else self.ahead(out)
