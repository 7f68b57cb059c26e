r"""The Rauch-Tung-Striebel smoother: conditions earlier states on later readings, as means and covariances.

The step from t to t + 1 gives a forecast m_f, P_f and the cross-covariance C of the states before and after the step.
With the gain :math:`G = C P_f^{-1}` the smoothed belief of t is computed from that of t + 1. Only C differs between
filters: P Fᵀ in a Kalman filter, with the Jacobian F in an extended one, from sigma points in an unscented one.

Source: Rauch, Tung & Striebel 1965; Särkkä 2013, theorem 8.2 and section 9 (for the EKF and the UKF).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf._checks import check_shape
from torch_denkf.functional.linalg import divide, semidefinite_solve
from torch_denkf.functional.manifolds import Space
from torch_denkf.functional.smoothing.backward import run_backward


def smoothing_gain(cross: Tensor, forecast_cov: Tensor) -> Tensor:
    """Returns the smoother's gain G = C P_f⁻¹; P_f may be singular, with eigenvalues that are negative by rounding.

    Args:
        cross: C, the covariance of the state at t and the state at t + 1, ``[*B, S, S]``, rows at t.
        forecast_cov: P_f of t + 1, ``[*B, S, S]``.

    Returns:
        G, ``[*B, S, S]``.

    Examples:
        >>> import torch
        >>> smoothing_gain(torch.tensor([[1.0]]), torch.tensor([[2.0]]))
        tensor([[0.5000]])
    """
    return semidefinite_solve(forecast_cov, cross.mT, spare=torch.finfo(cross.dtype).eps ** 0.5).mT


def left_open(gain: Tensor, before: Tensor, middle: Tensor, after: Tensor, noise: Tensor) -> Tensor:
    """Returns the covariance of the state at t given the state at t + 1, in Joseph's form.

    (A − G B) M (A − G B)ᵀ + G Q Gᵀ equals P − G P_f Gᵀ, and stays positive under round-off if P is far larger than Q,
    as at the start of a run with a vague prior.

    Args:
        gain: G, ``[*B, S, S]``.
        before: A, ``[*B, S, N]``, with P = A M Aᵀ at t; for a linear transition the identity.
        middle: M, ``[*B, N, N]``; for a linear transition P.
        after: B, ``[*B, S, N]``, with P_f = B M Bᵀ + Q at t + 1; for a linear transition F.
        noise: Q, ``[*B, S, S]``.

    Returns:
        The covariance, ``[*B, S, S]``.

    Examples:
        >>> import torch
        >>> one = torch.ones(1, 1)
        >>> left_open(0.5 * one, one, one, one, one)
        tensor([[0.5000]])
    """
    rest = before - gain @ after
    return rest @ middle @ rest.mT + gain @ noise @ gain.mT


def rts_step(
    mean: Tensor,
    cov: Tensor,
    forecast_mean: Tensor,
    gain: Tensor,
    cross: Tensor,
    smoothed_mean: Tensor,
    smoothed_cov: Tensor,
    *,
    open_cov: Tensor | None = None,
    space: Space | None = None,
) -> tuple[Tensor, Tensor]:
    """Smooths one step back in time: the belief of t from that of t + 1.

    The covariance is (P − G P_f Gᵀ) + G P_s Gᵀ: the uncertainty given the next state, plus that of the next state.

    Args:
        mean: mean of the filter's belief at t, ``[*B, S]``.
        cov: P, its covariance, ``[*B, S, S]``.
        forecast_mean: mean of the forecast of t + 1, ``[*B, S]``.
        gain: G, see :func:`smoothing_gain`, ``[*B, S, S]``.
        cross: C, the covariance of the states at t and t + 1 in that forecast, ``[*B, S, S]``, rows at t.
        smoothed_mean: smoothed mean of t + 1, ``[*B, S]``.
        smoothed_cov: P_s of t + 1, ``[*B, S, S]``.
        open_cov: P − G P_f Gᵀ, see :func:`left_open`; ``None`` for the difference itself, P − G Cᵀ.
        space: space of the state: means are points, and each covariance is of the tangents at its mean. ``None``
            for plain numbers.

    Returns:
        The smoothed mean ``[*B, S]`` and covariance ``[*B, S, S]`` of t.

    Examples:
        A random walk with P = Q = 1, whose next state is known to be 2 exactly:

        >>> import torch
        >>> zero, one = torch.zeros(1), torch.ones(1, 1)
        >>> mean, cov = rts_step(zero, one, zero, smoothing_gain(one, 2 * one), one, 2 * torch.ones(1), 0 * one)
        >>> mean.round(decimals=4), cov.round(decimals=4)
        (tensor([1.]), tensor([[0.5000]]))
    """
    rest = cov - gain @ cross.mT if open_cov is None else open_cov
    if space is None:
        shift = gain @ (smoothed_mean - forecast_mean).unsqueeze(-1)
        out = rest + gain @ smoothed_cov @ gain.mT
        return mean + shift.squeeze(-1), (out + out.mT) / 2
    learned = space.minus(smoothed_mean, forecast_mean)
    back = divide(gain, space.right_jacobian(learned))  # from the tangents at the smoothed mean
    step = (gain @ learned.unsqueeze(-1)).squeeze(-1)
    turn = space.right_jacobian(step)  # to the tangents at the new mean
    out = turn @ (rest + back @ smoothed_cov @ back.mT) @ turn.mT
    return space.plus(mean, step), (out + out.mT) / 2


def rts_smooth(
    mean: Tensor,
    cov: Tensor,
    forecast_mean: Tensor,
    forecast_cov: Tensor,
    cross: Tensor,
    open_cov: Tensor | None = None,
    *,
    follows: Tensor | None = None,
    lag: int | None = None,
    space: Space | None = None,
) -> tuple[Tensor, Tensor]:
    """Smooths the beliefs of a whole sequence.

    Args:
        mean: means of the filter's beliefs, ``[*B, T, S]``.
        cov: their covariances, ``[*B, T, S, S]``.
        forecast_mean: mean of the forecast of each time from the belief before, ``[*B, T, S]``.
        forecast_cov: its covariance, ``[*B, T, S, S]``.
        cross: the covariance of the state before and the state at each time, ``[*B, T, S, S]``, rows before.
        open_cov: see :func:`rts_step`, for the step to each time, ``[*B, T, S, S]``.
        follows: boolean ``[*B, T]``; False if an element is not one step on from the one before, such as the first
            of an episode: no correction passes back from it. The first element is ignored. None: all are.
        lag: number of later readings: the belief of t given those up to t + lag. None: all of the sequence.
        space: space of the state, see :func:`rts_step`.

    Returns:
        The smoothed means ``[*B, T, S]`` and covariances ``[*B, T, S, S]``.

    Raises:
        ValueError: if the shapes do not fit, or ``lag`` is negative.

    Examples:
        >>> import torch
        >>> mean, cov = torch.tensor([[0.0], [2.0]]), torch.tensor([[[1.0]], [[0.0]]])
        >>> smoothed, _ = rts_smooth(mean, cov, torch.zeros(2, 1), 2 * torch.ones(2, 1, 1), torch.ones(2, 1, 1))
        >>> smoothed.flatten().round(decimals=4)
        tensor([1., 2.])
    """
    size = mean.shape[-1] if space is None else space.tangent_dim
    check_shape("forecast_mean", forecast_mean, mean.shape, "[*B, T, S]")
    for name, value in (("cov", cov), ("forecast_cov", forecast_cov), ("cross", cross)):
        check_shape(name, value, (*mean.shape[:-1], size, size), "[*B, T, S, S]")
    # The gains of all times in one call; the first time has none.
    gains = smoothing_gain(cross[..., 1:, :, :], forecast_cov[..., 1:, :, :])
    gain = torch.cat([torch.zeros_like(cross[..., :1, :, :]), gains], -3)
    links = (forecast_mean, gain, cross, *(() if open_cov is None else (open_cov,)))

    def step(own, link, later):
        return rts_step(*own, *link[:3], *later, open_cov=(*link, None)[3], space=space)

    mean, cov = run_backward(step, mean.ndim - 2, (mean, cov), links, follows=follows, lag=lag)
    return mean, cov
