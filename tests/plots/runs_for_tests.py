"""Small runs whose beliefs are drawn: a Kalman filter that is calibrated by construction, and an ensemble."""

from functools import cache

import torch
from tensordict import TensorDict

from torch_denkf.envs import LinearGaussianEnv
from torch_denkf.filters import KalmanFilter
from torch_denkf.smoothers import FixedLag

DT = 0.1


@cache
def kalman_runs(batch=60, steps=80, lag=0):
    """Returns sequences [batch, steps] of the state [x, y, vx, vy], with a third of the readings missing, smoothed."""
    F = torch.eye(4)
    F[0, 2] = F[1, 3] = DT
    H = torch.eye(2, 4)
    env = LinearGaussianEnv(F, H, [0.01, 0.01, 0.1, 0.1], [0.4, 0.4], missing=0.33, max_steps=steps, batch_size=[batch])
    Q = torch.diag(torch.tensor([1e-4, 1e-4, 0.01, 0.01]))
    kf = KalmanFilter(F, H, process_noise_cov=Q, noise_cov=0.16 * torch.eye(2), mean=torch.zeros(4), cov=torch.eye(4))
    with torch.no_grad():
        return (FixedLag(kf, lag) if lag else kf).sequence(env.rollout(steps)["next"])


def ensemble_run(steps=40, members=19, seed=0):
    """Returns a belief of random members around a circle, with truth and mask; [steps]."""
    rng = torch.Generator().manual_seed(seed)
    t = torch.arange(steps) * DT
    truth = torch.stack([t.cos(), t.sin(), t], -1)
    ensemble = truth.unsqueeze(1) + 0.1 * torch.randn(steps, members, 3, generator=rng)
    observed = torch.ones(steps, 1, dtype=torch.bool)
    observed[10:15] = observed[30:31] = False
    belief = {"ensemble": ensemble, "mean": ensemble.mean(1), "var": ensemble.var(1)}
    return TensorDict({"belief": belief, "state": truth, "observed": observed}, [steps])
