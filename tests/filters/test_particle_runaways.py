"""Particles that run away. Oracle: a bootstrap filter in numpy, with many more particles, that lets them run.

The motion x + 0.2 (x - x^3) has two stable points, -1 and 1, and throws whatever begins beyond +-3.3 to infinity within
some steps; with a prior of standard deviation 2 every tenth particle does.
"""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf.filters import ParticleFilter
from torch_denkf.modules import ConstantNoise, GaussianLikelihood, GaussianPrior, Select, SubModel

STEPS, EVERY, Q, R, PRIOR = 48, 6, 0.1, 0.3, 2.0
MEAN, VAR = ("belief", "mean"), ("belief", "var")


class Cubic(SubModel):
    def __init__(self):
        super().__init__(nn.Identity(), [("belief", "ensemble")], [("forecast", "ensemble")])
        self.rate = nn.Parameter(torch.tensor(0.2))

    def compute(self, state):
        return state + self.rate * (state - state**3)


def cubic_filter(size=1000, resampling="systematic", **kwargs):
    return ParticleFilter(
        Cubic(),
        None,
        Select([0]),
        GaussianLikelihood(observation_key="reading"),
        noise=ConstantNoise([R], in_key="reading"),
        initial=GaussianPrior([0.0], [PRIOR], ensemble_size=size),
        process_noise=[Q],
        resampling=resampling,
        **kwargs,
    )


def drive(seed=0):
    """Returns readings at each sixth step, and the true states, ``[T]`` each."""
    random = np.random.default_rng(seed)
    state, states = 0.5 * random.standard_normal(), []
    for _ in range(STEPS):
        state = state + 0.2 * (state - state**3) + Q * random.standard_normal()
        states.append(state)
    states = np.array(states)
    return states + R * random.standard_normal(STEPS), np.arange(STEPS) % EVERY == EVERY - 1, states


def numpy_bootstrap(readings, observed, size=100_000):
    """Returns means and variances from the first reading on; particles that are no number any more have no weight."""
    random = np.random.default_rng(1)
    particles, weights = PRIOR * random.standard_normal(size), np.full(size, 1 / size)
    moments = []
    with np.errstate(over="ignore", invalid="ignore"):
        for step in range(1, STEPS):
            particles = particles + 0.2 * (particles - particles**3) + Q * random.standard_normal(size)
            if observed[step]:
                fit = -0.5 * ((readings[step] - particles) / R) ** 2
                weights = weights * np.exp(np.where(np.isfinite(fit), fit, -np.inf))
                weights /= weights.sum()
            if step >= EVERY - 1:
                alive = weights > 0
                mean = (weights[alive] * particles[alive]).sum()
                moments.append((mean, (weights[alive] * (particles[alive] - mean) ** 2).sum()))
            if observed[step]:
                particles = particles[random.choice(size, size, p=weights)]
                weights = np.full(size, 1 / size)
    return np.array(moments).T


def frames(readings, observed, *batch):
    entries = {"reading": torch.tensor(readings, dtype=torch.get_default_dtype()).unsqueeze(-1)}
    entries["observed"] = torch.tensor(observed).unsqueeze(-1)
    return TensorDict(entries, [STEPS]).expand(*batch, STEPS).clone()


@pytest.mark.filterwarnings("ignore:The variance")
@pytest.mark.parametrize("resampling", ["systematic", "soft", None])
@pytest.mark.parametrize("precision", ["single", "float64"])
def test_diverged_particles_do_not_affect_the_others(resampling, precision, request):
    if precision == "float64":
        request.getfixturevalue(precision)
    filter, (readings, observed, states) = cubic_filter(300, resampling), drive()
    with torch.no_grad():
        out = filter.sequence(frames(readings, observed, 8))
    mean, var = numpy_bootstrap(readings, observed)
    found = out[MEAN][:, EVERY - 1 :, 0].double().numpy()
    # The error of the mean of 300 particles, of which resampling and weights leave a third or so, over 8 rows.
    scatter = np.sqrt(var / (8 * 100)).max()
    assert np.abs(found.mean(0) - mean).max() < 6 * scatter
    error = np.sqrt(((found - states[EVERY - 1 :]) ** 2).mean())
    assert abs(error - np.sqrt(((mean - states[EVERY - 1 :]) ** 2).mean())) < 0.03


@pytest.mark.filterwarnings("ignore:The variance")
@pytest.mark.parametrize("resampling", ["systematic", "soft", None])
def test_gradients_stay_finite(resampling):
    filter = cubic_filter(100, resampling, variance_ceiling=None)
    readings, observed, states = drive()
    out = filter.sequence(frames(readings, observed, 4))
    error = out[MEAN][:, EVERY - 1 :, 0] - torch.tensor(states[EVERY - 1 :], dtype=torch.float32)
    error.square().mean().backward()
    (gradient,) = [p.grad for p in filter["transition"].parameters() if p.requires_grad]
    assert gradient.isfinite()
    assert gradient != 0


def test_losing_all_particles_raises():
    filter = cubic_filter(8)
    readings, observed, _ = drive()
    frame = filter.initialise(frames(readings, observed)[0])
    frame["belief", "ensemble"] = torch.full((8, 1), 1e8)  # 1e24 after the motion: the cube is beyond all numbers
    with pytest.raises(ValueError, match="diverged"):
        filter.step(filter.step(frame))


def test_weight_of_a_lost_particle_is_redistributed():
    """By hand: three particles with weights 1/2, 1/4, 1/4, of which the second runs away, are two with 2/3, 1/3."""
    filter = cubic_filter(3, None, variance_ceiling=None)
    entries = {"belief": {"ensemble": torch.tensor([[0.0], [1e10], [1.0]])}, "reading": torch.zeros(1)}
    entries["belief"]["log_weight"] = torch.tensor([0.5, 0.25, 0.25]).log()
    frame = TensorDict({**entries, "observed": torch.tensor([False])})
    frame["noise", "transition.transition"] = torch.zeros(3, 1)
    out = filter.step(frame)
    torch.testing.assert_close(out["belief", "log_weight"].exp(), torch.tensor([2 / 3, 0.0, 1 / 3]))
    assert out["belief", "ensemble"].flatten().tolist() == [0.0, 0.0, 1.0]  # the heaviest is where the lost one was
    torch.testing.assert_close(out[MEAN], torch.tensor([1 / 3]))
