r"""Smoothing of particles: updates the weights at an earlier time.

Source: Doucet, Godsill & Andrieu 2000, "On sequential Monte Carlo sampling methods for Bayesian filtering", section V
(forward filtering, backward smoothing); Särkkä 2013, section 11.3.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf._checks import check_shape
from torch_denkf.functional.smoothing.backward import run_backward


def backward_weights(log_weights: Tensor, log_transition: Tensor, log_smoothed: Tensor) -> Tensor:
    r"""Smooths one step back in time: the weights of the particles at t from those at t + 1.

    .. math:: w^i_{t|T} = w^i_t \sum_j w^j_{t+1|T}
        \frac{p(x^j_{t+1} | x^i_t)}{\sum_l w^l_t\, p(x^j_{t+1} | x^l_t)}

    Args:
        log_weights: log wⁱ of the filter's belief at t, normalised, ``[*B, E]``.
        log_transition: log p(xʲ at t + 1 | xⁱ at t), ``[*B, E, E]``, rows at t.
        log_smoothed: the smoothed log-weights of t + 1, normalised, ``[*B, E]``.

    Returns:
        The smoothed log-weights of t, normalised, ``[*B, E]``.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        Two particles, of which only the second can be the ancestor of the one later particle that has weight:

        >>> import torch
        >>> even = torch.tensor([0.5, 0.5]).log()
        >>> moves = torch.tensor([[1.0, 1e-9], [1e-9, 1.0]]).log()
        >>> backward_weights(even, moves, torch.tensor([1e-9, 1.0]).log()).exp()
        tensor([2.0000e-09, 1.0000e+00])
    """
    size = log_weights.shape[-1]
    check_shape("log_transition", log_transition, (*log_weights.shape, size), "[*B, E, E]")
    check_shape("log_smoothed", log_smoothed, log_weights.shape, "[*B, E]")
    reached = torch.logsumexp(log_weights.unsqueeze(-1) + log_transition, -2, keepdim=True)
    back = torch.logsumexp(log_smoothed.unsqueeze(-2) + log_transition - reached, -1)
    return (log_weights + back).log_softmax(-1)


def backward_smooth(
    log_weights: Tensor, log_transition: Tensor, *, follows: Tensor | None = None, lag: int | None = None
) -> Tensor:
    """Smooths the weights of a whole sequence of particles, whose states are unchanged.

    Args:
        log_weights: log-weights of the filter's beliefs, normalised, ``[*B, T, E]``.
        log_transition: log-density of each particle at t, in the columns, given each at t − 1, in the rows,
            ``[*B, T, E, E]``.
        follows: boolean ``[*B, T]``; False if an element is not one step on from the one before. None: all are.
        lag: number of later readings: the belief of t given those up to t + lag. None: all of the sequence.

    Returns:
        The smoothed log-weights, ``[*B, T, E]``.

    Raises:
        ValueError: if the shapes do not fit, or ``lag`` is negative.

    Examples:
        >>> import torch
        >>> weights = torch.tensor([[0.5, 0.5], [0.2, 0.8]]).log()
        >>> apart = torch.tensor([[1.0, 1e-9], [1e-9, 1.0]]).log().expand(2, 2, 2)
        >>> backward_smooth(weights, apart)[0].exp()
        tensor([0.2000, 0.8000])
    """

    def step(own, link, later):
        return (backward_weights(*own, *link, *later),)

    return run_backward(step, log_weights.ndim - 2, (log_weights,), (log_transition,), follows=follows, lag=lag)[0]
