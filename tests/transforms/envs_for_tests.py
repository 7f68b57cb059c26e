"""Environments for tests; importable, so that worker processes find them."""

import torch
from torchrl.envs import ParallelEnv, Transform, TransformedEnv

from tests.filters.factories import A, M, S, linear_denkf, linear_system, toy_denkf
from torch_denkf.envs.linear import LinearGaussianEnv
from torch_denkf.modules import GaussianPrior
from torch_denkf.transforms import DEnKFTransform

PRIOR_MEAN = [0.5, -0.25]
BELIEF = [("belief", "ensemble"), ("belief", "mean"), ("belief", "var")]
STEPS = [3, 5]  # episode lengths of the two (or first two) rows


def forked_env(workers, *args, **kwargs):
    """Returns a ``ParallelEnv`` of forked workers, which need no imports and so start fast."""
    return ParallelEnv(workers, *args, mp_start_method="fork", **kwargs)


class Changed(Transform):
    """Returns what a function makes of each frame, that of a reset and those of steps."""

    def __init__(self, change):
        super().__init__()
        self.change = change

    def _call(self, next_tensordict):
        return self.change(next_tensordict)

    def _reset(self, tensordict, tensordict_reset):
        return self.change(tensordict_reset)


def base_env(**kwargs):
    """Returns the system of :func:`linear_system` as an environment; emits "observation", "observed" and "state"."""
    F, Q, H, R = linear_system()
    return LinearGaussianEnv(F, H, Q.diagonal().sqrt(), R.sqrt(), **kwargs)


def known_start_filter(**kwargs):
    """Returns a noisy ensemble filter whose prior has no spread: the belief after a reset is known exactly."""
    prior = GaussianPrior(PRIOR_MEAN, [0.0, 0.0], ensemble_size=6)
    return linear_denkf("perturbed", noisy=True, initial=prior, **kwargs)


def half_known_filter(**kwargs):
    """Returns an ensemble filter whose prior has a spread in the second component alone."""
    prior = GaussianPrior(PRIOR_MEAN, [0.0, 1.0], ensemble_size=6)
    return linear_denkf("perturbed", noisy=True, initial=prior, **kwargs)


def fixed_filter(**kwargs):
    """Returns an ensemble filter without any randomness."""
    return linear_denkf("etkf", **kwargs)


def random_filter(**kwargs):
    """Returns an ensemble filter with a random prior, random forecasts and random perturbations."""
    prior = GaussianPrior(PRIOR_MEAN, [1.0, 1.0], ensemble_size=6)
    return linear_denkf("perturbed", noisy=True, initial=prior, **kwargs)


def filtered_env(make_filter=known_start_filter, *, transform=None, **kwargs):
    """Returns the transform right on the environment."""
    return TransformedEnv(base_env(**kwargs), DEnKFTransform(make_filter(), **(transform or {})))


def toy_base_env(**kwargs):
    """Returns a stable system with S states, M measurements and A actions, for :func:`toy_denkf`."""
    generator = torch.Generator().manual_seed(0)
    matrix = 0.5 * torch.randn(S, S, generator=generator)
    return LinearGaussianEnv(
        matrix / torch.linalg.matrix_norm(matrix, 2).clamp_min(1.0),
        torch.randn(M, S, generator=generator),
        [0.3] * S,
        [0.1] * M,
        control=torch.randn(S, A, generator=generator),
        **kwargs,
    )


def toy_filter(**kwargs):
    """Returns four learned sub-models that read "observation"."""
    return toy_denkf(in_key="observation", **kwargs)


def seeded_env(seed, **kwargs):
    """Returns the plain environment, seeded: a worker's."""
    return base_env(seed=seed, **kwargs)


def random_rollout(env, steps=12):
    """Runs random actions across the ends of episodes."""
    return env.rollout(steps, break_when_any_done=False)
