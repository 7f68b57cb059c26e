from . import (
    applications,
    baselines,
    compilation,
    data,
    deployment,
    diagnosis,
    envs,
    filters,
    functional,
    fusion,
    imperfect,
    metrics,
    modules,
    monitoring,
    motions,
    objectives,
    plots,
    pretrained,
    smoothers,
    training,
    transforms,
)
from .applications.car.kitti.env import KITTIReplayEnv
from .applications.car.kitti.replay import KITTIOdometryExperienceReplay
from .applications.car.optical_flow import OpticalFlow
from .applications.ur5.data.replay import UR5ExperienceReplay
from .applications.ur5.envs.table import UR5TableEnv
from .baselines import BackpropKF, IEnKS, LSTMFilter
from .data.lerobot.replay import LeRobotReplay
from .data.recordings.frames import Images, Video
from .data.recordings.replay import Recording, RecordingReplay
from .data.recordings.tables import Table
from .deployment import export_step, load_step
from .envs.disturbances import BlackFrames, Blur, Brightness, OccludingBox, SaltAndPepper
from .envs.hold import HoldReading
from .envs.linear import LinearGaussianEnv
from .envs.missing import MissingFrames
from .envs.pendulum import NoisyPendulumEnv
from .envs.replay import ReplayEnv
from .filters import (
    DPF,
    EKF,
    UKF,
    DEnKF,
    Filter,
    KalmanFilter,
    MixtureParticleFilter,
    ParticleFilter,
)
from .fusion import FusedFilter, FusedSensor, Refiltering
from .imperfect import RejectReadings
from .monitoring import Gated, Monitored
from .objectives import DEnKFLoss, GaussianLoss, MixtureLoss, ObservationLoss, SensorLoss, TransitionLoss
from .pretrained.folders import available, from_pretrained, save_pretrained
from .smoothers import EnKS, EnRTS, FixedLag, ParticleSmoother, RTSSmoother
from .training import FilterTrainer, Stage
from .transforms import DEnKFTransform, LastAction

__version__: str

__all__ = [
    "applications",
    "baselines",
    "compilation",
    "data",
    "deployment",
    "diagnosis",
    "envs",
    "filters",
    "functional",
    "fusion",
    "imperfect",
    "metrics",
    "modules",
    "monitoring",
    "motions",
    "objectives",
    "plots",
    "pretrained",
    "smoothers",
    "training",
    "transforms",
    "BackpropKF",
    "BlackFrames",
    "Blur",
    "Brightness",
    "DEnKF",
    "DEnKFLoss",
    "DEnKFTransform",
    "DPF",
    "EKF",
    "EnKS",
    "EnRTS",
    "Filter",
    "FilterTrainer",
    "FixedLag",
    "Gated",
    "FusedFilter",
    "FusedSensor",
    "GaussianLoss",
    "HoldReading",
    "IEnKS",
    "Images",
    "KITTIOdometryExperienceReplay",
    "KITTIReplayEnv",
    "KalmanFilter",
    "LSTMFilter",
    "LastAction",
    "LeRobotReplay",
    "LinearGaussianEnv",
    "NoisyPendulumEnv",
    "MissingFrames",
    "MixtureParticleFilter",
    "MixtureLoss",
    "Monitored",
    "ObservationLoss",
    "OccludingBox",
    "OpticalFlow",
    "ParticleFilter",
    "ParticleSmoother",
    "RTSSmoother",
    "Recording",
    "RecordingReplay",
    "Refiltering",
    "RejectReadings",
    "ReplayEnv",
    "SaltAndPepper",
    "SensorLoss",
    "Stage",
    "Table",
    "TransitionLoss",
    "UKF",
    "UR5ExperienceReplay",
    "UR5TableEnv",
    "Video",
    "available",
    "export_step",
    "from_pretrained",
    "load_step",
    "save_pretrained",
]
