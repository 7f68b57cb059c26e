"""Tests that what a filter writes is its own memory, and that what it was given is copied."""

from functools import partial

import pytest
import torch
from torch import nn

from tests.filters.gaussian_for_tests import prior
from tests.filters.test_contract import FILTERS, every_filter, readings
from torch_denkf.baselines import BackpropKF
from torch_denkf.filters import KalmanFilter
from torch_denkf.modules import (
    AroundState,
    ConstantNoise,
    FromSensor,
    GaussianAround,
    GaussianPrior,
    LearnedObservation,
    LearnedTransition,
    LinearObservation,
    LinearTransition,
    MomentPrior,
)


def memories(*tensors):
    return {tensor.untyped_storage().data_ptr() for tensor in tensors if tensor.numel()}


def check_apart(filter, written, given):
    """Every entry that was written lies in memory of its own, and is as large as it looks."""
    constants = memories(*filter.parameters(), *filter.buffers())
    inputs, seen = memories(*given.values(True, True)), set()
    for key in written:
        value = written[key]
        if not value.numel():
            continue
        place = value.untyped_storage().data_ptr()
        assert place not in constants, f"{key} is the filter's own"
        assert place not in inputs, f"{key} is what was given"
        assert place not in seen, f"{key} shares its memory with another entry"
        assert value.untyped_storage().nbytes() >= value.numel() * value.element_size(), f"{key} is expanded"
        seen.add(place)


def entries(tensordict, keys):
    return {key: tensordict[key] for key in keys if tensordict.get(key, None) is not None}


@every_filter
@pytest.mark.parametrize("batch", [(), (3,)])
def test_every_way_to_run_a_filter_writes_memory_of_its_own(float64, name, batch):
    filter = FILTERS[name]()
    frames = readings(*batch, 5)
    first = frames.select("observation", "observed")[..., 0].clone()
    start = filter.initialise(first.clone())
    given = first.clone()
    written = set(start.keys(True, True)) - set(first.keys(True, True))
    check_apart(filter, entries(filter.initialise(given), written), first)
    row = start.clone()
    before = row.copy()
    check_apart(filter, entries(filter.step(row), filter.out_keys), before)
    out = filter.sequence(frames.copy())
    check_apart(filter, entries(out, filter.out_keys), frames)
    row = frames[..., 1].copy()
    for key in filter.carry_keys:
        row["previous", *key] = start[key].clone()
    before = row.copy()
    policy = filter(row)
    keys = [*filter.out_keys, *(("next", "previous", *key) for key in filter.carry_keys)]
    check_apart(filter, entries(policy, keys), before)


# ------------------------------------------------------------------------------------------------------- constructors

MATRIX, VECTOR = (2, 2), (2,)
noise = partial(ConstantNoise, [0.5, 0.5], in_key="observation")
READ = {"initial": prior(), "observation_key": "observation"}
#: Constructors, and the shapes of the constants that they take.
TAKES = {
    "KalmanFilter": (
        lambda a, b, c, d, e, f: KalmanFilter(a, c, process_noise_cov=b, noise_cov=d, mean=e, cov=f),
        [MATRIX, MATRIX, MATRIX, MATRIX, VECTOR, MATRIX],
    ),
    "BackpropKF": (
        lambda a, b, c: BackpropKF(a, None, c, noise(), process_noise_cov=b, **READ),
        [MATRIX, MATRIX, MATRIX],
    ),
    "GaussianPrior": (lambda a, b: GaussianPrior(a, b, ensemble_size=4), [VECTOR, VECTOR]),
    "AroundState": (lambda a: AroundState(a), [VECTOR]),
    "FromSensor": (lambda a, b: FromSensor([0], a, b), [VECTOR, VECTOR]),
    "MomentPrior": (MomentPrior, [VECTOR, MATRIX]),
    "GaussianAround": (GaussianAround, [VECTOR]),
    "LinearTransition": (LinearTransition, [MATRIX, MATRIX]),
    "LinearObservation": (LinearObservation, [MATRIX]),
    "LearnedObservation": (lambda a, b: LearnedObservation(nn.Identity(), loc=a, scale=b), [VECTOR, VECTOR]),
    "LearnedTransition": (lambda a, b: LearnedTransition(nn.Identity(), loc=a, scale=b), [VECTOR, VECTOR]),
}


@pytest.mark.parametrize("name", TAKES)
@pytest.mark.parametrize("kind", ["tensor", "array"])
def test_constructors_copy_their_arguments(name, kind):
    make, shapes = TAKES[name]
    values = [torch.eye(2) if shape == MATRIX else torch.ones(2) for shape in shapes]
    given = values if kind == "tensor" else [value.numpy() for value in values]
    module = make(*given)
    before = {key: value.clone() for key, value in module.state_dict().items()}
    for value in given:
        value *= 100
    after = module.state_dict()
    assert before
    for key, value in before.items():
        assert torch.equal(after[key], value), key
