"""Predicts the belief at the time when the next action takes effect, through the actions under way."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.modules.tensordict_module.rnn import recurrent_mode

from torch_denkf._arguments import Checked
from torch_denkf._checks import check_count, check_number
from torch_denkf._registered import diagnosis
from torch_denkf.filters import Filter
from torch_denkf.filters.scan import where_rows

__all__ = ["BeliefAhead"]


class BeliefAhead(Checked, TensorDictModuleBase):
    """Predicts the belief at the time when the next action takes effect, in addition to the present belief.

    Between a reading and the resulting action a robot needs time, in which it moves by the actions sent before. The
    present belief is predicted through these, step by step, with the filter's process noise, so that its spread is that
    of the later time. It is stored under ``"ahead"``, e.g. ``("ahead", "belief", "mean")``.

    * In a loop, call it on the result of :meth:`Filter.step`; on the result of :meth:`Filter.sequence`, it predicts
      from each element.
    * In an environment, give it to :class:`~torch_denkf.transforms.DEnKFTransform` as ``ahead=``.
    * In a policy, put it after the filter. Its draws are stored with the data, like those of the filter.

    Args:
        filter: filter of the belief; it is not a submodule, and this module has no parameters.
        ahead: prediction horizon in steps of the filter; with ``dt``, in seconds. A number, or an entry ``[*B, 1]`` of
            the data.
        most: largest horizon in that entry; larger values raise.
        dt: seconds of a step. Seconds of an entry are rounded to whole steps unless there is a ``dt_key``.
        dt_key: entry ``[*B, 1]`` with the step length for the transition; the last step is then shorter if ``ahead`` is
            no multiple of ``dt``.
        actions: entry ``[*B, K, A]`` with the actions under way, the present one first, as
            :class:`~torch_denkf.envs.LateActions` writes it; needed if the filter has a control. K is at least the
            number of steps.
        each: whether to write the beliefs of all steps up to the horizon, ``[*B, K, ...]``, for a chunk of actions.
        keep: entries of the belief to write; all by default.

    Raises:
        ValueError: if a number is out of range, or seconds are no multiple of ``dt`` without a ``dt_key``.
        KeyError: if ``keep`` names no entry of the belief; in a call, if an entry is missing.

    Example:
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> kf = KalmanFilter(one, one, process_noise_cov=one, noise_cov=one, mean=torch.zeros(1), cov=one)
        >>> ahead = BeliefAhead(kf, 3)
        >>> belief = kf.step(kf.initialise({}).set("observation", torch.ones(1)))
        >>> out = ahead(belief)
        >>> (out["ahead", "belief", "var"] - out["belief", "var"]).item()  # three times the process noise
        3.0
    """

    def __init__(
        self,
        filter: Filter,
        ahead: float | NestedKey,
        *,
        most: float | None = None,
        dt: float | None = None,
        dt_key: NestedKey | None = None,
        actions: NestedKey = ("under_way", "action"),
        each: bool = False,
        keep: Sequence[NestedKey] | None = None,
    ):
        super().__init__()
        self.ahead_key = unravel_key(ahead) if isinstance(ahead, (str, tuple)) else None
        limit = ahead if self.ahead_key is None else most
        if limit is None:
            raise ValueError(f"ahead={ahead!r} is an entry: say its largest value, most=.")
        if dt is None:
            check_count("ahead" if self.ahead_key is None else "most", limit)
            if dt_key is not None:
                raise ValueError(
                    f"dt_key={dt_key!r} is of steps of unequal length: give the usual one, dt=, in seconds."
                )
        else:
            check_number("dt", dt, above=0)
            check_number("ahead" if self.ahead_key is None else "most", limit, above=0)
        self.most, self.dt, self.each = limit, dt, each
        steps = limit / (dt or 1)
        whole = abs(steps - round(steps)) < 1e-6
        if self.ahead_key is None and not whole and dt_key is None:
            raise ValueError(
                f"ahead={ahead} s are {steps:.2f} steps of {dt} s: give whole steps, or the dt_key of a transition "
                "that knows the length of its step."
            )
        self.steps = round(steps) if whole else int(steps) + 1
        self.dt_key = None if dt_key is None else unravel_key(dt_key)
        structure = filter.structure
        keys = structure.belief if keep is None else [self._inner(filter, key) for key in keep]
        unknown = [key for key in keys if key not in structure.belief]
        if unknown:
            raise KeyError(f"keep names {unknown}; the belief has {filter.belief_keys}.")
        # A list hides the filter from nn.Module: it is registered in the same policy or transform already.
        self._filter = [filter]
        self.belief_keys = [filter.outer(key) for key in keys]
        self.out_keys = [_later(key) for key in self.belief_keys]
        self.drawn_key = _later(filter.outer("drawn"))
        self.actions_key = unravel_key(actions) if structure.controls else None
        others = [key for key in (*structure.needed, *structure.optional) if key not in structure.readings]
        own = [self.ahead_key, self.actions_key, self.drawn_key]
        self.in_keys = [*filter.carry_keys, *filter.belief_keys, *map(filter.outer, others)]
        self.in_keys += [key for key in own if key is not None]

    @staticmethod
    def _inner(filter: Filter, key: NestedKey) -> NestedKey:
        names = dict(zip(filter.belief_keys, filter.structure.belief, strict=True))
        return names.get(unravel_key(key), unravel_key(key))

    @property
    def filter(self) -> Filter:
        """Returns the filter."""
        return self._filter[0]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the later belief, for every element of ``[*B]``, or of a sequence ``[*B, T]``.

        Raises:
            KeyError: if the belief, the actions or the horizon are missing.
            ValueError: if there are fewer actions than steps, or a horizon exceeds ``most``.
        """
        filter, size = self.filter, tensordict.batch_size
        lacking = [key for key in (*filter.carry_keys, self.ahead_key, self.actions_key) if key is not None]
        lacking = [key for key in lacking if tensordict.get(key, None) is None]
        if lacking:
            cure = (
                "BeliefAhead stands behind the filter; LateActions, in the environment, brings the actions under way."
            )
            raise diagnosis().missing_entry("BeliefAhead", lacking, tensordict.keys(True, True), cure)
        wanted = self._wanted(tensordict)
        kept = tensordict.get(self.drawn_key, None) if recurrent_mode() and filter.keeps_noise else None
        drawn: list[TensorDictBase] = []
        keys = [key for key in self.in_keys if key != self.drawn_key and tensordict.get(key, None) is not None]
        now = TensorDict({key: tensordict.get(key) for key in keys}, size, device=tensordict.device)
        filter.summarise(now)
        beliefs = []
        with set_recurrent_mode(False):
            for k in range(self.steps):
                self._drive(now, k, wanted)
                if kept is None:
                    noise = self._noise(now, size)
                else:
                    noise = kept.apply(lambda value, k=k: value.select(len(size), k), batch_size=size)
                if noise is not None:
                    now.set(filter.outer("noise"), noise)
                    drawn.append(noise)
                later = filter.predict(now.copy())
                beliefs.append(later.select(*self.belief_keys))
                if wanted is not None:
                    for key in (*filter.carry_keys, *self.belief_keys):
                        later.set(key, where_rows(wanted > k, later.get(key), now.get(key)))
                now = later
        for key in self.belief_keys:
            if self.each:
                value = torch.stack([belief.get(key) for belief in beliefs], len(size))
            else:
                value = now.get(key)
            tensordict.set(_later(key), value)
        if drawn and filter.keeps_noise and kept is None:
            tensordict.set(self.drawn_key, TensorDict.maybe_dense_stack(drawn, len(size)))
        return tensordict

    def _wanted(self, tensordict: TensorDictBase) -> Tensor | None:
        """Returns the prediction horizon in steps and fractions, ``[*B, 1]``; ``None`` if it is constant."""
        if self.ahead_key is None:
            if self.dt_key is None:
                return None
            like = tensordict.get(self.dt_key)
            return torch.full_like(like, self.most / (self.dt or 1.0))
        wanted = tensordict.get(self.ahead_key)
        if bool((wanted > self.most * (1 + 1e-6)).any() | (wanted < 0).any()):
            raise ValueError(
                f"{self.ahead_key!r} is from 0 to most={self.most}; got {wanted.min().item()} to {wanted.max().item()}."
            )
        wanted = wanted if self.dt is None else wanted / self.dt
        return wanted if self.dt_key is not None else wanted.round() if wanted.is_floating_point() else wanted

    def _drive(self, now: TensorDictBase, k: int, wanted: Tensor | None) -> None:
        """Sets the action of the k-th step, and its length."""
        if self.actions_key is not None:
            actions = now.get(self.actions_key)
            if actions.shape[now.ndim] < self.steps:
                raise ValueError(
                    f"{self.actions_key!r} has {actions.shape[now.ndim]} actions, [*B, K, A]; to look {self.steps} "
                    "steps ahead takes so many, the one that runs now first."
                )
            for key in self.filter.structure.controls:
                now.set(key, actions.select(now.ndim, k))
        if self.dt_key is not None and self.dt is not None and wanted is not None:
            now.set(self.dt_key, self.dt * (wanted - k).clamp(0.0, 1.0))

    def _noise(self, now: TensorDictBase, size: torch.Size) -> TensorDictBase | None:
        """Draws the noise of one forecast."""
        filter = self.filter
        if not filter.draws.places:
            return None
        places = [place for place, _ in (filter.structure.transition, *filter.structure.update)]
        noise = filter.draws.missing(
            filter.entries_of(now.exclude(filter.outer("noise")), one_step=True), size, places=places
        )
        return TensorDict({key[1:]: value for key, value in noise.items()}, size) if noise else None


def _later(key: NestedKey) -> NestedKey:
    return ("ahead", key) if isinstance(key, str) else ("ahead", *key)
