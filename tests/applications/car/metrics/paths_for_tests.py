"""Paths for tests, and the same paths as evo takes them."""

import numpy as np
import torch
from evo.core.metrics import RPE, PoseRelation
from evo.core.trajectory import PosePath3D
from evo.core.units import Unit

from torch_denkf.applications.car import dead_reckoning


def straight(rows=201, step=1.0):
    x = step * torch.arange(rows, dtype=torch.float64)
    return torch.stack([x, torch.zeros_like(x), torch.zeros_like(x)], -1)


def winding(seed, rows=400, step=None, batch=()):
    """Returns a bent path; steps of 0.5 to 1.5 m, or of one length."""
    rng = torch.Generator().manual_seed(seed)
    speed = 5 + 10 * torch.rand(*batch, rows, generator=rng, dtype=torch.float64)
    speed = speed if step is None else torch.full_like(speed, 10 * step)
    turn = 0.3 * torch.randn(*batch, rows, generator=rng, dtype=torch.float64)
    start = torch.randn(*batch, 3, generator=rng, dtype=torch.float64)
    return dead_reckoning(torch.stack([speed, turn], -1), start, 0.1)


def matrices(path):
    """Returns poses [T, 3] as SE(3) matrices, in the plane z = 0."""
    out = np.tile(np.eye(4), (len(path), 1, 1))
    x, y, theta = path.T.numpy()
    out[:, 0, 0] = out[:, 1, 1] = np.cos(theta)
    out[:, 1, 0], out[:, 0, 1] = np.sin(theta), -np.sin(theta)
    out[:, 0, 3], out[:, 1, 3] = x, y
    return out


def evo_errors(estimated, truth, delta, unit=Unit.frames, tolerance=0.1):
    """evo's relative pose errors of all pairs: last rows of the pairs, metres, degrees."""
    pair = tuple(PosePath3D(poses_se3=list(matrices(path))) for path in (truth, estimated))
    errors = []
    for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg):
        rpe = RPE(relation, delta, unit, tolerance, all_pairs=True, pairs_from_reference=True)
        rpe.process_data(pair)
        errors.append(torch.tensor(rpe.error))
    return torch.tensor(rpe.delta_ids), *errors
