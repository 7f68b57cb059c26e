"""Sub-models of a filter, each a TensorDict module with its own keys.

Import from here: ``from torch_denkf.modules import EnsembleAnalysis, ImageSensor, ...``.
"""

from torch_denkf.modules.analysis import EnsembleAnalysis
from torch_denkf.modules.around import Around
from torch_denkf.modules.belief import AroundState, FromSensor, GaussianPrior
from torch_denkf.modules.ekf import EKFAnalysis, EKFTransition
from torch_denkf.modules.kalman import GaussianAround, KalmanAnalysis, LinearTransition, MomentPrior
from torch_denkf.modules.keypoints import KeypointTrunk
from torch_denkf.modules.likelihood import GaussianLikelihood, LearnedLikelihood
from torch_denkf.modules.local_analysis import LocalEnsembleAnalysis
from torch_denkf.modules.motion_noise import NoisyTransition
from torch_denkf.modules.noise import ConstantNoise, DiagonalNoise, ScaledNoise
from torch_denkf.modules.observation import LearnedObservation, LinearObservation, Select
from torch_denkf.modules.process_noise import CholeskyNoise, MappedNoise
from torch_denkf.modules.sensor import ImageSensor, VectorSensor, convolutional_trunk
from torch_denkf.modules.stochastic import StochasticMLP, deterministic
from torch_denkf.modules.transition import LearnedTransition
from torch_denkf.modules.ukf import UKFAnalysis, UKFTransition
from torch_denkf.submodel import Initial, SubModel, Transition, Update

__all__ = [
    "SubModel",
    "Initial",
    "Transition",
    "Update",
    "Around",
    "StochasticMLP",
    "deterministic",
    "LearnedTransition",
    "LearnedObservation",
    "LinearObservation",
    "Select",
    "DiagonalNoise",
    "ConstantNoise",
    "ScaledNoise",
    "ImageSensor",
    "VectorSensor",
    "KeypointTrunk",
    "convolutional_trunk",
    "GaussianPrior",
    "AroundState",
    "FromSensor",
    "EnsembleAnalysis",
    "LocalEnsembleAnalysis",
    "MomentPrior",
    "LinearTransition",
    "KalmanAnalysis",
    "GaussianAround",
    "CholeskyNoise",
    "MappedNoise",
    "EKFTransition",
    "EKFAnalysis",
    "UKFTransition",
    "UKFAnalysis",
    "GaussianLikelihood",
    "LearnedLikelihood",
    "NoisyTransition",
]
