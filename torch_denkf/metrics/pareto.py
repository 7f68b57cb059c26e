"""Which filters are worth their cost: those that no other beats in everything."""

from __future__ import annotations

from torch import Tensor

__all__ = ["pareto_frontier"]


def pareto_frontier(costs: Tensor) -> Tensor:
    """Which points no other point beats: none is as low in every cost and lower in one.

    Args:
        costs: the lower the better, ``[N, C]``, such as (ms a step, error) of N filters.

    Returns:
        ``[N]`` bool. Equal points are on the frontier together.

    Raises:
        ValueError: if the shape is another, or if a cost is NaN.

    Example:
        >>> import torch
        >>> pareto_frontier(torch.tensor([[1.0, 3.0], [2.0, 2.0], [3.0, 2.5], [2.0, 4.0]]))
        tensor([ True,  True, False, False])
    """
    if costs.ndim != 2:
        raise ValueError(f"costs must be [N, C], a row a filter; got {list(costs.shape)}")
    if bool(costs.isnan().any()):
        raise ValueError("a cost is NaN, which is neither better nor worse; leave out its row")
    other, own = costs.unsqueeze(0), costs.unsqueeze(1)
    return ~((other <= own).all(-1) & (other < own).any(-1)).any(1)
