"""Particle filters for tests: all parts learned, and the bootstrap filter of the linear system."""

import torch
from tensordict import TensorDict

from tests.filters.factories import OBS, A, M, NoisyLinear, S, linear_kalman, linear_system
from torch_denkf.filters import ParticleFilter
from torch_denkf.modules import (
    ConstantNoise,
    DiagonalNoise,
    GaussianLikelihood,
    GaussianPrior,
    LearnedLikelihood,
    LearnedObservation,
    LearnedTransition,
    LinearObservation,
    NoisyTransition,
    StochasticMLP,
    VectorSensor,
)

E = 6
BELIEF = [("belief", name) for name in ("ensemble", "log_weight", "mean", "var")]
SCHEMES = ["systematic", "soft", "transport", None]


def toy_parts(ensemble_size=E):
    transition = LearnedTransition(StochasticMLP(S + A, S, (8,), rate=0.3, output_gain=0.5), action_key="action")
    q = DiagonalNoise(2, r=0.5, in_features=S, num_cells=(4,), in_key=("belief", "mean"), out_key=("forecast", "q"))
    return {
        "transition": NoisyTransition(transition, q, [0, 2]),
        "sensor": VectorSensor(M, OBS, ensemble_size=ensemble_size, num_cells=(8,), rate=0.5),
        "observation": LearnedObservation(StochasticMLP(S, OBS, (8,), layer="none")),
        "initial": GaussianPrior(torch.zeros(S), torch.ones(S), ensemble_size=ensemble_size),
    }


def toy_filter(scheme="soft", learned=False, **kwargs):
    """Returns all parts learned; the likelihood Gaussian, or learned on the measurement itself."""
    options = {"likelihood": LearnedLikelihood(M, OBS, num_cells=(8,), encoding_key="measurement")} if learned else {}
    if not learned:
        options["noise"] = DiagonalNoise(OBS, r=0.5, num_cells=(4,))
    return ParticleFilter(**toy_parts(), **options, resampling=scheme, alpha=0.3, **kwargs)


def bootstrap(size, *, noisy=True, initial=None, observed_key="observed", **kwargs):
    """Returns the bootstrap filter of :func:`linear_system`, with the prior of :func:`linear_kalman`."""
    F, Q, H, R = linear_system()
    kf = linear_kalman()
    prior = GaussianPrior(kf.initial.mean, kf.initial.cov.diagonal().sqrt(), ensemble_size=size)
    return ParticleFilter(
        NoisyLinear(F, torch.linalg.cholesky(Q) if noisy else None),
        None,
        LinearObservation(H),
        GaussianLikelihood(observation_key="observation", observed_key=observed_key),
        noise=ConstantNoise(R.sqrt(), in_key="observation"),
        initial=prior if initial is None else initial,
        observed_key=observed_key,
        **kwargs,
    )


def readings(steps, masked=True):
    td = TensorDict({"observation": torch.randn(steps, 2)}, [steps])
    return td.set("observed", torch.rand(steps, 2) < 0.8) if masked else td
