"""Warns if a filter in a policy starts from a belief that is not its own."""

from __future__ import annotations

from weakref import ref

from torch.utils.weak import WeakIdKeyDictionary

from torch_denkf.diagnosis.once import Once
from torch_denkf.filters.base import Filter
from torch_denkf.filters.finish import Record
from torch_denkf.filters.structure import previous_key

__all__ = ["PolicyStart"]

#: Beliefs that an environment's transform has brought up to the frame that comes with them.
_UP_TO_DATE = WeakIdKeyDictionary()
#: Beliefs that a policy's filter wrote for its next step, and a reference to that filter.
_CARRIED = WeakIdKeyDictionary()


class PolicyStart(Once):
    """Warns once where a policy's filter starts from a belief that another filter wrote, or that has seen the frame.

    It is noticed where the environment runs in the same process and nothing copies the belief on its way.
    """

    ways = ("policy", "environment")

    def __call__(self, filter: Filter, record: Record) -> None:
        """Looks at the belief that a step of a policy starts from, and remembers the one that it leads to."""
        carry = filter.structure.carry[0]
        if record.way == "environment":
            _UP_TO_DATE[record.written[carry]] = None
            return
        given = (record.tensordict.get(filter.outer(key), None) for key in (previous_key(carry), carry))
        belief = next((value for value in given if value is not None), None)
        writer = None if belief is None else _CARRIED.get(belief)
        name = type(filter).__name__
        if belief is not None and belief in _UP_TO_DATE:
            self.warn(
                "up to date",
                f"{name} in a policy starts its step from a belief that DEnKFTransform has brought up to this frame "
                "already: each reading counts twice. Keep the filter in one place: in the environment, where the "
                "policy reads ('belief', 'mean'), or in the policy behind filter.make_tensordict_primer().",
            )
        if writer is not None and writer() is not filter:
            self.warn(
                "foreign",
                f"{name} in a policy starts its step from a belief that another filter wrote. Where both are in one "
                'policy, give one of them a name of its own, prefix="imu" for example.',
            )
        _CARRIED[record.written["next", *previous_key(carry)]] = ref(filter)
