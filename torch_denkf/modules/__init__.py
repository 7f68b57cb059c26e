"""Sub-models of a filter, each a TensorDict module with its own keys.

Import from here: ``from torch_denkf.modules import EnsembleAnalysis, ImageSensor, ...``.
"""

from torch_denkf.modules._base import SubModel
from torch_denkf.modules._call import Call
from torch_denkf.modules._ensemble import EnsembleAnalysisKeys
from torch_denkf.modules._gaussian import GaussianAnalysisOptions, GaussianTransitionKeys
from torch_denkf.modules._running import reads, run_module
from torch_denkf.modules.analysis import EnsembleAnalysis
from torch_denkf.modules.belief import AroundState, FromSensor, GaussianPrior
from torch_denkf.modules.bias import BiasedNoise, BiasedObservation, BiasedTransition, FadingBias
from torch_denkf.modules.black import BlackIsMissing
from torch_denkf.modules.carried import WithState
from torch_denkf.modules.check import check_analysis
from torch_denkf.modules.continuous import ContinuousMotion, ContinuousNoise, NoisePerSecond
from torch_denkf.modules.ekf import EKFAnalysis, EKFTransition
from torch_denkf.modules.flow_sensor import FlowSensor
from torch_denkf.modules.fused import JoinedObservation, JoinedReading, Renamed, StateObservation
from torch_denkf.modules.gate import GatedAnalysis, GateOptions
from torch_denkf.modules.iterated import IteratedAnalysis, WithSmoothed
from torch_denkf.modules.joint_moments import JointForecast, PresentOfJoint, WithJointMoments
from torch_denkf.modules.kalman import GaussianAround, KalmanAnalysis, LinearTransition, MomentPrior
from torch_denkf.modules.keypoints import KeypointTrunk, SpatialSoftArgmax
from torch_denkf.modules.likelihood import GaussianLikelihood, LearnedLikelihood
from torch_denkf.modules.local_analysis import LocalEnsembleAnalysis
from torch_denkf.modules.monitor import InnovationMonitor, MonitoredSensor
from torch_denkf.modules.motion_noise import NoisyTransition
from torch_denkf.modules.noise import ConstantNoise, DiagonalNoise, MemberGain, ScaledNoise
from torch_denkf.modules.observation import LearnedObservation, LinearObservation, Select
from torch_denkf.modules.pairs import ClonedPrior, ClonedTransition, PairObservation, WithHistory
from torch_denkf.modules.particles import ParticleAnalysis, ResampledTransition, WithWeights
from torch_denkf.modules.past import EnsemblePast, LaggedAnalysis, LaggedBelief, WithEnsemblePast
from torch_denkf.modules.past_moments import CrossTransition, LaggedMoments, MomentsPast, WithMomentsPast
from torch_denkf.modules.process_noise import CholeskyNoise, MappedNoise, UnicycleNoise, as_process_noise
from torch_denkf.modules.recurrent import LSTMTransition, LSTMUpdate, UnicyclePose, WithMemory
from torch_denkf.modules.sensor import ImageSensor, VectorSensor, convolutional_trunk
from torch_denkf.modules.sensor_weights import SensorAttention, SensorWeights, WeightedNoise
from torch_denkf.modules.sharded_analysis import ShardedEnsembleAnalysis
from torch_denkf.modules.signs import SignGate
from torch_denkf.modules.stochastic import FlipoutLinear, StochasticMLP, deterministic
from torch_denkf.modules.transition import LearnedTransition
from torch_denkf.modules.ukf import UKFAnalysis, UKFTransition
from torch_denkf.modules.unicycle import UnicycleMotion, UnicycleTransition

__all__ = [
    "SubModel",
    "Call",
    "check_analysis",
    "reads",
    "run_module",
    "StochasticMLP",
    "FlipoutLinear",
    "deterministic",
    "LearnedTransition",
    "UnicycleTransition",
    "UnicycleMotion",
    "ContinuousMotion",
    "ContinuousNoise",
    "NoisePerSecond",
    "PairObservation",
    "WithHistory",
    "ClonedPrior",
    "ClonedTransition",
    "LearnedObservation",
    "LinearObservation",
    "Select",
    "DiagonalNoise",
    "ConstantNoise",
    "ScaledNoise",
    "ImageSensor",
    "BlackIsMissing",
    "SignGate",
    "VectorSensor",
    "FlowSensor",
    "MemberGain",
    "KeypointTrunk",
    "SpatialSoftArgmax",
    "convolutional_trunk",
    "GaussianPrior",
    "AroundState",
    "FromSensor",
    "EnsembleAnalysis",
    "LocalEnsembleAnalysis",
    "ShardedEnsembleAnalysis",
    "MomentPrior",
    "LinearTransition",
    "KalmanAnalysis",
    "GaussianAround",
    "CholeskyNoise",
    "MappedNoise",
    "FadingBias",
    "BiasedTransition",
    "BiasedNoise",
    "BiasedObservation",
    "UnicycleNoise",
    "as_process_noise",
    "EKFTransition",
    "EKFAnalysis",
    "UKFTransition",
    "UKFAnalysis",
    "GaussianLikelihood",
    "LearnedLikelihood",
    "WithWeights",
    "NoisyTransition",
    "ResampledTransition",
    "ParticleAnalysis",
    "IteratedAnalysis",
    "WithSmoothed",
    "WithEnsemblePast",
    "EnsemblePast",
    "LaggedAnalysis",
    "LaggedBelief",
    "WithMomentsPast",
    "CrossTransition",
    "MomentsPast",
    "LaggedMoments",
    "WithJointMoments",
    "JointForecast",
    "PresentOfJoint",
    "Renamed",
    "StateObservation",
    "JoinedObservation",
    "JoinedReading",
    "SensorAttention",
    "SensorWeights",
    "WeightedNoise",
    "WithMemory",
    "LSTMTransition",
    "LSTMUpdate",
    "UnicyclePose",
    "EnsembleAnalysisKeys",
    "GaussianAnalysisOptions",
    "GaussianTransitionKeys",
    "InnovationMonitor",
    "MonitoredSensor",
    "GatedAnalysis",
    "GateOptions",
    "WithState",
]
