"""Parts of a filter: functions of tensors with keys of their inputs and outputs, and their roles.

Each part is a :class:`SubModel`. Its role declares further properties for the filter: a :class:`Sensor`, an
:class:`Initial` belief, a :class:`Transition` or an :class:`Update`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypeVar

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn

from torch_denkf._arguments import Checked
from torch_denkf._registered import diagnosis
from torch_denkf.functional.jacobians import is_older
from torch_denkf.functional.manifolds import Space

__all__ = ["Call", "Entries", "Initial", "Noise", "Sensor", "SubModel", "Transition", "Update", "in_role", "role"]

R = TypeVar("R", bound="SubModel")

#: Methods that determine what a sub-model computes, and methods that give its Jacobian.
_COMPUTES = frozenset({"compute", "on_entries", "forward", "observe", "move", "features", "_run"})
_JACOBIANS = frozenset({"jacobian", "linearised", "gradient", "move_and_gradient"})

#: Tensors by unravelled key, on which a step of a filter works.
Entries: TypeAlias = dict[NestedKey, Tensor]
#: The noise of one call of a sub-model: one tensor, several by name, or ``None`` for the deterministic forward.
Noise: TypeAlias = "Tensor | Mapping[str, Tensor] | None"


class Call(NamedTuple):
    """One call of a module on entries.

    Attributes:
        batch_size: ``[*B]``, in front of every entry.
        place: the module's place in the filter, e.g. ``"transition"``; its noise is ``("noise", place)``.
        sample: whether random modules draw; if not, they run their deterministic forward.
        time: whether the last dimension of ``batch_size`` is time.
        raw: whether process noise is added as it is given, because the caller has made its moments exact.
    """

    batch_size: torch.Size
    place: str = "self"
    sample: bool = True
    time: bool = False
    raw: bool = False

    def part(self, name: str) -> Call:
        """Returns the call of a part of the module."""
        return self._replace(place=name if self.place == "self" else f"{self.place}.{name}")


def flat_noise(noise: Noise | TensorDictBase, *place: str) -> Entries:
    """Returns noise as entries ``("noise", *place)``, or ``("noise", *place, name)`` if there are several tensors."""
    if noise is None:
        return {}
    if isinstance(noise, Tensor):
        return {("noise", *place): noise}
    if isinstance(noise, TensorDictBase):
        keys = noise.keys(True, True)
        return {("noise", *place, *((key,) if isinstance(key, str) else key)): noise.get(key) for key in keys}
    return {("noise", *place, name): value for name, value in noise.items()}


class SubModel(Checked, TensorDictModule):
    """A part of a filter: a function of tensors, with the keys of its inputs and outputs.

    A sub-class declares its keys in ``__init__`` and implements :meth:`compute`. Called on a TensorDict it reads and
    writes there like any TensorDict module; a filter calls :meth:`on_entries` on a dictionary instead, which is faster.
    Noise in the input is used instead of fresh noise: in a filter under ``("noise", place)``, for a sub-model alone
    under ``("noise", "self")``.

    Args:
        network: the module with the parameters; ``torch.nn.Identity()`` if there is none.
        in_keys: required inputs.
        out_keys: outputs.
        optional_keys: inputs that may be missing.

    Attributes:
        noise_names: names of the tensors that :meth:`draw_noise` draws: ``()`` for a deterministic sub-model, ``("",)``
            for one tensor without a name of its own.

    Example:
        >>> from tensordict import TensorDict
        >>> class Wind(SubModel):
        ...     def __init__(self):
        ...         super().__init__(nn.Identity(), [("forecast", "ensemble"), "wind"], [("forecast", "ensemble")])
        ...
        ...     def compute(self, ensemble, wind):  # [*B, E, S], [*B, S]
        ...         return ensemble + wind.unsqueeze(-2)
        >>> td = TensorDict({"forecast": {"ensemble": torch.zeros(8, 2)}, "wind": torch.ones(2)})
        >>> Wind()(td)["forecast", "ensemble"].mean()
        tensor(1.)
    """

    if TYPE_CHECKING:

        @property
        def noise_names(self) -> tuple[str, ...]:
            """Names the noise of a call: a tuple in the class, or a property."""

    else:
        noise_names = ()
    tangents_of: tuple[Space, Space] | None = None
    _wants: frozenset[str] = frozenset()

    def __init_subclass__(cls, **kwargs):
        super().__init_subclass__(**kwargs)
        # tensordict wraps every __init__ and so must come first; the signature of compute is read once per class.
        cls._wants = frozenset({"noise", "batch_size"} & inspect.signature(cls.compute).parameters.keys())
        if is_older(cls, _JACOBIANS, _COMPUTES):
            # The inherited Jacobian is that of another function.
            cls.jacobian, cls.linearised = SubModel.jacobian, SubModel.linearised  # type: ignore[method-assign]

    def __init__(
        self,
        network: Callable[..., Any],
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
        *,
        optional_keys: Sequence[NestedKey] = (),
    ):
        super().__init__(network, in_keys=list(in_keys), out_keys=list(out_keys))
        required = set(map(unravel_key, self.in_keys))
        self.optional_keys = [key for key in dict.fromkeys(map(unravel_key, optional_keys)) if key not in required]

    # Unlike TensorDictModule, show no attributes of the network: its "loc" or "scale" would shadow our buffers.
    __getattr__ = nn.Module.__getattr__

    def compute(self, *values: Any, **_: Any) -> Tensor | tuple[Tensor, ...]:
        """Computes one tensor for each of ``out_keys``; a single output may be a bare tensor.

        Args:
            *values: the entries of ``in_keys``, then those of ``optional_keys``, ``None`` for a missing one.
            **_: a sub-class may ask for ``batch_size``, the ``[*B]`` in front of every entry, and, if it has
                ``noise_names``, for ``noise``: the result of :meth:`draw_noise`, or ``None`` for the deterministic
                forward.
        """
        raise TypeError(f"{type(self).__name__} has no compute(): write it, see SubModel.")

    def jacobian(self, *values: Any) -> tuple[Tensor, Tensor] | None:
        """Returns the result of :meth:`compute` without noise, and its Jacobian by the first input, if known.

        Otherwise automatic differentiation computes it, which takes ten times as long. A subclass that overrides
        :meth:`compute` or a related method must also override the Jacobian, or it has none.

        Args:
            *values: the arguments of :meth:`compute`, of which the first are states ``[*B, E, S]``.

        Returns:
            The result ``[*B, E, N]``, and the Jacobian ``[*B, E, N, S]``, or ``[N, S]`` if it is constant; between
            tangents if the sub-model has ``tangents_of``, the spaces of its input and output. ``None`` if it is not
            known.
        """
        return None

    def linearised(self, entries: Entries, call: Call) -> tuple[Entries, Tensor, tuple[Space, Space] | None] | None:
        """Returns the result of :meth:`on_entries`, the :meth:`jacobian`, and the spaces of its tangents, if known."""
        found = self.jacobian(*self.values(entries))
        return None if found is None else ({self.out_keys[0]: found[0]}, found[1], self.tangents_of)

    def draw_noise(
        self,
        batch_size: Sequence[int],
        *,
        members: int | None = None,
        state_dim: int | None = None,
        observation_dim: int | None = None,
        time: bool = False,
        device: torch.device | None = None,
        dtype: torch.dtype | None = None,
        generator: torch.Generator | None = None,
    ) -> Noise:
        """Draws the noise of one call on ``batch_size`` elements.

        Args:
            batch_size: ``[*B]``, or ``[*B, T]`` for a whole sequence.
            members: E, the size of the ensemble.
            state_dim: S.
            observation_dim: O of the reading that the sub-model uses.
            time: whether the last of ``batch_size`` is time.
            device: device of the noise.
            dtype: dtype of floating-point noise.
            generator: source of randomness; torch's global one by default.

        Returns:
            A tensor ``[*batch_size, ...]``, or several by ``noise_names``; ``None`` if there is no noise, or a size
            that it depends on is not known.
        """
        return None

    def noise_sizes(self, *values: Any, **_: Any) -> dict[str, int]:
        """Returns the sizes that :meth:`draw_noise` needs, from the positional arguments of :meth:`compute`."""
        return {}

    def parts(self) -> dict[str, TensorDictModuleBase]:
        """Returns the modules inside that may draw noise, by name; ``""`` for one at the sub-model's own place."""
        return {}

    @property
    def draws(self) -> bool:
        """Tells whether :meth:`compute` asks for noise."""
        return "noise" in self._wants

    def on_entries(self, entries: Entries, call: Call) -> Entries:
        """Returns the sub-model's outputs for entries, without changing the entries.

        Raises:
            KeyError: if an entry is missing.
        """
        try:
            values: list[Any] = list(map(entries.__getitem__, self.in_keys))
            values.extend(map(entries.get, self.optional_keys))
        except KeyError:  # raises with a message that lists the entries
            values = self.values(entries)
        extra: dict[str, Any] = {}
        if "batch_size" in self._wants:
            extra["batch_size"] = call.batch_size
        if "noise" in self._wants:
            extra["noise"] = self._noise(entries, values, call)
        out = self.compute(*values, **extra)
        if type(out) is tuple and len(out) == len(self.out_keys):
            return dict(zip(self.out_keys, out, strict=True))
        if isinstance(out, Tensor) and len(self.out_keys) == 1:
            return {self.out_keys[0]: out}
        return self.by_key(out)

    def values(self, entries: Entries) -> list[Any]:
        """Returns the entries of ``in_keys``, then those of ``optional_keys``, ``None`` for a missing one.

        Raises:
            KeyError: if an entry of ``in_keys`` is missing.
        """
        return [*(self.required(entries, key) for key in self.in_keys), *map(entries.get, self.optional_keys)]

    def by_key(self, out: Tensor | Sequence[Tensor] | None) -> Entries:
        """Returns the results of :meth:`compute` under :attr:`out_keys`.

        Raises:
            ValueError: if there is not one tensor for each key.
        """
        values = (out,) if isinstance(out, Tensor) else out if isinstance(out, (tuple, list)) else None
        if values is None or len(values) != len(self.out_keys):
            got = type(out).__name__ if values is None else f"{len(values)} values"
            raise ValueError(
                f"{type(self).__name__}.compute() returns a tensor for each of its out_keys, in their order: "
                f"{list(self.out_keys)}, {len(self.out_keys)} values; it returned {got}."
            )
        return dict(zip(self.out_keys, values, strict=True))

    def required(self, entries: Entries, key: NestedKey) -> Tensor:
        """Returns the entry ``key``.

        Raises:
            KeyError: if it is missing; the message names it and lists the entries.
        """
        value = entries.get(key)
        if value is None:
            raise diagnosis().missing_entry(type(self).__name__, [key], entries)
        return value

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Reads, computes and writes on a TensorDict."""
        entries = {}
        for key in (*self.in_keys, *self.optional_keys):
            value = tensordict.get(key, None)
            if value is not None:
                entries[key] = value
        if len(entries) < len(self.in_keys):  # for a message that lists all entries
            entries = dict.fromkeys(map(unravel_key, tensordict.keys(True, True))) | entries
        entries.update(flat_noise(tensordict.get("noise", None)))
        try:
            written = self.on_entries(entries, Call(tensordict.batch_size))
        except EXPLAINED as error:
            raise diagnosis().explained(self, error, entries) from error
        for key, value in written.items():
            tensordict.set(key, value)
        return tensordict

    def _noise(self, entries: Entries, values: Sequence[Tensor | None], call: Call) -> Noise:
        names = self.noise_names
        if not names or not call.sample:
            return None
        given: Noise
        if names == ("",):
            given = entries.get(("noise", call.place))
        else:
            found = {name: entries.get(("noise", call.place, name)) for name in names}
            given = {name: value for name, value in found.items() if value is not None}
            given = given if len(given) == len(found) else None
        if given is None:
            where: dict[str, Any] = {}
            # Without inputs, noise is drawn on the device of the constants.
            for value in values if values else (*self.parameters(), *self.buffers()):
                if value is not None and value.is_floating_point():
                    where = {"device": value.device, "dtype": value.dtype}
                    break
            sizes = self.noise_sizes(*values)
            for record in RECORDERS:
                record(call.place, self, sizes)
            where.update(sizes)
            given = self.draw_noise(call.batch_size, time=call.time, **where)
            if given is None:  # it would run deterministically
                raise ValueError(
                    f"{type(self).__name__} at place {call.place!r} names noise, and its draw_noise drew none. If "
                    "that needs the number of members, or another size, return it from noise_sizes(self, *values): "
                    'for example {"members": ensemble.shape[-2]}.'
                )
        return given


class Sensor(SubModel):
    """Computes a reading, its noise, or a mask of it.

    Attributes:
        observation_dim: O of its output, if known beforehand.
        judges_reading: whether it writes no reading, but noise or a mask for the reading of the module before it.
        joins_readings: whether it combines several readings, and needs all of them.
        marks: maps each mask that it writes, which also marks the readings that it finds missing, to the given mask.
    """

    observation_dim: int | None = None
    judges_reading: bool = False
    joins_readings: bool = False
    marks: Mapping[NestedKey, NestedKey] = MappingProxyType({})


class Initial(SubModel):
    """Writes the initial belief of an episode.

    Attributes:
        state_dim: S; on a space, the dimension of a tangent.
        ensemble_size: E; ``None`` for a belief without members.
        space: space of the states; ``None`` for plain numbers.
        input_dim: size of its input, if that is not S.
        observed_key: observed mask of its input; where the input is missing, it writes its prior.

    Example:
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
    observed_key: NestedKey | None = None

    def derived(self, carried: Entries) -> Entries:
        """Returns further entries of the belief, by key, computed from the carried entries and others."""
        return {}


class Transition(SubModel):
    """Forecasts the belief of the next time.

    Attributes:
        mask_key: observed mask of the frame of the next time, if the forecast depends on it.
    """

    mask_key: NestedKey | None = None

    def without_step(self, entries: Entries) -> Entries:
        """Returns the outputs other than the forecast at the start of an episode, where no step is taken."""
        return {}


class Update(SubModel):
    """Updates the belief with a reading: an analysis, or the likelihood of particles.

    Attributes:
        reading_keys: the entries of the reading: the reading itself, then its noise.
        observed_key: their observed mask, ``[*B, 1]`` or ``[*B, O]``.
        predicted_key: the predicted reading, ``[*B, E, O]``.
        info_prefix: prefix of the diagnostics.
        space: space of the states; ``None`` for plain numbers.
        reading_space: space of the reading; ``None`` for plain numbers.
        observation_dim: O of the reading, if known beforehand.

    Example:
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
    info_prefix: str | None = None
    space: Space | None = None
    reading_space: Space | None = None
    observation_dim: int | None = None

    def reading_dims(self, entries: Entries, call: Call) -> Sequence[int | tuple[int, ...]]:
        """Returns the size of each of ``reading_keys``, so that zeros under a mask can replace a missing reading.

        The size of samples is ``(E, O)``. The default is O: ``observation_dim``, or the size of :attr:`predicted_key`.
        On a space the noise is of tangents.

        Raises:
            KeyError: if the size is not known.
        """
        if self.reading_space is not None:
            others = [self.reading_space.tangent_dim] * (len(self.reading_keys) - 1)
            return [self.reading_space.point_dim, *others]
        dim, predicted = self.observation_dim, entries.get(self.predicted_key)
        if predicted is not None:
            dim = predicted.shape[-1]
        if dim is None:
            raise KeyError(
                f"{type(self).__name__} does not know the sizes of {list(self.reading_keys)}, so that they cannot be "
                f"left out. Mask them with {self.observed_key!r}; or return the sizes from reading_dims() of "
                f"{type(self).__name__}."
            )
        return [dim] * len(self.reading_keys)

    def with_mask(self, entries: Entries, call: Call) -> Entries:
        """Returns the entries with the mask of the reading, if a module inside computes it."""
        return entries

    @property
    def updates_ensemble(self) -> bool:
        """Tells whether its inputs are an ensemble, predicted observations, the reading, its noise, and a mask.

        Such an analysis can also correct a lag window (:meth:`move_past`).
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

        The default calls :meth:`compute` with the L times S components as one state, inflation and the like included.
        A :meth:`compute` with constants of S components needs its own version of this method.

        Args:
            past: ``[*B, E, L, S]``.
            predicted: predicted observations ``[*B, E, O]``.
            observation: learned observations ``[*B, E, O]``, or one reading ``[*B, O]``.
            variance: variances of the reading, ``[*B, O]``.
            observed: mask ``[*B, 1]`` or ``[*B, O]``; ``None`` if all is observed.
            noise: the same draws as in :meth:`compute`.

        Returns:
            The updated past, ``[*B, E, L, S]``.

        Raises:
            RuntimeError: if :meth:`compute` fails on that many components.
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
        """Returns the entries with all angles unwrapped to one turn, so that they can be averaged."""
        return entries

    def on_aligned(self, entries: Entries, call: Call) -> Entries:
        """Works like :meth:`on_entries`, on entries that are :meth:`aligned` already."""
        return self.on_entries(entries, call)


#: Defaults of each role, for a part that does not have that role.
_DEFAULTS = {kind: kind(nn.Identity(), [], []) for kind in (SubModel, Sensor, Initial, Transition, Update)}


def role(module: object, kind: type[R]) -> R:
    """Returns a module in its role; for any other TensorDict module, an object with the role's defaults.

    Args:
        module: a module of a filter.
        kind: :class:`Sensor`, :class:`Initial`, :class:`Transition`, :class:`Update`, or any :class:`SubModel`.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> print(role(TensorDictModule(nn.Linear(2, 1), ["x"], ["y"]), Update).info_prefix)
        None
    """
    return module if isinstance(module, kind) else _DEFAULTS[kind]


def in_role(module: nn.Module, kind: type[R]) -> list[R]:
    """Returns the sub-models inside ``module``, nested ones included, that have a role; all for ``SubModel``."""
    return [part for part in module.modules() if isinstance(part, kind)]


#: Called in a trial step with the place of each sub-model that draws noise, the sub-model, and its noise sizes.
RECORDERS: list[Callable[[str, SubModel, dict[str, int]], None]] = []
#: Errors that are raised again with an explanation.
EXPLAINED = (RuntimeError, TypeError, ValueError, IndexError)
