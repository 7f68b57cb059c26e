"""Parts for filters of several sensors: renamed keys, delayed readings, joint readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F

from torch_denkf._checks import check_mask
from torch_denkf.functional.linalg import semidefinite_root
from torch_denkf.functional.manifolds import Space, is_flat
from torch_denkf.modules import ConstantNoise, LinearTransition, MappedNoise
from torch_denkf.modules.around import Wrapper, passes_on
from torch_denkf.running import check_module, linearise, marks_of, reads, run_module, writes
from torch_denkf.submodel import Call, Entries, Sensor, SubModel, Update

__all__ = ["JoinedObservation", "JoinedReading", "LinearMembers", "OfOwnErrors", "Renamed", "StateObservation"]


@passes_on(Sensor)
class Renamed(Wrapper, Sensor):
    """Wraps a module to read and write under other keys, so that a filter can have two of a kind.

    Args:
        module: any module of a filter; its noise keeps its place.
        keys: maps the module's keys to the new ones.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import ConstantNoise
        >>> noise = Renamed(ConstantNoise([0.5], in_key="wheel"), {("sensor", "noise"): "wheel_noise"})
        >>> noise(TensorDict({"wheel": torch.zeros(1)}))["wheel_noise"]
        tensor([0.2500])
    """

    def __init__(self, module: TensorDictModuleBase, keys: Mapping[NestedKey, NestedKey]):
        check_module("module", module)
        names = {unravel_key(key): unravel_key(name) for key, name in keys.items()}
        needed, optional = reads(module)
        new = [[names.get(key, key) for key in group] for group in (needed, writes(module), optional)]
        super().__init__(module, new[0], new[1], optional_keys=new[2])
        self.names = names
        self.marks = {names.get(made, made): names.get(key, key) for made, key in marks_of(module).items()}

    def on_entries(self, entries, call):
        """Returns the entries that the module writes."""
        inside = {key: value for key, value in entries.items() if key not in self.names}
        inside.update({key: entries[name] for key, name in self.names.items() if name in entries})
        written = self.run_inside(inside, call)
        return {self.names.get(key, key): value for key, value in written.items()}


class OfOwnErrors(Wrapper):
    """Observation model of one sensor for a state that is augmented by the biases of several sensors.

    Args:
        observation: observation model of the system state, followed by the sensor's own errors, if it has any.
        own: indices of these among all errors.
        total: number of errors in the state.
    """

    def __init__(self, observation: TensorDictModuleBase, own: Sequence[int], total: int):
        super().__init__(observation)
        self.own, self.total = list(own), total

    def on_entries(self, entries, call):
        """Returns the predicted observations."""
        key, state = self._seen(entries)
        return self.run_inside({**entries, key: state}, call)

    def linearised(self, entries, call):
        """Returns the Jacobian of the model, with zeros for the errors of other sensors."""
        key, state = self._seen(entries)
        found = linearise(self.module, {**entries, key: state}, call)
        if found is None:
            return None
        written, matrix, sides = found
        begin = state.shape[-1] - len(self.own)
        whole = F.pad(matrix[..., :begin], (0, self.total))
        return written, whole.index_add(-1, _places(self.own, begin, whole), matrix[..., begin:]), sides

    def _seen(self, entries: Entries) -> tuple[NestedKey, Tensor]:
        """Returns the key and the value of the state that the sensor observes."""
        key = unravel_key(self.in_keys[0])
        system, errors = self.required(entries, key).tensor_split([-self.total], -1)
        return key, torch.cat([system, errors[..., self.own]], -1)


class LinearMembers(SubModel):
    """Moves the members of an ensemble as a linear transition moves a mean, :math:`F x + B a`.

    Args:
        transition: linear transition that has the matrices and is trained.

    Example:
        >>> from tensordict import TensorDict
        >>> move = LinearMembers(LinearTransition(2 * torch.eye(1), torch.eye(1)))
        >>> move(TensorDict({("belief", "ensemble"): torch.ones(3, 1)}))["forecast", "ensemble"].flatten()
        tensor([2., 2., 2.])
    """

    def __init__(self, transition: LinearTransition):
        keys = [("belief", "ensemble"), *([] if transition.control is None else [transition.action_key])]
        super().__init__(transition, keys, [("forecast", "ensemble")])

    def compute(self, ensemble, *action):
        """Returns the forecast."""
        moved = ensemble @ self.module.matrix.mT
        return moved if not action else moved + (action[0].to(moved.dtype) @ self.module.control.mT).unsqueeze(-2)

    def jacobian(self, ensemble, *action):
        """Returns the forecast and F."""
        return self.compute(ensemble, *action), self.module.matrix

    def process_noise(self) -> TensorDictModuleBase:
        """Returns the module that writes Q."""
        if isinstance(self.module.noise, nn.Module):
            return self.module.noise
        unit = torch.ones_like(self.module.noise[0])
        return MappedNoise(
            ConstantNoise(unit, in_key=("belief", "mean"), out_key=("forecast", "noise")),
            semidefinite_root(self.module.noise),
        )


class StateObservation(Wrapper, Update):
    """Observation model of one sensor for the present state, or for the earlier state of a delayed reading.

    Args:
        observation: observation model of ensembles, e.g. :class:`Select`; its first input key is the state, its first
            output key the prediction.
        ensemble_key: the states to observe, ``[*B, E, S]``; without ``past_key`` they contain the lag window, the
            latest first: ``[*B, E, (L + 1) S]``.
        predicted_key: predicted observations, ``[*B, E, O]``.
        reading_keys: keys of the reading and its noise.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``.
        delay: latency of the readings in steps.
        late_key: optional entry with the latency of each reading, ``[*B, 1]`` int64, 0 to L.
        past_key: the last L states, ``[*B, E, L, S]``.
        state_dim: S, if there is a lag window: then the mask is written, too.
        seen_key: written mask ``[*B, O]`` or ``[*B, 1]``: a reading of a time before the episode, or before the lag
            window, is not observed.
        age_key: age of the oldest state one step ago, in steps, ``[*B, 1]``.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import Select
        >>> past = {"ensemble": torch.tensor([[5.0]]), "past": torch.tensor([[[4.0], [3.0]]])}
        >>> model = StateObservation(
        ...     Select([0]), ("forecast", "ensemble"), "predicted", reading_keys=["gps"], observed_key="gps_observed",
        ...     delay=2, past_key=("forecast", "past"), state_dim=1,
        ... )
        >>> model(TensorDict({"forecast": past, "smoothed": {"age": torch.tensor([0])}}))["predicted"]
        tensor([[3.]])
    """

    def __init__(
        self,
        observation: TensorDictModuleBase,
        ensemble_key: NestedKey,
        predicted_key: NestedKey,
        *,
        reading_keys: Sequence[NestedKey],
        observed_key: NestedKey,
        delay: int = 0,
        late_key: NestedKey | None = None,
        past_key: NestedKey | None = None,
        state_dim: int | None = None,
        seen_key: NestedKey = ("forecast", "observed"),
        age_key: NestedKey = ("smoothed", "age"),
    ):
        check_module("observation", observation)
        needed, optional = ([unravel_key(key) for key in keys] for keys in reads(observation))
        self_made = unravel_key(observation.in_keys[0])
        in_keys = [ensemble_key, *(key for key in needed if key != self_made)]
        out_keys, optional_keys = [predicted_key], [observed_key, *optional]
        if state_dim is not None:
            in_keys += [age_key] + ([] if past_key is None else [past_key])
            out_keys, optional_keys = [predicted_key, seen_key], optional_keys + ([late_key] if late_key else [])
        super().__init__(observation, in_keys, out_keys, optional_keys=optional_keys)
        self.delay, self.state_dim = delay, state_dim
        self._in_key, self._out_key = self_made, unravel_key(observation.out_keys[0])
        keys = (ensemble_key, predicted_key, observed_key, age_key)
        self.ensemble_key, self.predicted_key, self.observed_key, self.age_key = map(unravel_key, keys)
        self.late_key = None if late_key is None else unravel_key(late_key)
        self.past_key = None if past_key is None else unravel_key(past_key)
        self.reading_keys = list(map(unravel_key, reading_keys))

    def on_entries(self, entries, call):
        """Returns the predicted observations, and the mask."""
        states, written = self.required(entries, self.ensemble_key), {}
        if self.state_dim is not None:
            if self.past_key is None:
                whole = states.unflatten(-1, (-1, self.state_dim))
            else:
                whole = torch.cat([states.unsqueeze(-2), self.required(entries, self.past_key)], -2)
            states, mask = self._of_its_time(whole, entries)
            written[unravel_key(self.out_keys[1])] = mask
        return {self.predicted_key: self.run_inside({**entries, self._in_key: states}, call)[self._out_key], **written}

    def linearised(self, entries, call):
        """Returns the Jacobian of the model, if it observes only the present state."""
        if self.state_dim is not None:
            return None
        found = linearise(self.module, {**entries, self._in_key: self.required(entries, self.ensemble_key)}, call)
        return None if found is None else ({self.predicted_key: found[0][self._out_key]}, *found[1:])

    def seen(self, entries: Entries, call: Call) -> tuple[Tensor, Tensor | None]:
        """Returns the predicted observations ``[*B, E, O]``, and the observed mask, if there is one."""
        written = run_module(self, entries, call)
        mask = entries.get(self.observed_key) if self.state_dim is None else written[unravel_key(self.out_keys[1])]
        return written[self.predicted_key], mask

    def _of_its_time(self, whole: Tensor, entries) -> tuple[Tensor, Tensor]:
        """Returns the states ``[*B, E, S]`` at the reading's time, out of ``[*B, E, L + 1, S]``, and the mask."""
        observed, age = entries.get(self.observed_key), entries.get(self.age_key)
        check_mask(str(self.observed_key), observed)
        if age is None:  # a call that infers shapes has no age
            age = torch.full_like(whole[..., 0, 0, :1], whole.shape[-2], dtype=torch.int64)
        late = None if self.late_key is None else entries.get(self.late_key)
        if late is None:
            states, fits = whole[..., self.delay, :], age + 1 >= self.delay
        else:
            last = whole.shape[-2] - 1
            index = late.long().clamp(0, last)[..., None, None].expand(*whole.shape[:-2], 1, whole.shape[-1])
            states = whole.gather(-2, index).squeeze(-2)
            fits = (late >= 0) & (late <= last) & (late <= age + 1)
        return states, fits if observed is None else observed & fits


class JoinedObservation(SubModel):
    """Concatenates the predicted observations of several sensors, and their masks.

    Args:
        models: observation models by name, in the order of the readings.
        spaces: space of each reading; ``None`` for vectors.
        predicted_key: predicted observations ``[*B, E, O]``, O the total dimension.
        observed_key: mask ``[*B, O]``; on spaces, of tangents.
    """

    def __init__(
        self,
        models: Mapping[str, StateObservation],
        spaces: Sequence[Space | None],
        *,
        predicted_key: NestedKey,
        observed_key: NestedKey,
    ):
        needed, optional = ({} for _ in range(2))
        for model in models.values():
            must, may = reads(model)
            needed.update(dict.fromkeys(must))
            optional.update(dict.fromkeys(may))
        super().__init__(
            nn.ModuleDict(models), list(needed), [predicted_key, observed_key], optional_keys=list(optional)
        )
        self.spaces = list(spaces)

    def parts(self):
        """Returns the models."""
        return dict(self.module.items())

    def on_entries(self, entries, call):
        """Returns the predicted observations, and the mask."""
        pairs = [model.seen(entries, call.part(name)) for name, model in self.module.items()]
        return self._joined([predicted for predicted, _ in pairs], [mask for _, mask in pairs])

    def linearised(self, entries, call):
        """Returns the stacked Jacobians, if all readings are vectors."""
        given = [linearise(model, entries, call) for model in self.module.values()]
        found = [each for each in given if each is not None and is_flat(*each[2] or ())]
        if len(found) < len(given):
            return None
        predicted = [
            written[model.predicted_key] for (written, *_), model in zip(found, self.module.values(), strict=True)
        ]
        rows = [
            matrix.expand(*values.shape, matrix.shape[-1])
            for values, (_, matrix, _) in zip(predicted, found, strict=True)
        ]
        masks = [entries.get(model.observed_key) for model in self.module.values()]
        return self._joined(predicted, masks), torch.cat(rows, -2), None

    def _joined(self, predicted: list[Tensor], masks: Sequence[Tensor | None]) -> Entries:
        seen = []
        for values, mask, space in zip(predicted, masks, self.spaces, strict=True):
            like = values[..., 0, : None if space is None else space.tangent_dim]
            seen.append(torch.ones_like(like, dtype=torch.bool) if mask is None else mask.expand(like.shape))
        return self.by_key((torch.cat(predicted, -1), torch.cat(seen, -1)))


class JoinedReading(Sensor):
    """Concatenates the readings of several sensors, and their noise.

    Args:
        reading_keys: readings ``[*B, O]``, or samples ``[*B, E, O]``, whose mean is taken.
        noise_keys: variances ``[*B, O]`` or covariances ``[*B, O, O]``, in the same order.
        spaces: space of each reading; ``None`` for vectors.
        observation_key: all readings, ``[*B, O]``.
        noise_key: all variances ``[*B, O]``, or one covariance ``[*B, O, O]`` if any sensor has one.
        observation_dim: total O, if it is known.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"a": torch.ones(4, 2), "b": torch.zeros(1), "qa": torch.ones(2), "qb": torch.ones(1)})
        >>> join = JoinedReading(["a", "b"], ["qa", "qb"], [None, None], observation_key="c", noise_key="qc")
        >>> join(td)["c"]
        tensor([1., 1., 0.])
    """

    joins_readings = True  # a reading that is left out leaves out this module

    def __init__(
        self,
        reading_keys: Sequence[NestedKey],
        noise_keys: Sequence[NestedKey],
        spaces: Sequence[Space | None],
        *,
        observation_key: NestedKey,
        noise_key: NestedKey,
        observation_dim: int | None = None,
    ):
        super().__init__(nn.Identity(), [*reading_keys, *noise_keys], [observation_key, noise_key])
        self.observation_dim = observation_dim
        self.spaces = list(spaces)

    def compute(self, *values, batch_size):
        """Returns the readings and their noise."""
        count, size = len(self.spaces), len(batch_size)
        readings = [
            value if value.ndim == size + 1 else value.mean(-2) if space is None else space.mean(value)
            for value, space in zip(values[:count], self.spaces, strict=True)
        ]
        noises, begin = list(values[count:]), 0
        total = sum(noise.shape[-1] for noise in noises)  # of tangents
        if any(noise.ndim > size + 1 for noise in noises):
            for index, noise in enumerate(noises):
                noise = noise if noise.ndim > size + 1 else noise.diag_embed()
                noises[index] = F.pad(noise, (begin, total - begin - noise.shape[-1]))
                begin += noise.shape[-1]
            return torch.cat(readings, -1), torch.cat(noises, -2)
        return torch.cat(readings, -1), torch.cat(noises, -1)


def _places(numbers: Sequence[int], begin: int, like: Tensor) -> Tensor:
    return torch.tensor([begin + number for number in numbers], dtype=torch.int64, device=like.device)
