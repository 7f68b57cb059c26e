r"""Observations over several steps: after missing frames, a sensor compares a frame with the last one that arrived.

Such an observation is the motion over the whole gap. The filter must then store its velocities of the past steps
(stochastic cloning, Roumeliotis & Burdick 2002): either next to the state (:func:`with_history`, for
:class:`torch_denkf.applications.car.UnicycleMotion`) or in it (:class:`ClonedPrior`, :class:`ClonedTransition`, for
filters whose covariance or weights include the pose).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf._checks import check_count, check_values
from torch_denkf.functional.moments import ensemble_var
from torch_denkf.modules.around import AroundInitial, AugmentedBelief, Wrapper
from torch_denkf.modules.tensors import register_constant
from torch_denkf.running import check_module, reads
from torch_denkf.submodel import Entries, Initial, SubModel, Transition

__all__ = ["ClonedPrior", "ClonedTransition", "PairObservation", "with_history"]


def with_history(
    initial: TensorDictModuleBase,
    lags: int,
    *,
    ensemble_key: NestedKey = ("belief", "ensemble"),
    history_key: NestedKey = ("belief", "history"),
) -> AugmentedBelief:
    """Returns an initial belief with a velocity history, filled with each member's present velocities.

    Args:
        initial: initial belief; writes an ensemble ``[*B, E, 5]``, see :class:`UnicycleTransition`.
        lags: past steps to carry, L: one less than the longest span of a reading.
        ensemble_key: key of the ensemble of ``initial``.
        history_key: velocities (v m/s, theta_dot rad/s) of the last L steps, the latest first, ``[*B, E, L, 2]``.

    Raises:
        ValueError: if ``lags`` is not positive.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import AroundState
        >>> start = with_history(AroundState([0.0, 0.0, 0.0, 0.3, 0.02], ensemble_size=8), lags=2)
        >>> start(TensorDict({"state": torch.zeros(5)}))["belief", "history"].shape
        torch.Size([8, 2, 2])
    """
    check_count("lags", lags)
    return AugmentedBelief(
        initial, [history_key], partial(_same_velocities, unravel_key(ensemble_key), lags), nested=True
    )


def _same_velocities(ensemble_key: NestedKey, lags: int, belief: Entries, _: torch.Size) -> list[torch.Tensor]:
    return [belief[ensemble_key][..., 3:].unsqueeze(-2).repeat_interleave(lags, -2)]


class PairObservation(SubModel):
    r"""Observation of a pair of frames n steps apart: the sum of the velocities of all n steps.

    .. math:: H x^i_t = h\Big(\sum_{k=0}^{n-1} (v, \dot\theta)^i_{t-k}\Big)

    After missing frames, a pair of the last available frame and the present one measures the motion between them. The
    members carry their velocities of the past steps, which the analysis corrects, too (stochastic cloning);
    :class:`UnicycleMotion` then repeats the motion over the gap. Use with ``EnsembleAnalysis(forecast_key=("forecast",
    "clone"), observed_key=("forecast", "observed"), belief_prefix="analysis")`` and an initial belief
    :func:`with_history`.

    Args:
        reach: range of the sensor: largest absolute speed and turn rate of a whole pair ``[2]`` (m/s, rad/s). If the
            forecast over a gap exceeds it by two standard deviations, the frame counts as not observed.
        curve: h, mean reading at a true sum ``[*, 2]``, for a biased sensor; by default the sum itself.
        in_key: forecast ensemble ``[*B, E, 5]``, or with the history ``[*B, E, 5 + 2L]``.
        history_key: see :func:`with_history`; ``None`` if the history is part of the state, see
            :class:`ClonedTransition`.
        steps_key: optional number of steps n between the frames ``[*B, 1]``, int; 0 without a pair; by default 1.
            ``kitti.gaps.bridge_gaps`` writes it.
        observed_key: optional mask ``[*B, 1]``.
        out_key: predicted observations ``[*B, E, 2]``.
        clone_key: forecast and history concatenated, ``[*B, E, 5 + 2L]``.
        out_observed_key: mask of pairs within the range, ``[*B, 1]``.

    Source:
        Roumeliotis & Burdick 2002, "Stochastic cloning: a generalized framework for processing relative state
        measurements"; here by an ensemble.

    Example:
        >>> from tensordict import TensorDict
        >>> forecast, history = torch.tensor([[0.0, 0.0, 0.0, 10.0, 0.1]]), torch.tensor([[[9.0, 0.2]]])
        >>> td = TensorDict({"forecast": {"ensemble": forecast}, "belief": {"history": history}, "steps": [2]})
        >>> PairObservation()(td)["forecast", "observation"]
        tensor([[19.0000,  0.3000]])
    """

    def __init__(
        self,
        reach: Sequence[float] | torch.Tensor | None = None,
        *,
        curve: nn.Module | None = None,
        in_key: NestedKey = ("forecast", "ensemble"),
        history_key: NestedKey | None = ("belief", "history"),
        steps_key: NestedKey = "steps",
        observed_key: NestedKey = "observed",
        out_key: NestedKey = ("forecast", "observation"),
        clone_key: NestedKey = ("forecast", "clone"),
        out_observed_key: NestedKey = ("forecast", "observed"),
    ):
        out_keys = [out_key, clone_key, out_observed_key]
        in_keys = [in_key] if history_key is None else [in_key, history_key]
        super().__init__(
            nn.Identity() if curve is None else curve, in_keys, out_keys, optional_keys=[steps_key, observed_key]
        )
        reach = [torch.inf, torch.inf] if reach is None else reach
        register_constant(self, "reach", reach)
        check_values("reach", self.reach, above=0, infinite=True)

    def compute(self, forecast, *rest):
        """Returns the predicted observations, the ensemble that the analysis is to update, and the mask."""
        *history, steps, observed = rest
        history = history[0] if history else forecast[..., 5:].unflatten(-1, (-1, 2))
        past = within_pair(steps, history)
        way = forecast[..., 3:5] + torch.where(past, history, 0.0).sum(-2)
        # Neighbours are always observed, and so are uncertain forecasts: a filter that overestimates the speed would
        # otherwise stay without observations.
        least = way.mean(-2).abs()
        if way.shape[-2] > 1:  # an extended Kalman filter evaluates one point
            least = least - 2 * ensemble_var(way).sqrt()
        within_reach = (least <= self.reach).all(-1, keepdim=True)
        readable = within_reach | ~past.flatten(-2).any(-1)
        for value in (steps, observed):
            if value is not None:
                readable = readable & (value > 0)
        return self.module(way), torch.cat([forecast[..., :5], history.flatten(-2)], -1), readable


class ClonedPrior(AroundInitial):
    """Augments an initial belief by velocities of past steps, all equal to the present ones.

    Args:
        initial: writes an ensemble ``[*B, E, 5]``, or a mean ``[*B, 5]`` and a covariance ``[*B, 5, 5]``, of
            [x, y, theta, v, theta_dot].
        lags: past steps to carry, L: one less than the longest span of a reading.

    Raises:
        ValueError: if ``lags`` is not positive.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import AroundState
        >>> start = ClonedPrior(AroundState([0.0, 0.0, 0.0, 0.3, 0.02], ensemble_size=8), lags=2)
        >>> start(TensorDict({"state": torch.zeros(5)}))["belief", "ensemble"].shape
        torch.Size([8, 9])
    """

    place = "initial"
    derived = Initial.derived  # entries of the wrapped module have another size

    def __init__(self, initial: TensorDictModuleBase, lags: int):
        check_count("lags", lags)
        super().__init__(initial)
        self.input_dim, self.state_dim = 5, 5 + 2 * lags
        eye = torch.eye(5, dtype=torch.get_default_dtype())
        self.register_buffer("copies", torch.cat([eye, *[eye[3:]] * lags]))

    def on_entries(self, entries, call):
        """Returns the belief."""
        written = self.run_inside(entries, call)
        for key, value in written.items():
            name, copies = key[-1] if isinstance(key, tuple) else key, self.copies.to(value.dtype)
            if name == "cov":
                written[key] = copies @ value @ copies.mT
            elif value.shape[-1] == 5:  # ensemble, mean, variances; weights have no state dimension
                written[key] = value @ copies.mT
        return written


class ClonedTransition(Wrapper, Transition):
    """Augments a transition by the velocities of past steps, the latest first, and shifts them by one.

    Args:
        transition: forecasts ensembles ``[*B, E, 5]``, see :class:`torch_denkf.applications.car.UnicycleTransition`;
            its keys are kept.
        history_key: key from which ``transition`` reads the velocities of past steps, the present ones first, if it
            does.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.applications.car.modules.unicycle import UnicycleTransition
        >>> cloned = ClonedTransition(UnicycleTransition(torch.zeros_like, dt=0.1))
        >>> state = torch.tensor([[0.0, 0.0, 0.0, 10.0, 0.0, 9.0, 0.0, 8.0, 0.0]])
        >>> cloned(TensorDict({("belief", "ensemble"): state}))["forecast", "ensemble"].tolist()
        [[1.0, 0.0, 0.0, 10.0, 0.0, 10.0, 0.0, 9.0, 0.0]]
    """

    place = "transition"

    def __init__(self, transition: SubModel, *, history_key: NestedKey = ("belief", "history")):
        check_module("transition", transition)
        self_made = unravel_key(history_key)
        super().__init__(transition, [key for key in reads(transition)[0] if key != self_made])
        self.history_key = self_made

    def on_entries(self, entries, call):
        """Returns the forecast ensemble."""
        key, out_key = unravel_key(self.in_keys[0]), unravel_key(self.out_keys[0])
        state = self.required(entries, key)
        work = {**entries, key: state[..., :5], self.history_key: state[..., 3:].unflatten(-1, (-1, 2))}
        written = self.run_inside(work, call)
        return {**written, out_key: torch.cat([written[out_key], state[..., 3:-2]], -1)}


def within_pair(steps: torch.Tensor | None, history: torch.Tensor) -> torch.Tensor:
    """Returns a mask of the past steps between the two frames of a pair: ``[*B, 1, L, 1]``."""
    lags = torch.arange(1, history.shape[-2] + 1, device=history.device)
    steps = torch.ones(1, dtype=torch.int64, device=history.device) if steps is None else steps
    return (lags < steps)[..., None, :, None]
