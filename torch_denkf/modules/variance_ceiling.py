"""A ceiling on the variances of a belief, which keeps unobserved unstable systems finite."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey
from torch import nn

from torch_denkf._checks import check_number, flag_value
from torch_denkf.beliefs import Belief
from torch_denkf.functional.kernels.small_system import on_gpu
from torch_denkf.submodel import SubModel

__all__ = ["VarianceCeiling"]


class VarianceCeiling(SubModel):
    """Clamps the variances of a belief to a ceiling; correlations are kept.

    It is the last module of a filter's update. An ensemble is scaled as a whole; of weighted particles only those are
    moved that make the variance too large.

    Args:
        kinds: kinds of the belief, see :func:`torch_denkf.beliefs.kinds_of`.
        keys: keys of the belief that a step writes.
        ceiling: largest variance, in the state's units squared.

    Attributes:
        reached: whether variances were clamped, if that was checked; for warnings.

    Raises:
        ValueError: if ``ceiling`` is not positive, or a kind of belief has no ``limited`` for its carried entries.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.beliefs import kinds_of
        >>> keys = [("belief", name) for name in ("mean", "cov", "var")]
        >>> belief = {"mean": torch.zeros(1), "cov": torch.full((1, 1), 9.0), "var": torch.full((1,), 9.0)}
        >>> VarianceCeiling(kinds_of(keys), keys, 4.0)(TensorDict({"belief": belief}))["belief", "cov"]
        tensor([[4.]])
    """

    def __init__(self, kinds: Sequence[Belief], keys: Sequence[NestedKey], ceiling: float):
        check_number("variance_ceiling", ceiling, above=0, cure="None is for no ceiling")
        super().__init__(nn.Identity(), [], list(keys), optional_keys=keys)
        for kind in kinds:
            if kind.carried and {*kind.carried}.isdisjoint(("mean", "cov")) and type(kind).limited is Belief.limited:
                raise ValueError(
                    f"{type(kind).__name__} carries {list(kind.carried)}, to which a ceiling of the variances does not "
                    "apply: implement its limited(), or give the filter variance_ceiling=None."
                )
        self.ceiling = ceiling
        self.kinds = [(kind.key("var"), kind) for kind in kinds if {kind.key("mean"), kind.key("var")} <= {*keys}]
        self.reached = False

    def on_entries(self, entries, call):
        """Returns the changed entries."""
        out = {}
        for key, kind in self.kinds:
            variance = entries.get(key)
            # On a GPU the comparison is not read, because that would wait for the device.
            above = None if variance is None or on_gpu(variance) else flag_value((variance > self.ceiling).any())
            if variance is None or above is False:
                continue
            if above:
                self.reached = True
            length = len(kind.prefix)
            held = {key[-1]: entries[key] for key in self.out_keys if key[:length] == kind.prefix and key in entries}
            out.update({kind.key(name): value for name, value in kind.limited(held, self.ceiling).items()})
        return out
