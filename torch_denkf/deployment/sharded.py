"""Measurement update of an ensemble whose state components are distributed over processes."""

from __future__ import annotations

from typing import Literal, Unpack

import torch.distributed as dist

from torch_denkf._checks import check_choice
from torch_denkf.functional.kernels.sharded import analyse_sharded
from torch_denkf.modules.analysis import EnsembleAnalysis
from torch_denkf.modules.ensemble import EnsembleAnalysisKeys

__all__ = ["ShardedEnsembleAnalysis"]


class ShardedEnsembleAnalysis(EnsembleAnalysis):
    """:class:`EnsembleAnalysis` of a state that is distributed over processes.

    The mathematics is :func:`~torch_denkf.functional.kernels.sharded.analyse_sharded`.

    Each process, as ``torchrun`` starts them, runs the same filter on its own components of the state and of the
    observation, with the same number of members. ``nis`` and ``log_likelihood`` are those of all components; other
    outputs are those of the process.

    All processes must step together. There are no gradients: use it for inference, not for training. Results equal
    those of one process with the whole state, up to rounding. An analysis of 32 members and 10⁷ components, of which a
    tenth is observed, takes two processes of one machine 2.0 s and 2.6 GB each. One process takes 2.2 s and 4.8 GB
    (four shared cores; ``python -m torch.distributed.run --nproc_per_node=2`` starts two).

    Args:
        scheme: ``"sensor"``, ``"etkf"`` or ``"sakov"``, as in :class:`EnsembleAnalysis`.
        inflation: factor on the analysis anomalies, if any process observes anything; 1 for none.
        relaxation: relaxation to prior spread in [0, 1]; 0 for none.
        group: the processes; ``None`` for all.
        **keys: see :class:`~torch_denkf.modules.ensemble.EnsembleAnalysisKeys`.

    Raises:
        ValueError: for the scheme ``"perturbed"``, whose draws would be equal in processes with the same seed.
        RuntimeError: in a step, if ``torchrun`` started several processes without
            ``torch.distributed.init_process_group``, or if a gradient is required.

    Source:
        Hunt, Kostelich & Szunyogh 2007, Physica D 230, for the analysis in ensemble space.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> td = TensorDict({
        ...     "forecast": {"ensemble": torch.randn(32, 3), "observation": torch.randn(32, 2)},
        ...     "sensor": {"ensemble": torch.randn(2), "noise": torch.ones(2)},
        ... })
        >>> ShardedEnsembleAnalysis("etkf")(td)["belief", "mean"].shape
        torch.Size([3])
    """

    _formula = staticmethod(analyse_sharded)

    def __init__(
        self,
        scheme: Literal["sensor", "etkf", "sakov"] = "etkf",
        *,
        inflation: float = 1.0,
        relaxation: float = 0.0,
        group: dist.ProcessGroup | None = None,
        **keys: Unpack[EnsembleAnalysisKeys],
    ):
        check_choice("scheme of a sharded analysis", scheme, ("sensor", "etkf", "sakov"))
        super().__init__(scheme, inflation=inflation, relaxation=relaxation, **keys)
        self.group = group

    def _any(self, observed):
        """Marks rows in which any process observes anything, ``[*B]``."""
        seen = observed.any(-1).byte()
        if dist.is_initialized():
            dist.all_reduce(seen, dist.ReduceOp.MAX, group=self.group)
        return seen.bool()

    def _options(self, noise, taper):
        """Returns the options of :func:`analyse_sharded`; there is neither noise nor taper."""
        return {"scheme": self.scheme, "group": self.group}
