"""Readings whose signs are too large, against the rate at which clean ones are."""

import math

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.monitoring import InnovationMonitor, MonitoredSensor, SignGate


def clean(count, signs=3, seed=0):
    values = torch.randn(count, signs, generator=torch.Generator().manual_seed(seed)).exp()
    return TensorDict({"signs": values}, [count])


@pytest.mark.parametrize("rate", [0.03, 0.003])
def test_clean_readings_are_taken_out_at_the_rate(rate):
    gate = SignGate(3, rate=rate).calibrate([clean(200_000)])
    # Of independent signs, each beyond its quantile with a third of the rate.
    expected = 1 - (1 - rate / 3) ** 3
    found = (~gate(clean(100_000, seed=1))["seen"]).double().mean().item()
    assert abs(found - expected) < 5 * math.sqrt(expected / 100_000)
    quantile = math.exp(torch.special.ndtri(torch.tensor(1 - rate / 3, dtype=torch.float64)).item())
    assert gate.limits.tolist() == pytest.approx([quantile] * 3, rel=0.08)


def test_floor_margin_and_unknown_signs():
    data = TensorDict({"signs": torch.stack([torch.zeros(100), torch.arange(100.0)], -1)}, [100])
    gate = SignGate(2, rate=0.02, floor=(0.5, 0.0)).calibrate([data], margin=2.0)
    assert gate.limits.tolist() == [0.5, 196.0]
    signs = torch.tensor([[0.4, 0.0], [0.6, 0.0], [torch.nan, 200.0], [torch.nan, 100.0]])
    assert gate(TensorDict({"signs": signs}, [4]))["seen"].flatten().tolist() == [True, False, False, True]


def watched(runs, steps, seed):
    generator = torch.Generator().manual_seed(seed)
    innovation = torch.randn(runs, steps, 1, generator=generator)
    signs = torch.randn(runs, steps, 2, generator=generator).exp()
    mask = torch.ones(runs, steps, 1, dtype=torch.bool)
    info = {"innovation": innovation, "nis": innovation.square()}
    return TensorDict({"info": info, "signs": signs, "observed": mask}, [runs, steps])


def test_a_monitor_shares_its_rate_with_signs_and_sees_them_in_blind_steps():
    sensor = MonitoredSensor("info", 1, sign_key="signs", signs=2)
    monitor = InnovationMonitor({"camera": sensor}, window=3, reference=1.5, false_alarm_rate=0.01)
    assert monitor.share == pytest.approx(0.01 / 3)  # window, cumulative sum, signs
    monitor.calibrate([watched(1000, 100, 0)])
    quantile = math.exp(-torch.special.ndtri(torch.tensor(0.01 / 6, dtype=torch.float64)).item())
    assert monitor.sign_limit_camera.tolist() == pytest.approx([quantile] * 2, rel=0.08)
    fresh = watched(200, 100, 1)
    alone = (fresh["signs"] > monitor.sign_limit_camera).any(-1).double().mean().item()
    assert abs(alone - 0.01 / 3) < 5 * math.sqrt(0.01 / 3 / 20_000)
    fresh["signs"][:, 50:] = 1e3
    fresh["observed"][:, 50:] = False
    assert monitor.replay(fresh)["monitor", "alarm"][:, 50:].all()
    fresh["signs"][:, 50:] = torch.nan
    evidence = monitor.replay(fresh)["monitor", "camera", "evidence"]
    assert evidence.isfinite().all()
