from . import (
    data,
    deployment,
    envs,
    filters,
    functional,
    metrics,
    modules,
    objectives,
    odometry,
    plots,
    pretrained,
    simulation,
    smoothers,
    training,
    transforms,
    vision,
)
from .data.kitti.replay import KITTIOdometryExperienceReplay
from .data.lerobot.replay import LeRobotReplay
from .data.recordings.frames import Images, Video
from .data.recordings.replay import Recording, RecordingReplay
from .data.recordings.tables import Table
from .data.ur5.replay import UR5ExperienceReplay
from .deployment import PackagedStep, export_step, load_step
from .envs.kitti import KITTIReplayEnv
from .envs.linear import LinearGaussianEnv
from .envs.pendulum import NoisyPendulumEnv
from .envs.replay import ReplayEnv
from .envs.ur5.expert import UR5Expert
from .envs.ur5.table import UR5TableEnv
from .filters import (
    DPF,
    EKF,
    PFM,
    UKF,
    BackpropKF,
    DEnKF,
    Filter,
    FusedFilter,
    FusedSensor,
    Gated,
    KalmanFilter,
    LSTMFilter,
    MixtureParticleFilter,
    Monitored,
    ParticleFilter,
    Refiltering,
)
from .objectives import DEnKFLoss, GaussianLoss, MixtureLoss, ObservationLoss, SensorLoss, TransitionLoss
from .pretrained.folders import available, from_pretrained, save_pretrained
from .smoothers import EnKS, EnRTS, FixedLag, IEnKS, ParticleSmoother, RTSSmoother
from .training import FilterTrainer, Stage
from .transforms import (
    BlackFrames,
    Blur,
    Brightness,
    DEnKFTransform,
    LastAction,
    MissingFrames,
    OccludingBox,
    OpticalFlow,
    SaltAndPepper,
)

__version__: str

__all__ = [
    "data",
    "deployment",
    "envs",
    "filters",
    "functional",
    "metrics",
    "modules",
    "objectives",
    "odometry",
    "plots",
    "pretrained",
    "simulation",
    "smoothers",
    "training",
    "transforms",
    "vision",
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
    "PFM",
    "PackagedStep",
    "ParticleFilter",
    "ParticleSmoother",
    "RTSSmoother",
    "Recording",
    "RecordingReplay",
    "Refiltering",
    "ReplayEnv",
    "SaltAndPepper",
    "SensorLoss",
    "Stage",
    "Table",
    "TransitionLoss",
    "UKF",
    "UR5ExperienceReplay",
    "UR5Expert",
    "UR5TableEnv",
    "Video",
    "available",
    "export_step",
    "from_pretrained",
    "load_step",
    "save_pretrained",
]
