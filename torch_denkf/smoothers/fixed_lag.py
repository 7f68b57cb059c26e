"""Fixed-lag smoothing online: adds a lag window to the belief of any filter."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping

from tensordict.nn import TensorDictModuleBase, TensorDictSequential

from torch_denkf.filters import Filter
from torch_denkf.modules.particles import ResampledTransition
from torch_denkf.running import is_sequence, named_modules_of
from torch_denkf.smoothers.past import ENSEMBLE_PAST, EnsemblePast, LaggedBelief, lagged, with_past
from torch_denkf.smoothers.past_moments import MOMENTS_PAST, CrossTransition, LaggedMoments, MomentsPast
from torch_denkf.submodel import Update, role

__all__ = ["FixedLag", "kind_of", "prefix_of"]


class FixedLag(Filter):
    """A filter that also writes, at each step, the smoothed belief of the state L steps ago.

    The belief of t is the filter's own. Further outputs are ``("smoothed", "mean")`` and ``("smoothed", "var")``,
    ``[*B, S]``, of the state at t - L, given all readings up to t, and ``("smoothed", "age")`` ``[*B, 1]``, the number
    of steps since that state, which is L, or fewer in an episode that is younger. The method depends on the
    belief:

    =====================  ========================================================================  ==================
    belief                 smoother                                                                  further entries
    =====================  ========================================================================  ==================
    ensemble               ensemble Kalman smoother: each analysis also corrects the lag window      ``ensemble``
    mean and covariance    Rauch-Tung-Striebel, forward in time                                      ``cov``
    particles              their ancestors, with the present weights (Kitagawa 1996)                 ``ensemble``
    =====================  ========================================================================  ==================

    It is a :class:`~torch_denkf.filters.Filter` itself: steps, sequences, masks, resets, policies, transforms, replay
    buffers and compiled steps work as with any other, and gradients pass through it. The lag window is part of the
    carry. Its modules are the filter's own, not copies. To smooth recordings, in which later readings are known,
    use :class:`EnKS`, :class:`EnRTS`, :class:`RTSSmoother` or :class:`ParticleSmoother`.

    Args:
        filter: an ensemble filter whose analyses are :class:`~torch_denkf.modules.EnsembleAnalysis` or
            :class:`~torch_denkf.modules.LocalEnsembleAnalysis`, a Kalman, extended or unscented Kalman filter, or a
            particle filter that does not resample by transport.
        lag: L, in steps.

    Raises:
        TypeError: for another filter.
        ValueError: if ``lag`` is not positive.

    Reference:
        Evensen & van Leeuwen, "An ensemble Kalman smoother for nonlinear dynamics", Monthly Weather Review 128, 2000.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> plain = KalmanFilter(one, one, process_noise=[1.0], noise=[1.0], mean=torch.zeros(1), cov=one)
        >>> kf = FixedLag(plain, lag=2)
        >>> out = kf.sequence(TensorDict({"observation": torch.ones(4, 1)}, [4]))
        >>> out["smoothed", "age"].flatten(), out["smoothed", "var"][-1] < out["belief", "var"][-1]
        (tensor([0, 1, 2, 2]), tensor([True]))
    """

    def __init__(self, filter: Filter, lag: int):
        kind, prefix = kind_of(filter)
        age = -1 if filter.update_at_reset else 0
        modules = OrderedDict(named_modules_of(filter))
        names = list(modules)
        place = names.index(filter.structure.transition[0])
        space = filter.structure.space
        if kind == "moments":
            forecast = filter.structure.forecast_of[prefix, "mean"][0]
            modules[names[place]] = CrossTransition(modules[names[place]], with_open=True)
            past = MomentsPast(belief_prefix=prefix, forecast_prefix=forecast)
            last = LaggedMoments(belief_prefix=prefix, forecast_prefix=forecast, space=space)
            initial = with_past(filter.initial, lag, MOMENTS_PAST, age=age, belief_prefix=prefix)
        else:
            initial = with_past(filter.initial, lag, ENSEMBLE_PAST, age=age, belief_prefix=prefix)
            last = LaggedBelief(belief_prefix=prefix, weighted=kind == "particles", space=space)
            past = EnsemblePast(belief_prefix=prefix)
            if kind == "particles":
                transition = modules[names[place]]
                modules[names[place]] = transition.with_past((prefix, "past"), ("forecast", "past"))
                past = None
            else:
                modules = _with_lagged_analyses(modules)
        ordered: OrderedDict[str, TensorDictModuleBase] = OrderedDict()
        for index, (name, module) in enumerate(modules.items()):
            ordered[name] = module
            if index == place and past is not None:
                ordered["past"] = past
        ordered["smoothed"] = last
        super().__init__(ordered, initial=initial, **filter.options())
        self.lag, self._without_lag = lag, list(filter.carry_keys)

    def sequence(self, tensordict, *, detach_every=None, keep=None):
        """Filters a sequence, see :meth:`Filter.sequence`.

        Raises:
            KeyError: if the data have beliefs that were stored without their lag window.
        """
        lacking = [key for key in self.carry_keys if tensordict.get(key, None) is None]
        if lacking and all(tensordict.get(key, None) is not None for key in self._without_lag):
            raise KeyError(
                f"The data have {self._without_lag}, from which a filter would continue, but not {lacking}: they were "
                "stored without a lag. Leave them out: tensordict.exclude(*filter.belief_keys)."
            )
        return super().sequence(tensordict, detach_every=detach_every, keep=keep)


def kind_of(filter: Filter) -> tuple[str, str]:
    """Returns the kind of belief, ``"ensemble"``, ``"moments"`` or ``"particles"``, and the prefix of its entries.

    Raises:
        TypeError: for a filter that cannot be smoothed.
    """
    if not isinstance(filter, Filter):
        raise TypeError(f"filter must be a torch_denkf Filter; got {filter!r}"[:200])
    carry = [key for key in filter.structure.carry if isinstance(key, tuple) and len(key) == 2]
    transition = filter.transition_module
    for prefix in dict.fromkeys(key[0] for key in carry):
        names = {key[1] for key in carry if key[0] == prefix}
        if names & {"past", "past_mean", "joint_mean"}:
            raise TypeError(
                "This filter already carries a lag window, as FixedLag, IEnKS and FusedFilter with a delay do. Pass "
                "the filter inside it. A FusedFilter with a delay writes ('smoothed', 'mean') itself, lag= steps back."
            )
        if {"ensemble", "log_weight"} <= names and isinstance(transition, ResampledTransition):
            return "particles", prefix
        if {"mean", "cov"} <= names:
            return "moments", prefix
        if "ensemble" in names and "log_weight" not in names:
            return "ensemble", prefix
    raise TypeError(
        f"{type(filter).__name__} carries {filter.carry_keys}; smoothing needs an ensemble, a mean and a covariance, "
        "or particles with log-weights and a ResampledTransition."
    )


def prefix_of(filter: Filter, kind: str, owner: object) -> str:
    """Returns the prefix of the belief's entries.

    Raises:
        TypeError: for a filter whose kind of belief its smoother, ``owner``, does not support.
    """
    found, prefix = kind_of(filter)
    if found != kind:
        words = {"ensemble": "an ensemble", "moments": "a mean and a covariance", "particles": "particles"}[kind]
        raise TypeError(
            f"{type(owner).__name__} takes a filter with {words}; {type(filter).__name__} carries {filter.carry_keys}."
        )
    return prefix


def _with_lagged_analyses(modules: Mapping[str, TensorDictModuleBase]) -> OrderedDict[str, TensorDictModuleBase]:
    """Returns the modules with analyses that also correct the lag window; also analyses in plain sequences.

    Raises:
        TypeError: if there is no ensemble analysis among them, or one does not support a lag window.
    """
    found = False

    def changed(module: TensorDictModuleBase) -> TensorDictModuleBase:
        nonlocal found
        if is_sequence(module):
            return TensorDictSequential(OrderedDict((name, changed(part)) for name, part in named_modules_of(module)))
        if role(module, Update).info_prefix is not None:
            found = True
            return lagged(module)  # raises if it cannot wrap the module
        return module

    out = OrderedDict((name, changed(module)) for name, module in modules.items())
    if not found:
        raise TypeError("There is no EnsembleAnalysis among the filter's modules, so nothing can correct a lag window.")
    return out
