"""The Lorenz-96 system, the usual test bed of ensemble filters: chaotic, cheap, and of any dimension.

Source: Lorenz 1996, Predictability: a problem partly solved; the observed 40-variable set-up with its
published filter scores: Lorenz & Emanuel 1998, J. Atmos. Sci. 55; Sakov & Oke 2008.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf._checks import check_number


def lorenz96_tendency(state: Tensor, forcing: float | Tensor = 8.0) -> Tensor:
    """Returns the time derivative dx_i/dt = (x_{i+1} − x_{i−2}) x_{i−1} − x_i + F, on a circle.

    Args:
        state: x, ``[..., N]`` with N >= 4, without units.
        forcing: F; 8 is chaotic.

    Returns:
        dx/dt, ``[..., N]``, in one over time units (one unit stands for five days of weather).

    Raises:
        ValueError: if there are fewer than four variables.

    Examples:
        >>> import torch
        >>> lorenz96_tendency(torch.full((4,), 8.0))  # the unstable fixed point x_i = F
        tensor([0., 0., 0., 0.])
    """
    if state.ndim < 1 or state.shape[-1] < 4:
        raise ValueError(f"state must be [..., N] with N >= 4 variables, got {list(state.shape)}")
    # One concatenation closes the circle: three rolls cost more than the rest of the formula.
    circle = torch.cat([state[..., -2:], state, state[..., :1]], -1)
    return (circle[..., 3:] - circle[..., :-3]) * circle[..., 1:-2] - state + forcing


def lorenz96_step(state: Tensor, dt: float = 0.05, forcing: float | Tensor = 8.0) -> Tensor:
    """Returns one step of the classical fourth-order Runge-Kutta scheme.

    Args:
        state: x, ``[..., N]`` with N >= 4, without units.
        dt: step, in time units; 0.05 (six hours) is the standard set-up's.
        forcing: F; 8 is chaotic.

    Returns:
        The state ``dt`` later, ``[..., N]``.

    Raises:
        TypeError: if ``dt`` is no number.
        ValueError: if there are fewer than four variables, or ``dt`` is not positive and finite.

    Examples:
        >>> import torch
        >>> state = lorenz96_step(torch.tensor([8.0, 8.0, 8.0, 9.0]))
        >>> state.shape
        torch.Size([4])
    """
    check_number("dt", dt, above=0, cure="It is a step in time units, such as 0.05")
    k1 = lorenz96_tendency(state, forcing)
    k2 = lorenz96_tendency(state + dt / 2 * k1, forcing)
    k3 = lorenz96_tendency(state + dt / 2 * k2, forcing)
    k4 = lorenz96_tendency(state + dt * k3, forcing)
    return state + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
