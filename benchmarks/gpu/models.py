"""Filters and data of the study, for any dimension of the state."""

from __future__ import annotations

from functools import partial

import torch
from tensordict import TensorDict

from torch_denkf.filters import EKF, UKF, DEnKF, Filter, KalmanFilter, ParticleFilter
from torch_denkf.modules import (
    ConstantNoise,
    EnsembleAnalysis,
    GaussianLikelihood,
    GaussianPrior,
    LearnedObservation,
    LearnedTransition,
    MomentPrior,
    StochasticMLP,
)

HIDDEN, MEMBERS, READING = (32, 32, 64, 64), 32, "reading"


def networks(
    dims: int, layer: str, key: str = READING
) -> tuple[LearnedTransition, None, LearnedObservation, ConstantNoise]:
    """Returns transition, observation and noise of a filter; half of the state is observed."""
    torch.manual_seed(0)
    observed = max(2, dims // 2)
    motion = LearnedTransition(StochasticMLP(dims, dims, HIDDEN, layer=layer, output_gain=0.3))
    observation = LearnedObservation(StochasticMLP(dims, observed, HIDDEN, layer="none"))
    return motion, None, observation, ConstantNoise([0.5] * observed, in_key=key)


def _kalman(dims: int) -> Filter:
    observed = max(2, dims // 2)
    return KalmanFilter(
        0.95 * torch.eye(dims),
        torch.eye(observed, dims),
        process_noise=[0.1] * dims,
        noise=[0.5] * observed,
        mean=torch.zeros(dims),
        cov=torch.eye(dims),
        observation_key=READING,
    )


def _moments(kind: type[EKF | UKF], dims: int) -> Filter:
    noise = ConstantNoise([0.1] * dims, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    start = MomentPrior(torch.zeros(dims), torch.eye(dims))
    return kind(*networks(dims, "none"), process_noise=noise, initial=start, observation_key=READING)


def _ensemble(scheme: str, dims: int, key: str = READING) -> Filter:
    start = GaussianPrior(torch.zeros(dims), torch.ones(dims), ensemble_size=MEMBERS)
    analysis = EnsembleAnalysis(scheme, observation_key=key)
    return DEnKF(*networks(dims, "dropout", key), analysis, initial=start)


def _particles(dims: int) -> Filter:
    motion, _, observation, noise = networks(dims, "dropout")
    start = GaussianPrior(torch.zeros(dims), torch.ones(dims), ensemble_size=4 * MEMBERS)
    likelihood = GaussianLikelihood(observation_key=READING)
    return ParticleFilter(motion, None, observation, likelihood, noise=noise, initial=start, resampling="systematic")


MODELS = {
    "Kalman filter": _kalman,
    "EKF": partial(_moments, EKF),
    "UKF": partial(_moments, UKF),
    "DEnKF, perturbed": partial(_ensemble, "perturbed"),
    "DEnKF, etkf": partial(_ensemble, "etkf"),
    "particle filter": _particles,
}


def frames(dims: int, batch: int, steps: int, device: str) -> TensorDict:
    """Returns readings ``[batch, steps, O]``."""
    generator = torch.Generator().manual_seed(1)
    reading = torch.randn(batch, steps, max(2, dims // 2), generator=generator)
    return TensorDict({READING: reading}, [batch, steps]).to(device)


#: Four legs of three joints each, 12 kg: for filters whose readings come from a simulator on the device.
ROBOT = """<mujoco><worldbody><body name="trunk" pos="0 0 .3"><freejoint/>
<geom type="box" size=".2 .1 .05" mass="8"/><site name="imu" pos=".02 0 .01"/>{}</body></worldbody></mujoco>"""
LEG = """<body pos="{x} {y} 0"><joint name="{n}_a" axis="1 0 0"/><geom type="sphere" size=".03" mass=".4"/>
<body pos="0 {s} 0"><joint name="{n}_b" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".4"/>
<body pos="0 0 -.2"><joint name="{n}_c" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".015" mass=".2"/>
<site name="{n}" pos="0 0 -.2"/></body></body></body>"""
#: Position of each leg, and sideways offset of its knee.
CORNERS = {
    "front_left": (0.19, 0.05, 0.08),
    "front_right": (0.19, -0.05, -0.08),
    "back_left": (-0.19, 0.05, 0.08),
    "back_right": (-0.19, -0.05, -0.08),
}


def robot_filter(kind: str, members: int = 64) -> Filter:
    """Returns a legged robot's filter; MuJoCo only reads the model, without simulation."""
    import mujoco

    from torch_denkf.applications.legged import legged_filter

    legs = "".join(LEG.format(n=name, x=x, y=y, s=s) for name, (x, y, s) in CORNERS.items())
    model = mujoco.MjModel.from_xml_string(ROBOT.format(legs))
    return legged_filter(model, feet=list(CORNERS), imu="imu", dt=0.02, kind=kind, ensemble_size=members)


def robot_readings(batch: int, device: str) -> TensorDict:
    """Returns readings of robots that stand, with noise."""
    generator = torch.Generator().manual_seed(2)

    def noisy(mean: list[float], std: float) -> torch.Tensor:
        return torch.tensor(mean) + std * torch.randn(batch, len(mean), generator=generator)

    entries = {
        "imu": noisy([0, 0, 0, 0, 0, 9.81], 0.02),
        "joints": noisy([0.0, 0.6, -1.2] * 4, 0.01),
        "joint_rates": noisy([0.0] * 12, 0.05),
        "contact": torch.ones(batch, 4, dtype=torch.bool),
    }
    return TensorDict(entries, [batch]).to(device)
