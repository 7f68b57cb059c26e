"""Estimates a stereo camera's motion between two rows from shared corners, with its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import cv2
import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf._checks import check_count, check_number, check_shape
from torch_denkf.applications.car.corners.camera import StereoCamera
from torch_denkf.functional.manifolds import SE3, quaternion_of, rotate, rotation_matrix, skew

__all__ = ["CornerMotion", "CornerNoise", "corner_motion", "corner_motions", "started_by_ransac"]


LEAST = 0.03  # smallest weight of an inlier


@dataclass(frozen=True)
class CornerNoise:
    """Standard deviations of corners, in pixels.

    Attributes:
        pixel: tracking error in the left image, between two rows.
        pixel_per_flow: additional tracking error per pixel of flow.
        disparity: white error of the disparity, in each row.
        disparity_per_flow: additional white error per pixel of flow.
        stereo: constant disparity error of a corner, from a wrong stereo match.
        stereo_per_offset: additional constant error per pixel of difference between the heights in both images.
        stereo_per_disparity: additional constant error per pixel of disparity.
        stereo_stale: factor on the constant error of corners from repeated rows.
        stereo_walk: random walk of the constant error, per row.
        freedom: degrees of freedom of Student's t, which down-weights outliers.

    Raises:
        ValueError: if a number is negative or not finite, or ``pixel``, ``disparity`` or ``freedom`` is zero.
    """

    pixel: float = 0.06
    pixel_per_flow: float = 0.0042
    disparity: float = 0.05
    disparity_per_flow: float = 0.003
    stereo: float = 0.45
    stereo_per_offset: float = 0.8
    stereo_per_disparity: float = 0.0
    stereo_stale: float = 1.0
    stereo_walk: float = 0.1
    freedom: float = 1.4

    def __post_init__(self):
        for each in fields(self):
            above = 0 if each.name in ("pixel", "disparity", "freedom") else None
            check_number(each.name, getattr(self, each.name), least=0, above=above)

    def stereo_var(self, corners: Tensor, offset: Tensor, stale: Tensor) -> Tensor:
        """Returns the prior variance of a corner's constant disparity error, ``[*]`` in pixels^2.

        Args:
            corners: (u, v, disparity), ``[*, 3]``.
            offset: difference of each corner's heights in both images, ``[*]`` in pixels.
            stale: ``[*]`` bool: corners from repeated rows.
        """
        var = self.stereo**2 + (self.stereo_per_disparity * corners[..., 2]).square()
        var = var + (self.stereo_per_offset * offset).square()
        return torch.where(stale, self.stereo_stale**2 * var, var)


class CornerMotion(NamedTuple):
    """Result of :func:`corner_motion`.

    Attributes:
        motion: points of SE3 ``[*B, 7]``: the pose of the later row, seen from the earlier one.
        cov: covariance of its tangent ``[*B, 6, 6]``, from the weighted corners.
        log_likelihood: mean log likelihood of the seen corners, ``[*B]``.
        weight: weight of each corner ``[*B, N]``, about 1 for inliers, 0 for missing ones.
        stereo: constant disparity error of each corner, ``[*B, N]`` in pixels.
        stereo_var: variance of this error.
    """

    motion: Tensor
    cov: Tensor
    log_likelihood: Tensor
    weight: Tensor
    stereo: Tensor
    stereo_var: Tensor


def corner_motion(
    before: Tensor,
    after: Tensor,
    seen: Tensor,
    camera: StereoCamera,
    noise: CornerNoise | None = None,
    *,
    stereo_var: Tensor | None = None,
    start: Tensor | None = None,
    steps: int = 12,
) -> CornerMotion:
    """Returns the most likely motion by Gauss-Newton on the corners' coordinates and disparities.

    The position of each corner has the noise of the earlier row. The motion carries that noise into the prediction of
    the later row, so that a far corner informs the rotation much and the translation little. Student's t weights each
    corner by its residual.

    Args:
        before: corners (u, v, disparity) of the earlier row, ``[*B, N, 3]`` in pixels.
        after: the same corners in the later row.
        seen: ``[*B, N]`` bool: mask of valid corners.
        camera: camera of both rows.
        noise: noise of the corners.
        stereo_var: variance of a corner's constant disparity error, ``[*B, N]`` in pixels^2; by default that of the
            noise, without offsets.
        start: initial motions, ``[*B, 7]``; by default no motion.
        steps: steps of Gauss-Newton.

    Returns:
        A :class:`CornerMotion`; with fewer than four corners the covariance is meaningless. Corners that are not
        finite, or have a disparity below half a pixel, count as not seen.

    Raises:
        ValueError: if the shapes do not match, or ``seen`` is not boolean.
    """
    noise = CornerNoise() if noise is None else noise
    check_count("steps", steps, least=0)
    _check_shapes(before, after, seen, stereo_var, start)
    seen = seen & before.isfinite().all(-1) & after.isfinite().all(-1)
    seen = seen & (before[..., 2] > 0.5) & (after[..., 2] > 0.5)
    before = torch.where(seen.unsqueeze(-1), before, before.new_tensor([*camera.center, 10.0]))
    after = torch.where(seen.unsqueeze(-1), after, before)
    zero = torch.zeros_like(before[..., 2])
    stays = noise.stereo_var(before, zero, zero.bool()) if stereo_var is None else stereo_var
    wrong = torch.zeros_like(stays)  # estimated error of the earlier disparity, pixels
    pose = SE3().neutral(before).expand(*before.shape[:-2], 7) if start is None else start
    ridge, own = 1e-6 * torch.eye(6).to(before), before.new_tensor([0.0, 0.0, 1.0])
    for step in range(steps + 1):
        true = before + wrong.unsqueeze(-1) * own
        points, of_corner = camera.points(true), camera.jacobian_of_points(true)
        turn, moved = rotation_matrix(pose[..., :4]).unsqueeze(-3), points - pose[..., None, 4:]
        moved = rotate(pose[..., None, :4], moved, back=True)
        ahead = seen & (moved[..., 2] > 1.0)
        moved = torch.where(ahead.unsqueeze(-1), moved, moved.new_tensor([0.0, 0.0, 10.0]))
        shown, slope = camera.project(moved), camera.jacobian(moved)
        through = (slope @ turn.mT @ of_corner)[..., 2]
        left = torch.where(ahead.unsqueeze(-1), after - shown + through * wrong.unsqueeze(-1), 0.0)
        cov = _covariance(through, (shown - before)[..., :2].square().sum(-1), stays, noise)
        inverse = torch.linalg.inv(cov)
        both = (stays + noise.disparity**2).unsqueeze(-1) * through - stays.unsqueeze(-1) * own
        likely = (both.unsqueeze(-2) @ inverse @ left.unsqueeze(-1))[..., 0, 0]
        wrong = likely.maximum(0.5 - before[..., 2])
        nis = (left.unsqueeze(-2) @ inverse @ left.unsqueeze(-1))[..., 0, 0]
        weight = torch.where(ahead, (noise.freedom + 3) / (noise.freedom + nis), 0.0)
        jacobian = slope @ torch.cat([skew(moved), -torch.eye(3).to(moved).expand_as(slope)], -1)
        weighted = weight[..., None, None] * jacobian.mT @ inverse
        information = (weighted @ jacobian).sum(-3) + ridge
        if step < steps:
            change = torch.linalg.solve(information, (weighted @ left.unsqueeze(-1)).sum(-3)).squeeze(-1)
            pose = SE3().plus(pose, change.clamp(-1, 1))
    density = -0.5 * torch.logdet(cov) - 0.5 * (noise.freedom + 3) * torch.log1p(nis / noise.freedom)
    freedom = torch.as_tensor(noise.freedom).to(before)
    constant = torch.lgamma((freedom + 3) / 2) - torch.lgamma(freedom / 2) - 1.5 * (freedom * math.pi).log()
    density = density + constant
    mean = torch.where(ahead, density, 0.0).sum(-1) / ahead.sum(-1).clamp_min(1)
    gain = (stays.unsqueeze(-1) * (own - through)).unsqueeze(-2) @ inverse  # gain of the constant error
    error = (gain @ left.unsqueeze(-1))[..., 0, 0]
    var = stays - stays * (gain @ (own - through).unsqueeze(-1))[..., 0, 0]
    error, var = torch.where(ahead, error, 0.0), torch.where(ahead, var, stays)
    return CornerMotion(pose, torch.linalg.inv(information), mean, weight, error, var)


def _check_shapes(before: Tensor, after: Tensor, seen: Tensor, stereo_var: Tensor | None, start: Tensor | None) -> None:
    if before.ndim < 2 or before.shape[-1] != 3:
        raise ValueError(f"before must be corners (u, v, disparity), [*B, N, 3]; got {list(before.shape)}")
    check_shape("after", after, before.shape, "[*B, N, 3], as before")
    check_shape("seen", seen, before.shape[:-1], "[*B, N]")
    if seen.dtype != torch.bool:
        raise ValueError(f"seen must be boolean; got {seen.dtype}")
    if stereo_var is not None:
        check_shape("stereo_var", stereo_var, before.shape[:-1], "[*B, N]")
    if start is not None:
        check_shape("start", start, (*before.shape[:-2], 7), "[*B, 7], points of SE3")


def corner_motions(
    rows: TensorDict,
    camera: StereoCamera,
    noise: CornerNoise | None = None,
    *,
    start: Tensor | None = None,
    steps: int = 6,
    memory: bool = True,
) -> CornerMotion:
    """Returns the motion of each row since the row before, and tracks each corner's disparity error.

    The motion of a corner in the image informs its depth, so that its constant disparity error is estimated better from
    row to row.

    Args:
        rows: rows of :func:`~torch_denkf.applications.car.corners.drive.read_corner_drive`, ``[*B, T]``.
        camera: camera of the rows.
        noise: noise of the corners.
        start: initial motions, ``[*B, T, 7]``; by default from RANSAC.
        steps: steps of Gauss-Newton.
        memory: False to estimate each row independently.

    Returns:
        Motions ``[*B, T]``; they are meaningless if ``"motion_observed"`` is False.
    """
    noise = CornerNoise() if noise is None else noise
    before, after = (camera.corners(rows["corners"][..., row, :]) for row in (0, 1))
    seen, offset = rows["seen"], rows["corners"][..., 0, 1] - rows["corners"][..., 0, 3]
    if start is None:
        flat = before.flatten(0, -3), after.flatten(0, -3), seen.flatten(0, -2)
        start = started_by_ransac(*flat, camera)[0].reshape(*rows.batch_size, 7)
    first = noise.stereo_var(before, offset, rows["repeats"] > 0)
    if not memory:
        return corner_motion(before, after, seen, camera, noise, stereo_var=first, start=start, steps=steps)
    found: list[CornerMotion] = []
    for row in range(rows.batch_size[-1]):
        var, came, there = first[..., row, :], rows["came_from"][..., row, :], seen[..., row, :]
        mean = torch.zeros_like(var)
        if found:
            place = came.clamp_min(0)
            known = (came >= 0) & seen[..., row - 1, :].gather(-1, place)
            mean = torch.where(known, found[-1].stereo.gather(-1, place), mean)
            kept = found[-1].stereo_var.gather(-1, place).minimum(var)
            var = torch.where(known, kept + noise.stereo_walk**2, var)
        less = torch.stack([torch.zeros_like(mean), torch.zeros_like(mean), mean], -1)
        corners = before[..., row, :, :] - less, after[..., row, :, :] - less, there
        one = corner_motion(*corners, camera, noise, stereo_var=var, start=start[..., row, :], steps=steps)
        sound = one.weight > LEAST  # outliers have no information about their disparity
        mean, var = mean + torch.where(sound, one.stereo, 0.0), torch.where(sound, one.stereo_var / one.weight, var)
        found.append(one._replace(stereo=mean, stereo_var=var))
    return CornerMotion(*(torch.stack(entry, rows.ndim - 1) for entry in zip(*found, strict=True)))


def _covariance(by_disparity: Tensor, flow2: Tensor, stays: Tensor | float, noise: CornerNoise) -> Tensor:
    """Returns the covariance of the observations in the later row, ``[*, 3, 3]``.

    Args:
        by_disparity: derivative of the observation with respect to the earlier disparity, ``[*, 3]``.
        flow2: square of the flow ``[*]``.
        stays: variance of the constant disparity error, ``[*]``.
        noise: noise of the corners.
    """
    own = torch.tensor([0.0, 0.0, 1.0]).to(by_disparity)
    same = own - by_disparity
    place = noise.pixel**2 + noise.pixel_per_flow**2 * flow2
    disparity = noise.disparity**2 + noise.disparity_per_flow**2 * flow2
    cov = torch.diag_embed(torch.stack([place, place, disparity], -1))
    stays = torch.as_tensor(stays).to(place).expand_as(place)
    for vector, variance in ((same, stays), (by_disparity, torch.zeros_like(place) + noise.disparity**2)):
        cov = cov + variance[..., None, None] * vector.unsqueeze(-1) * vector.unsqueeze(-2)
    return cov


def started_by_ransac(
    before: Tensor, after: Tensor, seen: Tensor, camera: StereoCamera, *, pixels: float = 1.5
) -> tuple[Tensor, Tensor]:
    """Returns motions of single rows by OpenCV's RANSAC.

    Args:
        before: corners of the earlier rows ``[T, N, 3]``.
        after: corners of the later rows.
        seen: ``[T, N]`` bool.
        camera: camera of both rows.
        pixels: largest reprojection error of an inlier.

    Returns:
        Points of SE3 ``[T, 7]``, the identity if none was found; and the number of inliers, ``[T]`` int64.
    """
    matrix = np.array([[camera.focal, 0, camera.center[0]], [0, camera.focal, camera.center[1]], [0, 0, 1.0]])
    poses = SE3().neutral(before).repeat(len(before), 1)
    fits = torch.zeros(len(before), dtype=torch.int64)
    for row in range(len(before)):
        use = seen[row] & (before[row, :, 2] > 1) & (after[row, :, 2] > 1)
        if use.sum() < 6:
            continue
        points, places = camera.points(before[row, use]).numpy(), after[row, use, :2].contiguous().numpy()
        cv2.setRNGSeed(0)
        found, turn, move, inliers = cv2.solvePnPRansac(points, places, matrix, None, reprojectionError=pixels)
        if found and inliers is not None:
            to_later = torch.as_tensor(cv2.Rodrigues(turn)[0])
            pose = torch.cat([quaternion_of(to_later.mT), -(to_later.mT @ torch.as_tensor(move)).squeeze(-1)])
            poses[row], fits[row] = pose.to(poses), len(inliers)
    return poses, fits
