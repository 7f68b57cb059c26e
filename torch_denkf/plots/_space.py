"""Beliefs on a space in components for plots: roll, pitch and yaw of a quaternion."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf.functional.manifolds import Place, Space, places_of, whole_parts
from torch_denkf.plots._belief import Belief

__all__ = ["angles_of", "in_components", "in_tangents", "names_of"]


def in_components(read: Belief, space: Space) -> Belief:
    """Returns the belief in D components, as many as tangents have: roll, pitch and yaw in rad replace a quaternion.

    Roll about x, then pitch about y, then yaw about z, are rotations about fixed axes; pitch is in [-pi/2, pi/2]. The
    variances of tangents are transformed by the derivative at the mean, which is infinite at a pitch of +-pi/2 (gimbal
    lock).

    Args:
        read: points ``[*, P]``, variances and covariances of tangents.
        space: space of the points.

    Returns: A belief ``[*, D]``; NaN for unknown parts of the truth.
    """
    truth = read.truth
    if truth is not None and truth.shape[-1] < space.point_dim:
        missing = truth.new_full((*truth.shape[:-1], space.point_dim - truth.shape[-1]), torch.nan)
        truth = torch.cat([truth, missing], -1)
    var = read.var
    if var is not None:
        cov = var.diag_embed() if read.cov is None else read.cov
        slope = _slope(read.mean, space)
        var = (slope @ cov @ slope.mT).diagonal(dim1=-2, dim2=-1)
    mean, truth = _components(read.mean, space), None if truth is None else _components(truth, space)
    ensemble = None if read.ensemble is None else _components(read.ensemble, space)
    return read._replace(mean=mean, var=var, cov=None, ensemble=ensemble, truth=truth)


def in_tangents(read: Belief, space: Space) -> Belief:
    """Returns the belief as tangents at its mean, ``[*, D]``: the mean is zero, the truth its difference from the mean.

    Args:
        read: points ``[*, P]``, variances of tangents.
        space: space of the points.

    Returns: A belief ``[*, D]``. Its truth has the parts of the given one, with NaN for unknown parts.
    """
    mean, truth, ensemble = read.mean, read.truth, read.ensemble
    if truth is not None:
        given = torch.arange(space.point_dim) < truth.shape[-1]
        whole = space.neutral(mean).expand(mean.shape).clone()
        whole[..., given] = truth[..., : space.point_dim]
        known = whole_parts(space, ~whole.isnan())[1]
        truth = torch.where(known, space.minus(whole, mean), torch.nan)[..., : int(whole_parts(space, given)[1].sum())]
    if ensemble is not None:
        ensemble = space.minus(ensemble, mean.unsqueeze(-2))
    return read._replace(mean=torch.zeros_like(space.minus(mean, mean)), truth=truth, ensemble=ensemble)


def angles_of(space: Space) -> list[int]:
    """Returns the indices of the D components that are angles."""
    return [index for place in places_of(space) for index in range(place.rotation.start, place.rotation.stop)]


def names_of(space: Space, turns: tuple[str, ...] = ("roll, deg", "pitch, deg", "yaw, deg")) -> list[str]:
    """Returns a label for each of the D components, with degrees for angles; ``turns`` are the labels of a rotation."""
    names = [f"state {index}" for index in range(space.tangent_dim)]
    for place in places_of(space):
        names[place.rotation] = turns if _turns(place) == 3 else ("heading, deg",) * _turns(place)
    return names


def _turns(place: Place) -> int:
    return place.rotation.stop - place.rotation.start


def _components(point: Tensor, space: Space) -> Tensor:
    """Returns ``[*, D]`` of points ``[*, P]``."""
    parts = []
    for place in places_of(space):
        own = point[..., place.point]
        if _turns(place) == 3:
            w, x, y, z = own[..., :4].unbind(-1)
            roll = torch.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
            pitch = torch.asin((2 * (w * y - z * x)).clamp(-1, 1))
            yaw = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
            own = torch.cat([torch.stack([roll, pitch, yaw], -1), own[..., 4:]], -1)
        parts.append(own)
    return torch.cat(parts, -1)


def _slope(mean: Tensor, space: Space) -> Tensor:
    """Returns the derivative of the D components with respect to the tangent, ``[*, D, D]``, at points ``[*, P]``."""

    def moved(tangent: Tensor, point: Tensor) -> Tensor:
        return _components(space.plus(point, tangent), space)

    flat = mean.reshape(-1, mean.shape[-1])
    zero = flat.new_zeros(len(flat), space.tangent_dim)
    slope = torch.func.vmap(torch.func.jacfwd(moved))(zero, flat)
    return slope.reshape(*mean.shape[:-1], *slope.shape[1:])
