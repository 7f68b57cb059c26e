"""Holds what the tests of EKF, UKF and Backprop KF share: one linear system in all, and one that is not linear."""

import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.factories import NoisyLinear, linear_system
from torch_denkf.baselines import BackpropKF
from torch_denkf.filters import EKF, UKF
from torch_denkf.modules import (
    CholeskyNoise,
    ConstantNoise,
    DiagonalNoise,
    LearnedObservation,
    LearnedTransition,
    LinearObservation,
    MappedNoise,
    MomentPrior,
    StochasticMLP,
    VectorSensor,
)

CONTROL = [[0.5], [-1.0]]
FILTERS = {"EKF": EKF, "UKF": UKF, "BackpropKF": BackpropKF}
BELIEF = [("belief", name) for name in ("mean", "cov", "var")]
INFO = [("info", name) for name in ("innovation", "nis", "log_likelihood")]


def known_process_noise():
    """Returns the Q of :func:`linear_system`, as a module."""
    unit = ConstantNoise([1.0, 1.0], in_key=("belief", "mean"), out_key=("forecast", "noise"))
    return MappedNoise(unit, torch.linalg.cholesky(linear_system()[1]))


def prior():
    return MomentPrior(torch.tensor([1.0, -1.0]), torch.diag(torch.tensor([1.0, 2.0])))


def linear_filter(name, *, control=False, process_noise=None, noise=None, **kwargs):
    """Returns the system of :func:`linear_system` in an EKF, a UKF or a Backprop KF."""
    F, _, H, R = linear_system()
    control = torch.tensor(CONTROL) if control else None
    q = known_process_noise() if process_noise is None else process_noise
    r = ConstantNoise(R.sqrt(), in_key="observation") if noise is None else noise
    keys = {"initial": prior(), "observation_key": "observation", **kwargs}
    if name == "BackpropKF":
        return BackpropKF(F, None, H, r, process_noise_cov=q, control=control, **keys)
    return FILTERS[name](NoisyLinear(F, control=control), None, LinearObservation(H), r, process_noise=q, **keys)


def linear_frames(*batch, width=2, resets=True, missing=0.3):
    """Returns readings, NaN where they are not observed, actions, and starts that differ between rows."""
    frames = TensorDict({"observation": torch.randn(*batch, 2), "action": torch.randn(*batch, 1)}, batch)
    frames["observed"] = torch.rand(*batch, width) >= missing
    frames["observation"] = torch.where(frames["observed"], frames["observation"], torch.nan)
    if resets:
        frames["is_init"] = torch.rand(*batch, 1) < 0.1
        frames["is_init"][..., 0, :] = True
    return frames


def learned_filter(name, *, layer="none", **kwargs):
    """Everything learned: 3 states, 4 measurements, 2 observations, 2 actions, Q and R full and state-dependent."""
    mlp = {"layer": layer, "activation": nn.Tanh}
    sensor = VectorSensor(4, 2, ensemble_size=3, num_cells=(8,), rate=0.5, layer="none", in_key="measurement")
    r = CholeskyNoise(
        2, r=0.5, constant=False, num_cells=(4,), in_features=4, in_key="measurement", out_key=("sensor", "noise")
    )
    q = DiagonalNoise(3, r=0.3, num_cells=(4,), in_key=("belief", "mean"), out_key=("forecast", "noise"))
    keys = {"initial": MomentPrior(torch.zeros(3), torch.eye(3)), **kwargs}
    if name == "BackpropKF":
        q = CholeskyNoise(3, r=0.3)
        A, B, C = 0.5 * torch.randn(3, 3), torch.randn(3, 2), torch.randn(2, 3)
        filter = BackpropKF(A, sensor, C, r, process_noise_cov=q, control=B, trainable=True, **keys)
    else:
        transition = LearnedTransition(StochasticMLP(5, 3, (8, 8), output_gain=0.5, **mlp), action_key="action")
        observation = LearnedObservation(StochasticMLP(3, 2, (8,), **mlp))
        filter = FILTERS[name](transition, sensor, observation, r, process_noise=q, **keys)
    with torch.no_grad():  # the noise networks start at zero, where much of their gradient is zero, too
        for module in (r, q):
            for parameter in module.parameters():
                parameter.add_(0.1 * torch.randn_like(parameter))
    return filter


def learned_frames(*batch):
    frames = TensorDict({"measurement": torch.randn(*batch, 4), "action": torch.randn(*batch, 2)}, batch)
    frames["observed"] = torch.rand(*batch, 2) < 0.7
    frames["is_init"] = torch.rand(*batch, 1) < 0.2
    frames["is_init"][..., 0, :] = True
    return frames


def minimise(loss, frames, parameters, max_iter):
    """By L-BFGS; the loss before and after."""
    optimiser = torch.optim.LBFGS(list(parameters), max_iter=max_iter, line_search_fn="strong_wolfe")

    def closure():
        optimiser.zero_grad()
        value = sum(loss(frames).values())
        value.backward()
        return value

    return optimiser.step(closure), closure()


def directional_check(loss, parameters, *, step=1e-5, rtol=1e-5):
    """The gradient along one random direction in all parameters, against a central difference; all must matter."""
    parameters = list(parameters)
    gradients = torch.autograd.grad(loss(), parameters)
    assert all(g.isfinite().all() for g in gradients)
    assert all((g != 0).any() for g in gradients)
    directions = [torch.randn_like(p) for p in parameters]
    values = []
    with torch.no_grad():
        for size in (step, -2 * step):
            for parameter, direction in zip(parameters, directions, strict=True):
                parameter.add_(size * direction)
            values.append(loss())
    expected = (values[0] - values[1]) / (2 * step)
    got = sum((g * d).sum() for g, d in zip(gradients, directions, strict=True))
    torch.testing.assert_close(got, expected, rtol=rtol, atol=1e-7)
