"""Primer that keeps the previous action for a filter inside a policy."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tensordict import NestedKey, TensorDictBase, unravel_key
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import TensorDictPrimer

__all__ = ["LastAction", "check_no_group_resets"]


def check_no_group_resets(reset_keys: Sequence[NestedKey], kept: Iterable[NestedKey]) -> None:
    """Raises if torchrl would not reset an entry, because it resets only entries of the group that is done.

    Args:
        reset_keys: reset keys of the environment.
        kept: keys that are reset with each episode.

    Raises:
        ValueError: if episodes end only in groups of agents, and an entry is outside of them.
    """
    groups = [key[:-1] for key in map(unravel_key, reset_keys) if isinstance(key, tuple)]
    if "_reset" in reset_keys or not groups:
        return
    for key in kept:
        if not any(key[: len(group)] == group for group in groups):
            raise ValueError(
                f"Episodes of this environment end only in {groups[0]}, and torchrl does not reset entries outside of "
                f"that group, such as {key!r}: the belief would continue from the episode before. Give the environment "
                "its own done, at the root; or, if the group has the batch size of the environment, give the filter "
                f"the name of the group, prefix={groups[0][0]!r}."
            )


class LastAction(TensorDictPrimer):
    """Stores the action that led to an observation, as ``("previous", "action")``; zero after a reset.

    A filter in a policy runs before the next action is chosen, and needs the last one.
    :meth:`torch_denkf.filters.Filter.make_tensordict_primer` includes it if actions drive the filter; append it
    yourself if a policy reads the last action for another reason.

    Args:
        actions: maps names of actions to keys of the last ones; ``{"action": ("previous", "action")}`` by default.
        primers: further entries to carry, see :class:`torchrl.envs.transforms.TensorDictPrimer`.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv
        >>> rollout = TransformedEnv(ContinuousActionVecMockEnv(), LastAction()).rollout(3)
        >>> bool((rollout["previous", "action"][1:] == rollout["action"][:-1]).all())
        True
    """

    def __init__(self, actions: dict[NestedKey, NestedKey] | None = None, *, primers: Composite | None = None):
        actions = {"action": ("previous", "action")} if actions is None else actions
        self.actions = {unravel_key(key): unravel_key(kept) for key, kept in actions.items()}
        super().__init__(Composite() if primers is None else primers, expand_specs=True)
        self._carried = list(self.primers.keys(True, True))

    def _with_actions(self) -> None:
        """Adds the actions' shapes, which are known from the environment only."""
        for key, kept in self.actions.items():
            if kept not in self.primers.keys(True, True):
                spec = self.parent.full_action_spec[key]
                batch = self.parent.batch_size
                shape = spec.shape if self.primers.shape == batch else spec.shape[len(batch) :]
                self.primers[kept] = Unbounded(shape=shape, dtype=spec.dtype, device=spec.device)
                self.default_value[kept] = 0.0

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the carried entries.

        Raises:
            ValueError: if another transform carries an entry of the same name, or the environment resets only groups
                of agents.
        """
        self._with_actions()
        if self.parent is not None:
            check_no_group_resets(self.parent.reset_keys, self.primers.keys(True, True))
        taken = [key for key in self._carried if key in observation_spec.keys(True, True)]
        if taken:
            raise ValueError(
                f"The environment carries {taken[0]!r} already, for another filter of the policy: both would start "
                'from one belief. Give one of them a prefix, prefix="imu" for example.'
            )
        return super().transform_observation_spec(observation_spec)

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Adds the carried entries to the state."""
        self._with_actions()
        return super().transform_input_spec(input_spec)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self._with_actions()
        return super()._reset(tensordict, tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict = super()._step(tensordict, next_tensordict)
        for key, kept in self.actions.items():
            next_tensordict.set(kept, tensordict.get(key))
        return next_tensordict
