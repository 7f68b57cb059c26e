"""Filters whose noises come from entries or from modules, and what they read; fuzz and tests share them."""

from functools import partial

import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.factories import linear_system
from torch_denkf import EKF, UKF, DEnKF, FusedFilter, FusedSensor, ParticleFilter
from torch_denkf.filters import Filter
from torch_denkf.functional.manifolds import SO3
from torch_denkf.modules import (
    ConstantNoise,
    EKFAnalysis,
    EnsembleAnalysis,
    GaussianPrior,
    KalmanAnalysis,
    LearnedTransition,
    LinearObservation,
    LinearTransition,
    MomentPrior,
    SubModel,
)
from torch_denkf.motions import AttitudeMotion, PoseOf
from torch_denkf.submodel import Sensor

B, T = 2, 4
AT = (1, 2)  # row and time that are wrong


class Given(SubModel):
    """Writes an entry of the tensordict as a noise."""

    def __init__(self, key, out_key):
        super().__init__(nn.Identity(), [key], [out_key])

    def compute(self, value):
        return value


class Made(Sensor):
    """Makes a noise of the reading: wrong where that is 7."""

    observation_dim = 2

    def __init__(self, wrong, sound, key, out_key):
        super().__init__(nn.Identity(), [key], [out_key])
        self.register_buffer("wrong", wrong)
        self.register_buffer("sound", sound)

    def compute(self, reading, *, batch_size):
        bad = (reading[..., 0] == 7).reshape(*batch_size, *[1] * self.sound.ndim)
        return torch.where(bad, self.wrong, self.sound)


def filter_of(name, r, q):
    """Returns a filter of the linear system with the noise modules ``r`` and ``q``."""
    F, _, H, _ = linear_system()
    moments = MomentPrior(torch.zeros(2), torch.eye(2))
    members = GaussianPrior(torch.zeros(2), torch.ones(2), ensemble_size=8)
    motion = LearnedTransition(nn.Linear(2, 2, bias=False), residual=False)
    with torch.no_grad():
        motion.module.weight.copy_(F)
    parts = {"observation": LinearObservation(H), "noise": r, "observation_key": "observation", "process_noise": q}
    if name == "KalmanFilter":
        analysis = KalmanAnalysis(H, None)
        modules = {"noise": r, "transition": LinearTransition(F, q), "analysis": analysis}
        return Filter(modules, initial=moments)
    if name in ("EKF", "UKF"):
        return {"EKF": EKF, "UKF": UKF}[name](motion, None, **parts, initial=moments)
    if name == "particles":
        return ParticleFilter(motion, None, **parts, initial=members)
    if name.startswith("Fused"):
        sensor = FusedSensor(LinearObservation(H), r, observation_key="observation", observed_key="observed")
        analysis = EKFAnalysis if name == "FusedEKF" else partial(EnsembleAnalysis, "etkf")
        prior = moments if name == "FusedEKF" else members
        return FusedFilter(motion, {"gps": sensor}, initial=prior, process_noise=q, analysis=analysis)
    del parts["observation_key"]
    analysis = EnsembleAnalysis(name, observation_key="observation")
    return DEnKF(motion, None, **parts, analysis=analysis, initial=members)


def sound_frames():
    """Returns readings ``[B, T]``, and variances for R and Q."""
    frames = TensorDict({"observation": 0.1 * torch.ones(B, T, 2), "observed": torch.ones(B, T, 1).bool()}, [B, T])
    frames["is_init"] = torch.zeros(B, T, 1, dtype=torch.bool)
    frames["is_init"][:, 0] = True
    frames["r"], frames["q"] = (torch.tensor([0.5, 0.3]).expand(B, T, 2).clone() for _ in range(2))
    return frames


def run(filter, frames, way):
    if way == "sequence":
        return filter.sequence(frames.copy())
    row = filter.initialise(frames[:, 0].exclude("is_init"))
    for t in range(1, frames.shape[1]):
        row = filter.step(row.update(frames[:, t].exclude("is_init")))
    return row


def attitude(kind):
    """Returns a filter of an attitude, whose steps differ in length, and a row for it."""
    motion, r = AttitudeMotion("dt", gyro_noise=0.1, gyro_walk=0.01), ConstantNoise([0.1] * 3, in_key="y")
    space = motion.space
    if kind == "EKF":
        initial = MomentPrior(space.neutral(), 0.01 * torch.eye(6), space=space)
    else:
        initial = GaussianPrior(space.neutral(), 0.1 * torch.ones(6), ensemble_size=16, space=space)
    options = {"process_noise": motion.process_noise, "initial": initial}
    reading = {"observation_key": "y", "reading_space": SO3()}
    if kind == "EKF":
        filter = EKF(motion, None, PoseOf(space), r, **options, **reading)
    else:
        analysis = EnsembleAnalysis("etkf", space=space, **reading)
        filter = DEnKF(motion, None, PoseOf(space), r, analysis, **options)
    rows = TensorDict({"y": torch.tensor([1.0, 0, 0, 0]).repeat(2, 3, 1), "gyro": torch.zeros(2, 3, 3)}, [2, 3])
    return filter, rows.set("dt", torch.full((2, 3, 1), 0.1))
