"""Oracles: R = (r^2 - c)(1 + g)^2 + c, written out; scaled noise against the Kalman gain, which it must not change."""

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.modules import CholeskyNoise, ConstantNoise, DiagonalNoise, MappedNoise, ScaledNoise


def variance(model, reading, batch=()):
    return model(TensorDict({("sensor", "ensemble"): reading}, batch))["sensor", "noise"]


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("r", [0.1, [1e-6, 3.0]])
def test_starts_at_r_squared_for_any_reading(float64, batch, r):
    out = variance(DiagonalNoise(2, r=r), 100 * torch.randn(*batch, 8, 2), batch)
    expected = torch.as_tensor(r).expand(*batch, 2) ** 2
    torch.testing.assert_close(out, expected, rtol=1e-14, atol=0)


def test_formula_of_the_mean_reading(float64):
    model = DiagonalNoise(2, r=[0.1, 0.5], floor=[0.001, 0.2], loc=[1.0, 2.0], scale=[3.0, 4.0])
    torch.nn.init.normal_(model.module.layers[-1].weight)
    reading = torch.randn(3, 8, 2)
    features = (reading.mean(1) - torch.tensor([1.0, 2.0])) / torch.tensor([3.0, 4.0])
    floor = torch.tensor([0.001, 0.2])
    expected = (torch.tensor([0.01, 0.25]) - floor) * (1 + model.module(features)) ** 2 + floor
    torch.testing.assert_close(variance(model, reading, [3]), expected, rtol=1e-12, atol=0)
    torch.testing.assert_close(variance(model, reading.mean(1), [3]), expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("r", [1e-6, 0.1, 10.0])
def test_never_below_the_floor_and_reaches_it(r):
    model = DiagonalNoise(2, r=r)
    floor = torch.tensor(0.01 * r**2)
    for seed in range(50):
        torch.manual_seed(seed)
        for parameter in model.parameters():
            torch.nn.init.normal_(parameter, std=3.0)
        out = variance(model, torch.randn(100, 4, 2), [100])
        assert out.isfinite().all()
        assert (out >= floor * (1 - 1e-6)).all()  # one rounding of r^2 in float32
    for parameter in model.parameters():
        torch.nn.init.zeros_(parameter)
    torch.nn.init.constant_(model.module.layers[-1].bias, -1.0)
    torch.testing.assert_close(variance(model, torch.zeros(4, 2)), floor.expand(2), rtol=1e-6, atol=0)


@pytest.mark.parametrize("r", [1e-6, 0.1])
def test_gradient_at_the_start(float64, r):
    model = DiagonalNoise(2, r=r)
    variance(model, torch.randn(3, 4, 2), [3]).sum().backward()
    # dR/dg = 2 (r^2 - c) (1 + g), with g = 0 and three rows.
    expected = torch.full((2,), 3 * 2 * 0.99 * r**2)
    torch.testing.assert_close(model.module.layers[-1].bias.grad, expected, rtol=1e-12, atol=0)
    assert model.module.layers[-1].weight.grad.abs().sum() > 0


def test_constant_in_the_finer_of_the_two_precisions():
    """1e-5 squared is zero in float16, which a camera or a log may use."""
    noise = ConstantNoise([1e-5], in_key="reading")
    variance = noise(TensorDict({"reading": torch.zeros(3, 1, dtype=torch.float16)}, [3]))["sensor", "noise"]
    torch.testing.assert_close(variance, torch.full((3, 1), 1e-10), rtol=1e-5, atol=0)
    assert noise.compute(torch.zeros(3, 1, dtype=torch.float64), batch_size=[3]).dtype == torch.float64


def test_constant_without_noise_in_some_dimensions(float64):
    model = ConstantNoise([0.0, 2.0, 0.0])
    for batch in ((), (3,), (2, 3)):
        out = variance(model, torch.randn(*batch, 8, 3), batch)
        torch.testing.assert_close(out, torch.tensor([0.0, 4.0, 0.0]).expand(*batch, 3), rtol=1e-14, atol=0)
    assert (ScaledNoise(model, 3.0)(TensorDict({("sensor", "ensemble"): torch.zeros(3)}))["sensor", "noise"] == 0)[
        [0, 2]
    ].all()
    torch.testing.assert_close(
        MappedNoise(model, torch.eye(3))(TensorDict({("sensor", "ensemble"): torch.zeros(3)}))["sensor", "noise"],
        torch.diag(torch.tensor([0.0, 4.0, 0.0])),
        rtol=1e-14,
        atol=0,
    )
    with pytest.raises(ValueError, match=r"r, a trainable .* must be finite and above 0; got 0.0 at \[0\]"):
        ConstantNoise([0.0, 2.0], trainable=True)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_scaled_variances_and_covariances(float64, batch):
    for noise, diagonal in (
        (DiagonalNoise(2, r=[0.1, 3.0]), [0.01, 9.0]),
        (CholeskyNoise(2, r=[0.1, 3.0], in_key=("sensor", "ensemble"), out_key=("sensor", "noise")), [0.01, 9.0]),
    ):
        scaled = ScaledNoise(noise)
        before = variance(scaled, torch.randn(*batch, 8, 2), batch)
        scaled.factor = 0.5
        after = variance(scaled, torch.randn(*batch, 8, 2), batch)
        expected = torch.tensor(diagonal).expand(*batch, 2)
        expected = expected if after.ndim == len(batch) + 1 else expected.diag_embed()
        torch.testing.assert_close(before, expected)
        torch.testing.assert_close(after, expected / 4)
