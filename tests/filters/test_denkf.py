"""Oracle: Table I of the paper, worked out by hand."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.factories import linear_denkf, linear_kalman
from torch_denkf.filters import DEnKF
from torch_denkf.modules.stochastic import FlipoutLinear


def widths(network):
    """(in, out) of every linear layer."""
    return [(layer.in_features, layer.out_features) for layer in network.layers]


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def test_paper_is_table_one():
    # KITTI: S = 5, O = 2, images of 6 x 50 x 150. A layer from n to m has n m + m parameters.
    denkf = DEnKF.paper(state_dim=5, observation_dim=2)
    transition, sensor = denkf["transition"].module, denkf["sensor"].module
    observation, noise = denkf["observation"].module, denkf["noise"].module
    assert widths(transition) == [(5, 32), (32, 32), (32, 64), (64, 64), (64, 5)]
    assert widths(observation) == [(5, 32), (32, 32), (32, 64), (64, 64), (64, 2)]
    assert widths(noise) == [(2, 16), (16, 16), (16, 2)]
    # 50 x 150 halves (rounded up) to 25 x 75, 13 x 38, 7 x 19; 16 channels: 2128 features.
    assert widths(sensor["head"]) == [(2128, 64), (64, 64), (64, 32), (32, 32), (32, 2)]
    networks = (transition, observation, noise, sensor["head"])
    assert [net.layer for net in networks] == ["dropout", "none", "none", "dropout"]
    assert all(isinstance(net.activation, nn.ReLU) for net in networks)
    trunk = [(c.in_channels, c.out_channels, c.kernel_size, c.stride) for c in sensor["trunk"] if hasattr(c, "stride")]
    assert trunk == [(6, 64, (7, 7), (2, 2)), (64, 32, (3, 3), (2, 2)), (32, 16, (3, 3), (2, 2))]
    # f: 192 + 1056 + 2112 + 4160 + 325; h: the same but 130 at the end; r: 48 + 272 + 34.
    assert count(denkf["transition"]) == 192 + 1056 + 2112 + 4160 + 325 == 7845
    assert count(denkf["observation"]) == 192 + 1056 + 2112 + 4160 + 130 == 7650
    assert count(denkf["noise"]) == 48 + 272 + 34 == 354
    # s: 64 (6 49 + 1) + 32 (64 9 + 1) + 16 (32 9 + 1), then 136256 + 4160 + 2080 + 1056 + 66.
    assert count(denkf["sensor"]) == 18880 + 18464 + 4624 + 136256 + 4160 + 2080 + 1056 + 66 == 185586
    assert count(denkf) == 7845 + 7650 + 354 + 185586 == 201435
    assert denkf.initial.ensemble_size == denkf["sensor"].ensemble_size == 32
    frames = denkf.draw_noise(TensorDict({"pixels": torch.zeros(3, 6, 50, 150)}, [3]))
    assert frames["noise", "transition"].shape == (3, 32, 32 + 32 + 64 + 64)
    assert frames["noise", "sensor"].shape == (3, 32, 64 + 64 + 32 + 32)
    assert denkf["analysis"].scheme == "sensor"
    assert denkf["transition"].residual


def test_reference_is_the_authors_code():
    # REPRODUCTION.md, section 1, "ir-lab PyTorch (car)".
    denkf = DEnKF.reference(state_dim=5, observation_dim=2)
    transition, sensor = denkf["transition"].module, denkf["sensor"].module
    assert widths(transition) == [(5, 64), (64, 512), (512, 256), (256, 5)]
    assert widths(denkf["observation"].module) == [(5, 64), (64, 128), (128, 128), (128, 64), (64, 2)]
    assert widths(denkf["noise"].module) == [(64, 32), (32, 2)]
    assert widths(sensor["head"]) == [(512, 64), (64, 2)]
    assert all(isinstance(layer, FlipoutLinear) for layer in (*transition.layers, *sensor["head"].layers))
    assert denkf["observation"].module.layer == denkf["noise"].module.layer == "none"
    trunk = list(sensor["trunk"])
    convolutions = [(c.out_channels, *c.kernel_size, *c.stride) for c in trunk if isinstance(c, nn.Conv2d)]
    assert convolutions == [(16, 5, 5, 2, 2), (32, 5, 5, 2, 2), (64, 3, 3, 1, 1)]
    assert sum(isinstance(part, nn.MaxPool2d) for part in trunk) == 3
    # 50 x 150 -> 25 x 75 -> 13 x 38 -> 7 x 19 -> 4 x 10 -> 4 x 10 -> 2 x 5; 64 channels.
    assert [(p.in_features, p.out_features) for p in trunk if isinstance(p, nn.Linear)] == [(64 * 2 * 5, 512)]
    assert denkf["noise"].in_keys == [("sensor", "encoding")]
    # Flipout starts with a standard deviation of 0.0486 in the code; 0.05 here.
    std = nn.functional.softplus(transition.layers[0].weight_rho)
    torch.testing.assert_close(std, torch.full_like(std, 0.05))


def test_the_mask_of_a_filters_default_analysis_can_be_named(float64):
    """Oracle: the mask under its usual name."""
    frames = TensorDict({"observation": torch.randn(3, 6, 2), "gps_observed": torch.rand(3, 6, 2) < 0.5}, [3, 6])
    usual, plain = frames.clone().rename_key_("gps_observed", "observed"), linear_denkf()
    noise, options = plain["noise"], {"initial": plain.initial, "observation_key": "observation"}
    for make in (linear_kalman, partial(DEnKF, plain["transition"], None, plain["observation"], noise, **options)):
        outs = []
        for filter, given in ((make(), usual), (make(observed_key="gps_observed"), frames)):
            torch.manual_seed(1)
            outs.append(filter.sequence(given.copy())["belief", "mean"])
        assert outs[0].equal(outs[1])
    with pytest.raises(ValueError, match="observed_key are for the default analysis"):
        DEnKF(noise, None, noise, noise, plain["analysis"], initial=plain.initial, observed_key="gps_observed")
