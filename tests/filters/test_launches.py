"""Counts the operators of a step that launch something on a GPU: an eager step takes as long as its launches."""

import pytest
import torch

from benchmarks.speed.workload import make_filter, make_frames, start
from tests.waits import Launches
from torch_denkf.functional.kernels import small_system

STEPS = 20


@pytest.fixture
def workload(monkeypatch):
    """Returns the benchmark's filter and frames on ``device="meta"``."""
    filter, frames = make_filter(), make_frames(2, STEPS + 1)
    row = frames[:, 0].copy().set(("belief", "ensemble"), start(filter, 2))
    monkeypatch.setattr(small_system, "GPUS", ("cuda", "meta"))
    return filter.to("meta"), frames.to("meta"), row.to("meta")


def launches(run):
    run()  # what is looked up once
    with Launches() as counted:
        run()
    return counted.total


@torch.no_grad()
def test_a_step(workload):
    filter, _, row = workload
    assert launches(lambda: filter.step(row.copy())) <= 80  # 105 by the forms of a processor


@torch.no_grad()
def test_a_sequence(workload):
    filter, frames, _ = workload
    assert launches(lambda: filter.sequence(frames.copy())) <= 67 * (STEPS + 1)


def test_a_training_step(workload):
    """Forward and backward: a layer's weight and bias get their gradients once a sequence."""
    filter, frames, _ = workload
    parameters = list(filter.parameters())

    def train():
        torch.autograd.grad(filter.sequence(frames.copy())["belief", "mean"].square().sum(), parameters)

    assert launches(train) <= 135 * (STEPS + 1)
