"""A learned sensor of orientations: in the limit of small angles an EKF on a space is the Backprop KF of numbers."""

import torch
from tensordict.nn import TensorDictModule
from torch import nn

from tests.filters.test_spaces import SPACE
from tests.smoothers.small_angles import PROCESS, SMALL, STARTS, assert_small_differences, linear, readings, rotating
from torch_denkf.baselines import BackpropKF
from torch_denkf.filters import EKF
from torch_denkf.functional.manifolds import SO3
from torch_denkf.modules import DiagonalNoise, GaussianAround

READING = ("sensor", "ensemble")


class Looking(nn.Linear):
    """Features to an orientation."""

    def forward(self, features):
        return SO3().exp(super().forward(features))


def test_an_ekf_learns_a_sensor_of_orientations_as_a_backprop_kf_one_of_numbers(float64):
    data, flat = readings()
    for rows in (data, flat):
        rows["features"] = flat["pose"].clone()
    networks = [kind(3, 3) for kind in (Looking, nn.Linear)]
    for network in networks:
        network.weight.data, network.bias.data = torch.eye(3) + 0.1, SMALL * torch.ones(3)
    sensors = [TensorDictModule(network, ["features"], [READING]) for network in networks]
    torch.manual_seed(0)
    r = DiagonalNoise(3, r=SMALL**2, num_cells=(), in_features=3, in_key="features", out_key=("sensor", "noise"))
    start, plain = (GaussianAround(STARTS, state_key="start", space=space) for space in (SPACE, None))
    (turning, _, orientation), (motion, _, _) = rotating(), linear()
    on_space = EKF(turning, sensors[0], orientation, r, initial=start, process_noise=PROCESS, reading_space=SO3())
    a, c, q = motion.module.weight.detach(), torch.eye(3, 6), torch.tensor(PROCESS).square().diag()
    expected = BackpropKF(a, sensors[1], c, r, process_noise_cov=q, initial=plain)
    outs = on_space.sequence(data.clone()), expected.sequence(flat.clone())
    assert_small_differences(*outs, "belief", data["start"])
    grads = []
    for out, network in zip(outs, networks, strict=True):
        mean = out["belief", "mean"]
        error = mean if mean.shape[-1] == 6 else SPACE.minus(mean, data["start"])
        (error.square().sum() / SMALL**2).backward()
        grads.append(torch.cat([network.weight.grad.flatten(), SMALL * network.bias.grad]))
    assert (grads[0] - grads[1]).norm() < 1e-2 * grads[1].norm()
