r"""Parts of fixed-lag smoothing: a filter also carries its last L states, which each new reading corrects.

:class:`torch_denkf.smoothers.FixedLag` puts them into a filter. The order of a step is

    transition -- past (shifted by one) -- observation, analysis (of present and past) -- lagged belief

In the first steps of an episode the lag window has copies of the episode's first state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf._checks import check_count, check_shape
from torch_denkf.beliefs import moments_of
from torch_denkf.functional.manifolds import Space
from torch_denkf.modules.around import Around, AugmentedBelief
from torch_denkf.submodel import Entries, Initial, SubModel, Update, role

__all__ = ["ENSEMBLE_PAST", "EnsemblePast", "LaggedAnalysis", "LaggedBelief", "Past", "lagged", "with_past"]


#: Keys of the members' lag window within a step, and of the age of the smoothed state.
PAST_KEY, AGE_KEY = ("forecast", "past"), ("smoothed", "age")


class Past(NamedTuple):
    """Names the entries of the lag window, and of the posterior of its oldest state.

    Attributes:
        carried: last names of the entries.
        follow: last names of entries computed from these, for the state L steps ago.
        copies: returns the entries at the start of an episode, from the prefix of the belief, L, and the belief.
        oldest: returns the ``follow`` entries, from the prefix, L, and the carried entries.
        present: last names of further entries of the belief computed from the carried ones, before the oldest's.
    """

    carried: tuple[str, ...]
    follow: tuple[str, ...]
    copies: Callable[[str, int, Entries], Sequence[torch.Tensor]]
    oldest: Callable[..., Sequence[torch.Tensor]]
    present: tuple[str, ...] = ()


def with_past(
    initial: TensorDictModuleBase, lag: int, past: Past, *, age: int = 0, belief_prefix: str = "belief"
) -> AugmentedBelief:
    """Returns an initial belief with a lag window: L copies of its state.

    Args:
        initial: the initial belief.
        lag: L.
        past: ``ENSEMBLE_PAST``, ``MOMENTS_PAST`` or ``JOINT_PAST``.
        age: steps between the first belief of an episode and the first state: 0, or -1 if that belief is still to be
            updated with its own frame.
        belief_prefix: prefix of the outputs of ``initial``, and of the lag window.

    Raises:
        ValueError: if ``lag`` is not positive.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import GaussianPrior
        >>> start = with_past(GaussianPrior([0.0], [1.0], ensemble_size=4), 3, ENSEMBLE_PAST)
        >>> start(TensorDict({}))["belief", "past"].shape
        torch.Size([4, 3, 1])
    """
    check_count("lag", lag, cure="It is the number of steps to look back")
    space = role(initial, Initial).space
    return AugmentedBelief(
        initial,
        [*((belief_prefix, name) for name in past.carried), AGE_KEY],
        partial(_begin, past.copies, belief_prefix, lag, age),
        follow_keys=[*((belief_prefix, name) for name in past.present), *(("smoothed", name) for name in past.follow)],
        follow=partial(past.oldest, belief_prefix, lag, **({} if space is None else {"space": space})),
    )


def _begin(copies: Callable, prefix: str, lag: int, age: int, belief: Entries, batch_size: torch.Size):
    past = copies(prefix, lag, belief)
    return [*past, torch.full((*batch_size, 1), age, device=past[0].device)]


def _copies(prefix: str, lag: int, belief: Entries) -> list[torch.Tensor]:
    return [belief[prefix, "ensemble"].unsqueeze(-2).repeat_interleave(lag, -2)]


def _oldest(prefix: str, lag: int, entries: Entries, *, space: Space | None = None) -> tuple[torch.Tensor, ...]:
    ensemble = entries[prefix, "past"][..., -1, :]
    return ensemble, *moments_of(ensemble, entries.get((prefix, "log_weight")), space)


#: The members of the lag window, ``[*B, E, L, S]``, the latest first, of an ensemble or of particles with log-weights.
ENSEMBLE_PAST = Past(("past",), ("ensemble", "mean", "var"), _copies, _oldest)


class EnsemblePast(SubModel):
    """Shifts the lag window by one step: the last belief becomes its latest state, the oldest is dropped.

    Args:
        belief_prefix: prefix of ``ensemble`` ``[*B, E, S]`` and ``past`` ``[*B, E, L, S]``, the latest first.

    Example:
        >>> from tensordict import TensorDict
        >>> belief = {"ensemble": torch.tensor([[3.0]]), "past": torch.tensor([[[2.0], [1.0]]])}
        >>> EnsemblePast()(TensorDict({"belief": belief}))["forecast", "past"].flatten()
        tensor([3., 2.])
    """

    def __init__(self, *, belief_prefix: str = "belief"):
        super().__init__(nn.Identity(), [(belief_prefix, "ensemble"), (belief_prefix, "past")], [PAST_KEY])

    def compute(self, ensemble, past):
        """Returns the lag window."""
        return torch.cat([ensemble.unsqueeze(-2), past[..., :-1, :]], -2)


class LaggedAnalysis(Around):
    """Corrects the lag window with the same reading, by its covariance with the predicted observation.

    It is the ensemble Kalman smoother (Evensen & van Leeuwen 2000). The lag window is neither inflated nor relaxed.

    Args:
        analysis: :class:`EnsembleAnalysis`, :class:`LocalEnsembleAnalysis`, or your own ensemble update; its keys and
            noise are kept.

    Raises:
        TypeError: if the analysis cannot correct earlier states.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import EnsembleAnalysis
        >>> members = torch.tensor([[-1.0], [1.0]])
        >>> td = TensorDict({
        ...     "forecast": {"ensemble": members, "observation": members, "past": members.unsqueeze(-1) / 2},
        ...     "sensor": {"ensemble": torch.tensor([4.0]), "noise": torch.tensor([2.0])},
        ... })
        >>> td = LaggedAnalysis(EnsembleAnalysis("etkf"))(td)
        >>> td["belief", "mean"].round(decimals=4), td["forecast", "past"].mean().round(decimals=4)
        (tensor([2.]), tensor(1.))
    """

    def __init__(self, analysis: Update):
        if not (isinstance(analysis, Update) and analysis.updates_ensemble):
            raise TypeError(
                f"{type(analysis).__name__} cannot correct earlier states. A lag needs an EnsembleAnalysis, a "
                "LocalEnsembleAnalysis, or your own analysis whose in_keys begin with the ensemble, its predicted_key "
                "and its reading_keys; smooth other ensembles with EnRTS."
            )
        super().__init__(analysis, out_keys=[*analysis.out_keys, PAST_KEY], further_keys=[PAST_KEY])

    updates_ensemble = True

    def on_entries(self, entries, call):
        """Returns the belief, the diagnostics, and the lag window."""
        return self.on_aligned(self.aligned(entries), call)

    def aligned(self, entries):
        """Implements :meth:`EnsembleAnalysis.aligned`."""
        return self.module.aligned(entries)

    def on_aligned(self, entries, call):
        """Implements :meth:`EnsembleAnalysis.on_aligned`."""
        analysis = self.module
        values, past = analysis.values(entries), self.required(entries, self.out_keys[-1])
        noise = analysis._noise(entries, values, call) if analysis.draws else None
        out = analysis.by_key(analysis.compute(*values, **({"noise": noise} if analysis.draws else {})))
        return {**out, self.out_keys[-1]: analysis.move_past(past, *values[1:], noise=noise)}


def lagged(analysis: Update) -> Update:
    """Extends an analysis to also correct the lag window; in wrappers such as a gate, the analysis inside.

    Raises:
        TypeError: if it cannot correct earlier states.
    """
    if isinstance(analysis, Around):
        return analysis.around(lagged(analysis.module))
    return LaggedAnalysis(analysis)


class LaggedBelief(SubModel):
    """Writes the posterior of the state L steps ago, given all readings up to now, under ``"smoothed"``.

    The outputs are ``ensemble`` ``[*B, E, S]``, ``mean`` and ``var`` ``[*B, S]``, and ``age`` ``[*B, 1]``: the number
    of steps since that state, L, or fewer in an episode that is younger.

    Args:
        belief_prefix: prefix of the carried ``past`` ``[*B, E, L, S]``, and of ``log_weight`` ``[*B, E]``.
        weighted: whether the members are particles with log-weights.
        space: space of the state; ``None`` for plain numbers.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"forecast": {"past": torch.tensor([[[3.0], [1.0]], [[5.0], [2.0]]])}})
        >>> td["smoothed", "age"] = torch.tensor([7])
        >>> LaggedBelief()(td)["smoothed", "mean"], td["smoothed", "age"]
        (tensor([1.5000]), tensor([2]))
    """

    def __init__(self, *, belief_prefix: str = "belief", weighted: bool = False, space: Space | None = None):
        out_keys = [(belief_prefix, "past"), *(("smoothed", name) for name in ("ensemble", "mean", "var")), AGE_KEY]
        super().__init__(nn.Identity(), [PAST_KEY, AGE_KEY] + [(belief_prefix, "log_weight")] * weighted, out_keys)
        self.space = space

    def compute(self, past, age, log_weight=None):
        """Returns the lag window, and the belief of its oldest state."""
        check_age(age, past.shape[:-3])
        ensemble = past[..., -1, :]
        return past, ensemble, *moments_of(ensemble, log_weight, self.space), (age + 1).clamp(max=past.shape[-2])


def check_age(age: torch.Tensor, batch_size: Sequence[int]) -> None:
    """Raises unless the age of the oldest carried state is ``[*B, 1]``."""
    check_shape("the age of the smoothed state", age, (*batch_size, 1), "[*B, 1]")
