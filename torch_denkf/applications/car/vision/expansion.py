"""Focus of expansion of a coarse optical flow, and the turn between the two frames."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_denkf.applications.car.vision.camera import CanonicalCamera
from torch_denkf.applications.car.vision.shapes import FLOW_SHAPE, FOCUS_PRIOR, FOCUS_STD

__all__ = ["Expansion", "coarse_cells", "focus_of_expansion"]

_TURN_STD = 0.3  # rad, of each angle: a weak prior, which only a car at rest needs
_ITERATIONS = 7
_EVERY = 2  # uses every second column: neighbours are nearly redundant
_SOME = 7  # estimates the noise from every seventh cell: the median takes longer than all the rest
_TOGETHER = 20.0  # number of neighbouring cells with one common error; fits the standard deviations seen on KITTI
_NEAR = 0.06  # rad around the focus, where the direction of the flow is not defined
_LEAST_NOISE = 3e-4  # lower bound of the flow's noise, in tangents: a twentieth of a pixel
_LONGEST_MOVE = 0.03  # largest step of the focus in one iteration


class Expansion(NamedTuple):
    """The direction of travel and the turn between two frames.

    Attributes:
        focus: focus of expansion, an image point (right, down) ``[N, 2]``, in tangents: the direction of travel in the
            camera's axes. Its second entry is the camera's upward pitch relative to the direction of travel.
        turn: rotation to the left, up, and anticlockwise around the axis ``[N, 3]``, in rad.
        focus_std: standard deviations of the focus ``[N, 2]``.
        turn_std: standard deviations of the turn ``[N, 3]``.
    """

    focus: Tensor
    turn: Tensor
    focus_std: Tensor
    turn_std: Tensor


@torch.no_grad()
def focus_of_expansion(flow: Tensor) -> Expansion:
    r"""Fits rotation and direction of travel to coarse optical flow, without knowing the depth of the scene.

    Translation moves an image point p along the ray from the focus e, by an amount that depends on its distance;
    a rotation moves it by a known amount :math:`B(p)\,\omega`. So the part of the flow across the ray,
    :math:`n(p, e)^T (f(p) - B(p)\,\omega)`, is noise. Gauss-Newton steps minimise it over e and :math:`\omega` with
    Cauchy weights against moving objects, and a weak prior for a car at rest.

    On KITTI the error of the focus is about 0.005 rad, nearly independent from frame to frame. It causes an error of
    4 % in a distance on the road plane. Along a path these errors average out; those of an unknown pitch do not.

    Args:
        flow: ``[N, 3, 25, 79]``, motion to the right and down in tangents, and mismatch from 0 to 1; see
            :func:`torch_denkf.applications.car.vision.flow.coarse_flow`.

    Returns:
        Direction of travel, rotation and their standard deviations, of the flow's dtype (float32 at least).

    Raises:
        ValueError: if the flow has another shape.

    Reference:
        Longuet-Higgins & Prazdny, "The interpretation of a moving retinal image", 1980: the equations of motion;
        Bruss & Horn, "Passive navigation", 1983: distances eliminated in this way.

    Example:
        The flow points away from a focus 0.02 below the middle of the image, at random depths.

        >>> rows, columns = torch.linspace(-0.26, 0.26, 25), torch.linspace(-0.85, 0.85, 79)
        >>> down, right = torch.meshgrid(rows - 0.02, columns, indexing="ij")
        >>> flow = torch.stack([right, down, torch.zeros(25, 79)]) * torch.rand(25, 79)
        >>> focus_of_expansion(flow.unsqueeze(0)).focus.round(decimals=3).abs()
        tensor([[0.0000, 0.0200]])
    """
    if tuple(flow.shape[1:]) != FLOW_SHAPE:
        raise ValueError(f"a coarse flow has the shape [N, {', '.join(map(str, FLOW_SHAPE))}]; got {list(flow.shape)}")
    dtype = torch.promote_types(flow.dtype, torch.float32)
    height, width = FLOW_SHAPE[1:]
    right, down, mismatch = flow[..., _EVERY // 2 :: _EVERY].to(dtype).flatten(2).unbind(1)
    cells = coarse_cells().to(flow.device, dtype).view(2, height, width)
    x, y = cells[..., _EVERY // 2 :: _EVERY].flatten(1)
    trust = (1 - mismatch).clamp_min(0).square()
    prior = torch.tensor([0.0, 0.0, 0.0, *FOCUS_PRIOR], dtype=dtype, device=flow.device)
    precision = torch.tensor([_TURN_STD] * 3 + list(FOCUS_STD), dtype=dtype, device=flow.device) ** -2
    estimate = prior.expand(len(flow), 5)
    for _ in range(_ITERATIONS):
        residual, jacobian, far = _across(right, down, x, y, estimate)
        information = trust * far
        some = slice(None, None, _SOME)
        seen = torch.where(information[:, some] > 0.2, residual[:, some].abs(), torch.nan)
        noise = (1.48 * seen.nanmedian(1, keepdim=True).values).nan_to_num(1.0).clamp_min(_LEAST_NOISE)
        information = information / (1 + (residual / (1.5 * noise)) ** 2) / (_TOGETHER * noise**2)
        weighted = jacobian * information.unsqueeze(1)
        normal = weighted @ jacobian.mT + precision.diag()
        gradient = (weighted @ residual.unsqueeze(-1)).squeeze(-1) + precision * (estimate - prior)
        step = torch.linalg.solve(normal, gradient)
        step[:, 3:] = step[:, 3:].clamp(-_LONGEST_MOVE, _LONGEST_MOVE)
        estimate = estimate - step
    std = torch.linalg.inv(normal).diagonal(dim1=-2, dim2=-1).sqrt()
    return Expansion(estimate[:, 3:], estimate[:, :3], std[:, 3:], std[:, :3])


def _across(right: Tensor, down: Tensor, x: Tensor, y: Tensor, estimate: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns flow across rays from the focus ``[N, K]``, its Jacobian ``[N, 5, K]``, and a mask of the long rays."""
    left, up, around, *focus = (value.unsqueeze(-1) for value in estimate.unbind(1))
    from_x, from_y = x - focus[0], y - focus[1]
    distance = (from_x**2 + from_y**2).sqrt().clamp_min(0.5 * _NEAR)
    along_x, along_y = from_x / distance, from_y / distance
    # Motion of an image point under rotations to the left, up and anticlockwise.
    turned_x, turned_y = (1 + x * x, x * y, -y), (x * y, 1 + y * y, x)
    own_x = right - left * turned_x[0] - up * turned_x[1] - around * turned_x[2]
    own_y = down - left * turned_y[0] - up * turned_y[1] - around * turned_y[2]
    residual = along_x * own_y - along_y * own_x
    # Moving the focus across a ray turns the ray, so part of the flow along the ray becomes flow across it.
    lever = (along_x * own_x + along_y * own_y) / distance
    of_turn = [along_y * a - along_x * b for a, b in zip(turned_x, turned_y, strict=True)]
    return residual, torch.stack([*of_turn, -lever * along_y, lever * along_x], 1), distance > _NEAR


def coarse_cells() -> Tensor:
    """Returns the centres of the cells of a coarse flow, right and down, ``[2, 25 * 79]``, in tangents."""
    camera, (_, height, width) = CanonicalCamera(240.0), FLOW_SHAPE
    across, along = (size / 2 / camera.focal for size in (camera.width, camera.height))
    columns = ((torch.arange(width) + 0.5) / width * 2 - 1) * across
    rows = ((torch.arange(height) + 0.5) / height * 2 - 1) * along
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([x.flatten(), y.flatten()])
