"""Roles of a filter's parts, and what each role declares: sensor, initial belief, transition, update."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TypeVar

from tensordict import NestedKey, unravel_key
from torch import Tensor, nn

from torch_denkf.functional.manifolds import Space
from torch_denkf.submodel import Call, Entries, Noise, SubModel

__all__ = ["Initial", "Sensor", "Transition", "Update", "role"]


class Sensor(SubModel):
    """Makes a reading, its noise, or a mask of it.

    Attributes:
        observation_dim: O of what it writes, where it is known beforehand.
        judges_reading: whether it writes no reading, but judges that of the module before it.
        joins_readings: whether it looks at several readings together, and cannot do without one of them.
        marks: masks that it derives where it finds missing readings, and the masks that they are derived from.
    """

    observation_dim: int | None = None
    judges_reading: bool = False
    joins_readings: bool = False
    marks: Mapping[NestedKey, NestedKey] = MappingProxyType({})


class Initial(SubModel):
    """Writes the initial belief of an episode.

    Attributes:
        state_dim: S; on a space, the numbers of a tangent.
        ensemble_size: E; ``None`` for a belief without members.
        space: in which the states live; ``None`` for plain numbers.
        input_dim: size of what it reads, where that is not S.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> class Around(Initial):
        ...     def __init__(self, size):
        ...         super().__init__(nn.Identity(), ["start"], [("belief", "ensemble")])
        ...         self.ensemble_size, self.state_dim = size, 2
        ...
        ...     def compute(self, start):  # [*B, S]
        ...         return start.unsqueeze(-2).expand(*start.shape[:-1], self.ensemble_size, 2).clone()
        >>> Around(4)(TensorDict({"start": torch.zeros(3, 2)}, [3]))["belief", "ensemble"].shape
        torch.Size([3, 4, 2])
    """

    state_dim: int | None = None
    ensemble_size: int | None = None
    space: Space | None = None
    input_dim: int | None = None

    def derived(self, carried: Entries) -> Entries:
        """Returns further entries of the belief that follow from those that are carried on, by key."""
        return {}


class Transition(SubModel):
    """Forecasts the belief of the next time.

    Attributes:
        mask_key: a mask that says whether the frame of the next time is observed, where the forecast depends on it.
    """

    mask_key: NestedKey | None = None

    def without_step(self, entries: Entries) -> Entries:
        """Returns what it writes in addition to the forecast where an episode begins and no step leads there."""
        return {}


class Update(SubModel):
    """Takes in a reading: an analysis, or the likelihood of particles.

    Attributes:
        reading_keys: the entries of the reading: the reading itself, and behind it its noise.
        observed_key: the mask that hides them, ``[*B, 1]`` or ``[*B, O]``.
        predicted_key: the predicted reading, ``[*B, E, O]``.
        noise_variance_key: the variances of the reading; they tell :meth:`draw_noise` how many components it has.
        info_prefix: prefix of the diagnostics.
        space: in which the states live; ``None`` for plain numbers.
        reading_space: in which the reading lives; ``None`` for plain numbers.
        observation_dim: O of the reading, where it is known beforehand.
        reads_components: whether each component of a reading counts, and is hidden, by itself.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> class Halfway(Update):
        ...     def __init__(self):
        ...         in_keys = [("forecast", "mean"), "reading"]
        ...         super().__init__(nn.Identity(), in_keys, [("belief", "mean")], optional_keys=["observed"])
        ...         self.reading_keys, self.observed_key = ["reading"], "observed"
        ...
        ...     def compute(self, mean, reading, observed=None):  # [*B, S], [*B, S]
        ...         both = (mean + reading) / 2
        ...         return both if observed is None else torch.where(observed, both, mean)
        >>> td = TensorDict({"forecast": {"mean": torch.zeros(1)}, "reading": torch.ones(1)})
        >>> Halfway()(td)["belief", "mean"]
        tensor([0.5000])
    """

    reading_keys: Sequence[NestedKey] = ()
    observed_key: NestedKey | None = None
    predicted_key: NestedKey = ("forecast", "observation")
    noise_variance_key: NestedKey | None = None
    info_prefix: str | None = None
    space: Space | None = None
    reading_space: Space | None = None
    observation_dim: int | None = None
    reads_components: bool = False

    def reading_dims(self, entries: Entries, call: Call) -> Sequence[int]:
        """Returns how many numbers each of ``reading_keys`` has, to put zeros behind a mask where it is missing.

        By default O: ``observation_dim``, or what :attr:`predicted_key` holds. On a space the noise is of tangents.

        Raises:
            KeyError: if that is not known.
        """
        if self.reading_space is not None:
            others = [self.reading_space.tangent_dim] * (len(self.reading_keys) - 1)
            return [self.reading_space.point_dim, *others]
        dim, predicted = self.observation_dim, entries.get(self.predicted_key)
        if predicted is not None:
            dim = predicted.shape[-1]
        if dim is None:
            raise KeyError(
                f"{type(self).__name__} does not know how many numbers {list(self.reading_keys)} have, so that they "
                f"cannot be left out. Hide them with their mask, {self.observed_key!r}; or let reading_dims() of "
                f"{type(self).__name__} say it."
            )
        return [dim] * len(self.reading_keys)

    def with_mask(self, entries: Entries, call: Call) -> Entries:
        """Returns the entries with the mask of the reading, where a module inside makes it."""
        return entries

    @property
    def updates_ensemble(self) -> bool:
        """Whether it reads an ensemble, what its members predict of a reading, the reading, and its noise; and a mask.

        Such an analysis can be given a past to correct (:meth:`move_past`).
        """
        keys = [unravel_key(key) for key in self.in_keys]
        read = [unravel_key(key) for key in (self.predicted_key, *self.reading_keys)]
        return keys[1:] == read and self.optional_keys == [self.observed_key]

    def move_past(
        self,
        past: Tensor,
        predicted: Tensor,
        observation: Tensor,
        variance: Tensor,
        observed: Tensor | None = None,
        *,
        noise: Noise = None,
    ) -> Tensor:
        """Updates earlier states of the members of an ensemble with the same reading.

        By default as :meth:`compute` would if they were one state of L times S components, inflation and the like
        included. Where :meth:`compute` holds anything of S components, write this method, too.

        Args:
            past: ``[*B, E, L, S]``.
            predicted: predicted observations ``[*B, E, O]``.
            observation: learned observations ``[*B, E, O]``, or one reading ``[*B, O]``.
            variance: of the reading, ``[*B, O]``.
            observed: mask ``[*B, 1]`` or ``[*B, O]``; ``None`` where all is observed.
            noise: what :meth:`compute` was given: the same draws.

        Returns:
            The updated past, ``[*B, E, L, S]``.

        Raises:
            RuntimeError: if :meth:`compute` does not take so many components.
        """
        extra = {"noise": noise} if self.draws else {}
        try:
            out = self.by_key(self.compute(past.flatten(-2), predicted, observation, variance, observed, **extra))
        except RuntimeError as error:
            raise RuntimeError(
                f"{type(self).__name__} is to correct earlier states, and its compute() fails on their "
                f"{past.shape[-2]} times {past.shape[-1]} components: write {type(self).__name__}.move_past()."
            ) from error
        return out[self.out_keys[0]].unflatten(-1, past.shape[-2:])

    def aligned(self, entries: Entries) -> Entries:
        """Returns the entries with all angles on one turn, so that they can be averaged like other numbers."""
        return entries

    def on_aligned(self, entries: Entries, call: Call) -> Entries:
        """Does what :meth:`on_entries` does, on entries that are :meth:`aligned` already."""
        return self.on_entries(entries, call)


R = TypeVar("R", bound=SubModel)
_DEFAULTS = {kind: kind(nn.Identity(), [], []) for kind in (SubModel, Sensor, Initial, Transition, Update)}


def role(module: object, kind: type[R]) -> R:
    """Returns a module in its role; one that does not have it, as any TensorDict module may, with the role's defaults.

    Args:
        module: of a filter.
        kind: :class:`Sensor`, :class:`Initial`, :class:`Transition`, :class:`Update`, or any :class:`SubModel`.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> print(role(TensorDictModule(nn.Linear(2, 1), ["x"], ["y"]), Update).info_prefix)
        None
    """
    return module if isinstance(module, kind) else _DEFAULTS[kind]
