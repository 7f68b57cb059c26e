"""Tests the size of the noise that a filter draws in bulk, and what happens where nothing says so."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from tests.filters.factories import FixedEnsemble, linear_denkf, linear_system, toy_denkf, toy_frames

MEAN, ENSEMBLE = ("belief", "mean"), ("belief", "ensemble")


pytestmark = pytest.mark.usefixtures("float64")


def readings(*batch):
    return TensorDict({"observation": torch.randn(*batch, 2)}, batch)


def by_steps(filter, frames):
    """Returns means of single steps with the noise in ``frames`` ``[B, T]``, from the first stored belief."""
    row, means = frames[:, 0].copy(), [frames[ENSEMBLE][:, 0].mean(-2)]
    for t in range(1, frames.shape[1]):
        row = filter.step(frames[:, t].copy().set(ENSEMBLE, row[ENSEMBLE]))
        means.append(row[MEAN])
    return torch.stack(means, 1)


def test_a_stored_ensemble_may_be_larger_than_the_initial_one():
    filter, frames = linear_denkf("perturbed", noisy=True), readings(3, 5)
    assert filter.initial.ensemble_size == 6
    frames[ENSEMBLE] = torch.randn(3, 5, 9, 2)
    assert filter.sequence(frames.copy())[ENSEMBLE].shape == (3, 5, 9, 2)
    filter.draw_noise(frames)
    assert frames["noise", "transition"].shape == frames["noise", "analysis"].shape == (3, 5, 9, 2)
    out = filter.sequence(frames.copy())
    torch.testing.assert_close(out[MEAN], by_steps(filter, frames), rtol=0, atol=1e-12)


class Unsaid(FixedEnsemble):
    """An initial belief that does not say how many members it has, nor of how many dimensions."""

    def __init__(self, members):
        super().__init__(members)
        del self.ensemble_size, self.state_dim


def foreign_noise(filter):
    """Returns the noise from a module that does not say how many readings it is for."""
    _, _, _, R = linear_system()
    filter = filter.with_modules(noise=TensorDictModule(nn.Linear(2, 2), ["observation"], [("sensor", "noise")]))
    with torch.no_grad():
        filter["noise"].module.weight.zero_()
        filter["noise"].module.bias.copy_(R)
    return filter


@pytest.mark.parametrize("case", ["initial", "noise"])
def test_sizes_that_only_the_entries_tell_are_enough_to_draw_in_bulk(case):
    """Drawn in bulk, a seed gives what it gives the filter whose modules say their sizes; and chunks compile."""
    told = linear_denkf("perturbed", noisy=True)
    filter = linear_denkf("perturbed", noisy=True)
    if case == "initial":
        filter = filter.with_modules(initial=Unsaid(filter.initial.members))
    else:
        filter = foreign_noise(filter)
    frames, outs = readings(3, 5), []
    for model in (told, filter, filter.compile(chunk=1, backend="eager")):
        torch.manual_seed(1)
        outs.append(model.sequence(frames.copy())[MEAN])
    for out in outs[1:]:
        torch.testing.assert_close(out, outs[0], rtol=0, atol=1e-12)
    assert filter.compiled._functions


def test_flipout_in_a_sensor_has_a_perturbation_of_its_own_at_each_time():
    """As if the sequence were taken step by step; the noise drawn where it is needed is that drawn in bulk."""
    filter = toy_denkf(sensor_layer="flipout", layer="none", action=False)
    frames, outs = toy_frames((3, 5), masks=0, resets=False).exclude("action"), []
    for bulk in (False, True):
        torch.manual_seed(1)
        given = frames.copy()
        if bulk:
            given["noise", "sensor"] = filter["sensor"].draw_noise([3, 5], time=True, dtype=torch.float64)
        outs.append(filter.sequence(given)["sensor", "ensemble"])
    assert outs[0].equal(outs[1])
