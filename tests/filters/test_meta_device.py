"""The suite on ``device="meta"``, a stand-in for a GPU: it raises at mixed devices and at each look at a number."""

import pytest
import torch
from tensordict import TensorDict

from tests.filters.test_contract import FILTERS, every_filter, readings
from tests.waits import NothingWaits
from torch_denkf.functional.kernels import small_system
from torch_denkf.functional.linalg import inverse_square_root

deviced = pytest.mark.parametrize(
    "device", ["meta", pytest.param(None, marks=pytest.mark.slow)], ids=["device", "no device"]
)


@pytest.fixture(autouse=True)
def as_on_a_gpu(monkeypatch):
    monkeypatch.setattr(small_system, "GPUS", ("cuda", "meta"))
    make_tables()


def make_tables():
    """Makes what is made once a device, by a copy."""
    for dtype in (torch.float32, torch.float64):
        inverse_square_root(torch.zeros(2, 2, dtype=dtype, device="meta"))


def on_meta(tensordict, device="meta"):
    moved = tensordict.apply(lambda value: value.to("meta"), batch_size=tensordict.batch_size)
    return moved if device is None else moved.to(device)


def assert_there(tensordict):
    away = {key: value.device for key, value in tensordict.items(True, True) if not value.is_meta}
    assert not away


def filtered(name, device):
    """Returns a filter, frames ``[3, 5]`` with noise, and the carry of the time before."""
    filter = FILTERS[name]()
    frames = filter.draw_noise(readings(3, 3, width=2))
    start = filter.initialise(frames[:, 0].copy()).select(*filter.carry_keys)
    return filter.to("meta"), on_meta(frames, device), on_meta(start, device)


def train(filter, frames):
    frames = frames.copy()
    frames["observation"] = frames["observation"].clone().requires_grad_()
    frames["observation"].retain_grad()
    filter.sequence(frames)["belief", "mean"].square().sum().backward()
    return TensorDict({"gradient": frames["observation"].grad})


WAYS = {
    "sequence": lambda filter, frames, start: filter.sequence(frames.copy()),
    "sequence, unmarked": lambda filter, frames, start: filter.sequence(frames.exclude("is_init")),
    "drawn": lambda filter, frames, start: filter.sequence(frames.exclude("noise")),
    "step": lambda filter, frames, start: filter.step(frames[:, 1].copy().update(start)),
    "initialise": lambda filter, frames, start: filter.initialise(frames[:, 0].copy()),
    "summarise": lambda filter, frames, start: filter.summarise(start.copy()),
    "predict": lambda filter, frames, start: filter.predict(frames[:, 1].copy().update(start)),
    "policy": lambda filter, frames, start: filter(frames[:, 1].copy().update(start)),
    "stepped": lambda filter, frames, start: TensorDict({"stepped": filter.stepped(frames)}),
    "training": lambda filter, frames, start: train(filter, frames),
}


@every_filter
@deviced
def test_each_way_to_run_stays_on_the_device_and_waits_for_nothing(name, device):
    filter, frames, start = filtered(name, device)
    for way, run in WAYS.items():
        with NothingWaits(), torch.set_grad_enabled(way == "training"):
            assert_there(run(filter, frames, start))


@every_filter
def test_primers_of_a_filter_on_the_device(name):
    primer = FILTERS[name]().to("meta").make_tensordict_primer()
    for key, spec in primer.primers.items(True, True):
        assert spec.device.type == "meta", key
