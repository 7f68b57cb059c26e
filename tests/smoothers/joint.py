"""The oracle of all smoothers: all states and readings of a linear system as one Gaussian, conditioned by a solve."""

from itertools import pairwise

import torch
from tensordict import TensorDict

from tests.filters.factories import linear_system

MEAN, COV = [1.0, -1.0], [1.0, 2.0]  # of the first state, in tests.filters.factories.linear_kalman


def joint_beliefs(frames, lag=None):
    """Returns means ``[B, T, S]`` and covariances ``[B, T, S, S]`` of the states given the readings up to t + lag.

    Args:
        frames: ``[B, T]`` with readings, masks of single components and beginnings of episodes, whose own frame is not
            read.
        lag: ``None`` for all of the episode.
    """
    means, covs = [], []
    for row in frames:
        starts = [*row["is_init"].flatten().nonzero().flatten().tolist(), len(row)]
        parts = [_episode(row[start:end], lag) for start, end in pairwise(starts)]
        means.append(torch.cat([mean for mean, _ in parts]))
        covs.append(torch.cat([cov for _, cov in parts]))
    return torch.stack(means), torch.stack(covs)


def _episode(frames, lag):
    F, Q, H, R = linear_system()
    count, size = len(frames), len(F)
    # x = A x0 + L w with independent parts: the joint covariance in one product.
    powers = [torch.linalg.matrix_power(F, t) for t in range(count)]
    roots = [torch.diag(torch.tensor(COV)).sqrt(), *[torch.linalg.cholesky(Q)] * (count - 1)]
    zero = torch.zeros(size, size)
    mix = torch.cat(
        [torch.cat([powers[t - s] @ roots[s] if s <= t else zero for s in range(count)], 1) for t in range(count)]
    )
    mean = torch.cat([power @ torch.tensor(MEAN) for power in powers])
    cov = mix @ mix.mT
    observe = torch.block_diag(*[H] * count)
    noise = torch.diag(R.repeat(count))
    observed = frames["observed"].expand(count, size).clone()
    observed[0] = False
    readings = frames["observation"].reshape(-1)
    means, covs = [], []
    for t in range(count):
        seen = observed.clone()
        if lag is not None:
            seen[t + lag + 1 :] = False
        index = seen.reshape(-1).nonzero().flatten()
        matrix, at = observe[index], slice(size * t, size * (t + 1))
        gain = torch.linalg.solve(matrix @ cov @ matrix.mT + noise[index][:, index], matrix @ cov).mT
        means.append((mean + gain @ (readings[index] - matrix @ mean))[at])
        covs.append((cov - gain @ matrix @ cov)[at, at])
    return torch.stack(means), torch.stack(covs)


def drive(rows, count, *, seed=0, missing=0.3, resets=True):
    """Returns readings of the linear system, of which components are missing, NaN there, with beginnings inside."""
    F, Q, H, R = linear_system()
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    state, readings = torch.tensor(MEAN) + torch.tensor(COV).sqrt() * normal(rows, 2), []
    for _ in range(count):
        readings.append(state @ H.mT + R.sqrt() * normal(rows, 2))
        state = state @ F.mT + normal(rows, 2) @ torch.linalg.cholesky(Q).mT
    frames = TensorDict({"observation": torch.stack(readings, 1)}, [rows, count])
    frames["observed"] = torch.rand(rows, count, 2, generator=generator) >= missing
    frames["observation"] = torch.where(frames["observed"], frames["observation"], torch.nan)
    frames["is_init"] = torch.zeros(rows, count, 1, dtype=torch.bool)
    frames["is_init"][:, 0] = True
    if resets:
        for row in range(rows):
            frames["is_init"][row, 3 + row % (count - 4)] = True
    return frames
