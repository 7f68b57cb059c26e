"""Training objectives for one part of a filter, which train only that part."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from math import log
from typing import Literal, Unpack

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.modules.tensordict_module.rnn import set_recurrent_mode

from torch_denkf._arguments import check_key
from torch_denkf._checks import check_count, check_values, flag_value
from torch_denkf._registered import diagnosis
from torch_denkf._slices import one_earlier
from torch_denkf.filters import Filter
from torch_denkf.filters.finish import Record
from torch_denkf.filters.gather import controls_of
from torch_denkf.functional.manifolds import Space
from torch_denkf.modules.tensors import as_floating
from torch_denkf.objectives import _terms
from torch_denkf.objectives._labels import Keys, Targets
from torch_denkf.objectives.filter_loss import FilterLoss, ReadingsOptions, StateOptions, Term
from torch_denkf.running import reads, reads_of, run_module, run_modules
from torch_denkf.submodel import Call, Entries, Initial, role

__all__ = ["ObservationLoss", "SensorLoss", "TransitionLoss"]


class ObservationLoss(FilterLoss):
    r"""Scores a filter's observation model on true states, ``[*B]``.

    Its term ``loss_observation`` is the squared error of :math:`h_\psi(x_t)` against the true observation, as
    in :class:`~torch_denkf.objectives.DEnKFLoss`. The parameters of the loss are those of the model.

    Args:
        filter: the filter whose observation model is trained; a module with an ``observe()`` method.
        **options: ``observation_scale``, ``reading_space`` and ``reduction``, see :class:`ReadingsOptions`.

    Raises:
        ValueError: if a scale is not positive, or labels have another shape.
        KeyError: if the filter has no such model, or an entry is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> plain = KalmanFilter(one, 3 * one, process_noise=[1.0], noise=[1.0], mean=torch.zeros(1), cov=one)
        >>> loss = ObservationLoss(plain)
        >>> td = TensorDict({"state": torch.ones(8, 1), "target_observation": torch.ones(8, 1)}, [8])
        >>> loss(td)["loss_observation"]
        tensor(4.)
    """

    _AcceptedKeys = default_keys = Keys
    SCORES = ("mse",)

    def __init__(self, filter: Filter, **options: Unpack[ReadingsOptions]):
        super().__init__(filter, [_terms.Observation()], score="mse", **options)

    def _trained(self):
        return [] if self.reading.model is None else [self.reading.model]

    def _needed(self):
        return [self.tensor_keys.state, self.tensor_keys.target_observation]

    def _run(self, tensordict):
        return tensordict


class SensorLoss(FilterLoss):
    r"""Scores the readings of a filter's sensor, without the filter, on any batch of frames ``[*B]``. With two or
    more dimensions the last is time, for modules that distinguish times.

    It runs only modules that read frames and are needed for the score: the sensor, and with ``noise`` its noise
    model. Other sensors of the filter, and their readings, may be missing.

    ========================  =====================================================================================
    ``loss_sensor``           score of the sensor's samples against the true observation, as in
                              :class:`~torch_denkf.objectives.DEnKFLoss`
    ``loss_noise``            negative log-likelihood of the true observation under N(mean of the samples, R), nats
    ``loss_visible``          binary cross entropy of the sensor's visibility, for a filter with a
                              :class:`~torch_denkf.imperfect.Visibility`
    ========================  =====================================================================================

    Terms with weight zero are neither computed nor returned; the others are returned with their weight applied. A frame
    is scored if the sensor observed all of it and the true observation is known, see :class:`ReadingsOptions`. The
    parameters of the loss are those of the modules it runs.

    Args:
        filter: the filter whose sensor is trained.
        score: score of the samples: ``"crps"`` (fair), ``"energy"`` (fair) or ``"mse"`` (of the mean). For one sample
            the first two are its absolute error, and the length of its error: the scores of a point.
        sensor: weight of ``loss_sensor``.
        noise: weight of ``loss_noise``. R must be computed from frames only.
        visible: weight of ``loss_visible``; its labels are ``"visible"``, and may have gaps.
        **options: ``observation_scale``, ``reading_space`` and ``reduction``, see :class:`ReadingsOptions`.

    Raises:
        ValueError: on an unknown score, a scale that is not positive, or labels of another shape.
        KeyError: if an entry that a term needs is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import DEnKF
        >>> loss = SensorLoss(DEnKF.paper(5, 2, ensemble_size=4), noise=0.1)
        >>> frames = TensorDict({"pixels": torch.rand(3, 6, 50, 150), "target_observation": torch.randn(3, 2)}, [3])
        >>> sorted(loss(frames).keys())
        ['loss_noise', 'loss_sensor']
    """

    @dataclass
    class _AcceptedKeys(Keys):
        """The input keys of the loss.

        Attributes:
            state: true state ``[*B, S]``, read if there is no true observation.
            state_observed: mask of its known components, ``[*B, 1]`` or ``[*B, S]``.
            target_observation: true observation ``[*B, O]``; if it is missing and the filter's observation model has
                no parameters, that model's observation of the true state is used.
            target_observed: mask of its known components, ``[*B, 1]`` or ``[*B, O]``.
            observed: mask of the reading, ``[*B, 1]`` or ``[*B, O]``; by default that of the sensor's update.
            sensor: the sensor's samples ``[*B, E, O]`` or readings ``[*B, O]``, or the name of one of several sensors;
                by default the output of the filter's only sensor.
            noise: R, variances ``[*B, O]`` or a covariance ``[*B, O, O]``; by default that of the sensor's update.
        """

        noise: NestedKey | None = None

    default_keys = _AcceptedKeys
    SCORES = _terms.MEMBER_SCORES

    def __init__(
        self,
        filter: Filter,
        *,
        score: Literal["crps", "energy", "mse"] = "crps",
        sensor: float = 1.0,
        noise: float = 0.0,
        visible: float = 0.0,
        **options: Unpack[ReadingsOptions],
    ):
        own = [_terms.Sensor(sensor), _terms.Noise(noise), _terms.Visible(visible)]
        super().__init__(filter, own, score=score, **options)

    def _trained(self):
        return [module for _, module in self._placed()]

    def _placed(self):
        """Returns the modules that read only frames and are needed for the score: the sensor; R and a head, if any."""
        keys, reading, placed = self.tensor_keys, self.reading, []
        wanted = {reading.samples, reading.observed}
        wanted |= {unravel_key(keys.noise or reading.noise)} if "noise" in self.weights else set()
        wanted |= {unravel_key(keys.visible)} if "visible" in self.weights else set()
        for place, module in reversed(self.filter.structure.frames):
            if not wanted.isdisjoint(map(unravel_key, module.out_keys)):
                placed.append((place, module))
                wanted.update(key for keys in reads(module) for key in keys)
        return placed[::-1]

    def _needed(self):
        """Lists the inputs of the modules, and the true observation, or the state from which it is computed."""
        keys, model = self.tensor_keys, self.reading.model
        unknown = model is None or _terms.learns(model)
        needed = list(reads_of(self._trained())[0])
        if {"sensor", "noise"} & set(self.weights):
            needed.append(keys.target_observation if unknown else keys.state)
        return [*needed, keys.target_visible] if "visible" in self.weights else needed

    def _run(self, tensordict):
        size, out = tensordict.batch_size, tensordict.copy()
        call = Call(size, time=len(size) > 1)
        missing = [key for key in reads_of(self._trained())[0] if tensordict.get(key, None) is None]
        if missing:
            raise diagnosis().missing_entry(type(self).__name__, missing, tensordict.keys(True, True))
        # As in Filter.sequence: a recurrent network among these modules reads whole sequences.
        with set_recurrent_mode(True) if call.time else nullcontext():
            written = run_modules(self._placed(), self.filter.entries_of(tensordict), call)
        for key, value in written.items():
            out.set(key, value)
        return out


class TransitionLoss(FilterLoss):
    r"""Scores the forecast of one step from the true state at t-1 against the true state at t, on ``[*B, T]``.

    Nothing is filtered: all steps run at once, each from the truth. The members of an ensemble filter start at the
    truth, or around it by ``spread``; the transition's own noise makes them differ. A filter with a mean and a
    covariance starts from N(truth, spread²). The only term is ``loss_transition``. The first element of a sequence or
    of an episode is not scored. Neither are elements with gaps in their labels: a step starts where all of the state
    is known, and is scored against the known components one step later, see :class:`ReadingsOptions`. The parameters
    of the loss are those of the transition.

    Args:
        filter: the filter whose transition is trained.
        score: ``"crps"``, ``"energy"`` or ``"mse"`` of members, as in :class:`~torch_denkf.objectives.DEnKFLoss`;
            ``"crps"``, ``"nll"`` or ``"mse"`` of a Gaussian, as in :class:`~torch_denkf.objectives.GaussianLoss`. A
            transition without noise has only the spread ``spread``: train it by ``"mse"``.
        spread: standard deviation around the truth, in the state's units: one number or ``[S]``, on a space
            ``[D]`` for tangents. Members are drawn again in each call.
        members: E; by default the number of the initial belief. One member is a point, only for ``"mse"``.
        belief: prefix of the carried ``ensemble``, or of ``mean`` and ``cov``.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (``[*B, T]``, zero for elements that are not scored).
        **options: ``dims``, ``state_scale`` and ``space``, see :class:`StateOptions`.

    Raises:
        ValueError: on an unknown score, a scale that is not positive, a negative spread, too few members, a filter that
            carries neither members nor moments, labels of a part of the state, a batch without time, or slices that
            are not marked.
        KeyError: if an entry is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> plain = KalmanFilter(one, one, process_noise=[1.0], noise=[1.0], mean=torch.zeros(1), cov=one)
        >>> loss = TransitionLoss(plain, score="mse")
        >>> loss(TensorDict({"state": torch.tensor([[0.0], [1.0], [3.0]])}, [3]))["loss_transition"]  # (1 + 4) / 2
        tensor(2.5000)
    """

    _AcceptedKeys = default_keys = Keys

    def __init__(
        self,
        filter: Filter,
        *,
        score: Literal["crps", "energy", "nll", "mse"] = "crps",
        spread: float | Sequence[float] | Tensor = 0.0,
        members: int | None = None,
        belief: str = "belief",
        reduction: Literal["mean", "sum", "none"] = "mean",
        **options: Unpack[StateOptions],
    ):
        check_key("belief", belief)
        found = members_of(filter, belief, members)
        self.SCORES = _terms.GAUSSIAN_SCORES if found is None else _terms.MEMBER_SCORES
        if members is not None:
            check_count(
                "members", members, least=1 if score == "mse" else 2, cure='One member has no spread: use score="mse"'
            )
        super().__init__(filter, [Step()], score=score, reduction=reduction, **options)
        self.belief, self.members = belief, found
        self.register_buffer("spread", as_floating(spread, "spread"))
        check_values("spread", self.spread, least=0, cure="It is a standard deviation, not negative")

    def _trained(self):
        return [self.filter.transition_module]

    def _needed(self):
        """Lists the inputs of the transition in addition to the belief, and the true state."""
        structure = self.filter.structure
        needed = [*structure.needed, *structure.controls]
        read = reads(self.filter.transition_module)[0]
        if not set(read).isdisjoint(structure.frame_keys):
            read = needed
        return [*(key for key in needed if key in read), self.tensor_keys.state]

    def _run(self, tensordict):
        if not tensordict.ndim:
            raise ValueError("A step needs two times, the last batch dimension; this tensordict has batch_size [].")
        self.filter.observe(Record("data", tensordict, tensordict.batch_size, {}, {}))
        truth = Targets(self, tensordict, tensordict).whole_state().values
        # So that other modules that read the true state get no NaN.
        known = tensordict.copy().set(self.tensor_keys.state, truth)
        around = {"spread": self.spread, "members": self.members, "space": self.space}
        written = forecasts_from_truth(self.filter, known, truth, self.belief, **around)
        return TensorDict(written, tensordict.batch_size)

    def _counts(self, tensordict):
        # Without a stored belief, for which the first element of a slice would be scored, although the truth before it
        # is unknown.
        stepped = self.filter.stepped(tensordict.exclude("previous"))
        known = Targets(self, tensordict, tensordict).whole_state().rows
        return stepped & one_earlier(known, tensordict.ndim - 1)


class Step(Term):
    """The score of a step from the truth."""

    name = "transition"

    def forward(self, out, truth):
        belief = truth.loss.belief
        if truth.loss.members is None:
            return _terms.score_moments(truth, out[belief, "mean"], out[belief, "cov"])
        return _terms.score_ensemble(truth, out[belief, "ensemble"])


def members_of(filter: Filter, belief: str, members: int | None) -> int | None:
    """Returns E, as given or of the initial belief; ``None`` for a filter with a mean and a covariance.

    Raises:
        ValueError: if the filter carries neither under the prefix ``belief``, or E is not known.
    """
    carry = filter.structure.carry
    if (belief, "ensemble") not in carry:
        if not {(belief, "mean"), (belief, "cov")} <= set(carry):
            raise ValueError(
                f"A step from a true state needs {(belief, 'ensemble')}, or {(belief, 'mean')} and {(belief, 'cov')}; "
                f"the filter carries {list(carry)}. Pass the prefix of its belief, belief=..."
            )
        return None
    members = role(filter.initial, Initial).ensemble_size if members is None else members
    if members is None:
        raise ValueError(f"{type(filter.initial).__name__} does not declare the number of members; pass members=...")
    return members


def forecasts_from_truth(
    filter: Filter,
    tensordict: TensorDictBase,
    truth: Tensor,
    belief: str,
    *,
    spread: Tensor,
    members: int | None,
    space: Space | None = None,
) -> Entries:
    """Forecasts every time of ``[*B, T]`` from the true state before.

    Other carried entries are read if they are stored, and else are those of the initial belief of that time.

    Args:
        filter: the filter.
        tensordict: actions, which are read one step earlier, and other inputs of the transition.
        truth: ``[*B, T, S]``; the first also stands for the time before it.
        belief: prefix of the belief.
        spread: standard deviation of members around the truth, or of the Gaussian, ``[S]`` or one number.
        members: E.
        space: space of the states; ``None`` for plain numbers.

    Returns:
        The forecast, by the names of the belief: ``(belief, "ensemble")`` and so on.
    """
    structure, size = filter.structure, tensordict.batch_size
    place, transition = structure.transition
    time, call = len(size) - 1, Call(size, time=True)
    entries = filter.entries_of(tensordict)
    if any(key in structure.frame_keys for keys in reads(transition) for key in keys):
        with torch.no_grad():  # these parts are not trained
            entries.update(run_modules(structure.frames, entries, call))
    carried = _belief_at(truth, belief, spread, members, space)
    others = [key for key in structure.carry if key not in carried and key not in entries]
    if others:
        without = {key: value for key, value in entries.items() if unravel_key(key) not in structure.belief}
        with torch.no_grad():
            start = run_module(filter.initial, without, call.part("initial"))
        entries.update({key: start[key] for key in others})
    entries.update(carried)
    for key in structure.carry:
        entries[key] = one_earlier(entries[key], time)
    entries.update(controls_of(structure, entries, time))
    written = run_module(transition, entries, call.part(place))
    return {key: written[forecast] for key, forecast in structure.forecast_of.items()}


def _belief_at(truth: Tensor, belief: str, spread: Tensor, members: int | None, space: Space | None) -> Entries:
    """Returns the entries of a belief at the truth, or around it by ``spread``."""
    size = truth.shape[-1] if space is None else space.tangent_dim
    std = spread.to(truth.dtype).expand(*truth.shape[:-1], size)
    if members is None:
        return {(belief, "mean"): truth, (belief, "cov"): std.square().diag_embed()}
    ensemble = truth.unsqueeze(-2).expand(*truth.shape[:-1], members, truth.shape[-1])
    if flag_value(spread.any()) is not False:
        away = std.unsqueeze(-2) * torch.randn_like(ensemble[..., :1].expand(*ensemble.shape[:-1], size))
        ensemble = ensemble + away if space is None else space.plus(ensemble, away)
    return {
        (belief, "ensemble"): ensemble,
        (belief, "log_weight"): torch.full_like(ensemble[..., 0], -log(members)),
        (belief, "mean"): truth,
        (belief, "var"): std.square(),
    }
