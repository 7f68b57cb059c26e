"""States, steps and Jacobians that the tests of this room share."""

import torch
from tensordict import TensorDict

from torch_denkf.functional.manifolds import SE2, SE3, SE23, Euclidean, Product
from torch_denkf.motions import AttitudeMotion, ConstantTwist, InertialMotion, PlanarMotion

ACTIONS = {AttitudeMotion: {"gyro": 3}, InertialMotion: {"imu": 6}}
MOTIONS = {
    "twist in the plane": lambda dt=0.1: ConstantTwist(SE2(), dt),
    "twist in space": lambda dt=0.1: ConstantTwist(SE3(), dt),
    "wheels": lambda dt=0.1: PlanarMotion(dt, damping=0.2, usual_speed=1.0),
    "inertial": lambda dt=0.1: InertialMotion(dt),
    "attitude": lambda dt=0.1: AttitudeMotion(dt),
}


def random_points(space, *shape):
    """Returns points around the neutral one."""
    return space.exp(torch.randn(*shape, space.tangent_dim))


def frame(motion, *batch, still=False):
    """Returns what drives a motion."""
    actions = ACTIONS.get(type(motion), {})
    return {key: torch.zeros(*batch, n) if still else torch.randn(*batch, n) for key, n in actions.items()}


def step(motion, state, **entries):
    """Returns the forecast of states [*B, E, P]."""
    td = TensorDict({("belief", "ensemble"): state, **entries}, state.shape[:-2])
    return motion(td)["forecast", "ensemble"]


def observe(reading, state):
    """Returns the predicted readings of states [*B, E, P]."""
    return reading(TensorDict({("forecast", "ensemble"): state}, state.shape[:-2]))["forecast", "observation"]


def inertial_state(pose, gyro_bias=(0.0, 0.0, 0.0), accelerometer_bias=(0.0, 0.0, 0.0)):
    """Returns states [E, 16] of poses [E, 10]."""
    biases = torch.tensor([*gyro_bias, *accelerometer_bias], dtype=pose.dtype)
    return torch.cat([pose, biases.expand(*pose.shape[:-1], 6)], -1)


INERTIAL = Product(SE23(), Euclidean(3), Euclidean(3))
