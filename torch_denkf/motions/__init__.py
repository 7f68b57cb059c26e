"""Known motions, and observations of their states: inertial sensors, poses, landmarks.

Linear motions in continuous time have vectors as states. Another motion's state is a point of a space, see
:mod:`torch_denkf.functional.manifolds`: orientation first, as a unit quaternion with w first, or as an angle in the
plane; the world's z points up. Motions draw no noise. ``process_noise`` of a motion has the standard deviations of the
noise that a filter adds after each step, one for each component of a tangent.
"""

from torch_denkf.motions.continuous import ContinuousMotion, ContinuousNoise, NoisePerSecond
from torch_denkf.motions.inertial import AttitudeMotion, InertialMotion
from torch_denkf.motions.planar import PlanarMotion
from torch_denkf.motions.readings import Gravity, Magnetic, PoseOf, PositionInBody, RangeBearing
from torch_denkf.motions.twist import ConstantTwist

__all__ = [
    "AttitudeMotion",
    "ConstantTwist",
    "ContinuousMotion",
    "ContinuousNoise",
    "Gravity",
    "InertialMotion",
    "Magnetic",
    "NoisePerSecond",
    "PlanarMotion",
    "PoseOf",
    "PositionInBody",
    "RangeBearing",
]
