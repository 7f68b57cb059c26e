"""Weights that move between filters of the same parts. Oracle: what the sub-models compute."""

import pytest
import torch

from torch_denkf import EKF, DEnKF, FusedFilter, FusedSensor
from torch_denkf.modules import (
    DiagonalNoise,
    GaussianPrior,
    LearnedObservation,
    LearnedTransition,
    MomentPrior,
    Select,
    StochasticMLP,
    VectorSensor,
)
from torch_denkf.training import take_weights


def parts(width=8):
    return (
        LearnedTransition(StochasticMLP(4, 4, (width,))),
        VectorSensor(3, 2, num_cells=(8,), in_key="ranges", ensemble_size=8),
        LearnedObservation(StochasticMLP(4, 2, (8,), layer="none")),
        DiagonalNoise(2, r=0.3),
    )


def ensemble(**options):
    return DEnKF(*parts(**options), initial=GaussianPrior([0.0] * 4, [1.0] * 4, ensemble_size=8))


def moments():
    return EKF(*parts(), process_noise=0.1, initial=MomentPrior(torch.zeros(4), torch.eye(4)))


def fused(delay, members=8):
    _, first, _, noise = parts()
    _, second, *_ = parts()
    reads = Select([0, 1])
    sensors = {"a": FusedSensor(reads, noise, first, delay=delay), "b": FusedSensor(reads, [0.1] * 2, second)}
    return FusedFilter(parts()[0], sensors, initial=GaussianPrior([0.0] * 4, [1.0] * 4, ensemble_size=members))


def test_an_ensembles_weights_for_moments_and_back():
    filter, source = moments(), ensemble()
    assert take_weights(filter, source) == []
    x = torch.randn(5, 4)
    network = filter["transition"].module.module
    torch.testing.assert_close(network(x, sample=False), source["transition"].module(x, sample=False))
    for parameter in filter.parameters():
        parameter.data.add_(1.0)
    assert take_weights(source, filter) == []
    torch.testing.assert_close(source["transition"].module(x, sample=False), network(x, sample=False))


def test_another_delay_and_sensors_of_one_kind_by_their_names():
    filter, source = fused(3), fused(0)
    assert take_weights(filter, source) == []
    for name in ("a_sensor", "b_sensor"):
        for ours, theirs in zip(filter[name].parameters(), source[name].parameters(), strict=True):
            assert ours.equal(theirs)
    assert not filter["a_sensor"].state_dict().keys() - source["a_sensor"].state_dict().keys()


def test_unmatched_weights_are_named_and_ambiguous_ones_raise():
    filter = ensemble(width=16)
    left = take_weights(filter, ensemble())
    assert left == [name for name, _ in filter.named_parameters() if "transition" in name]
    with pytest.raises(ValueError, match="could take the weights of any of"):
        take_weights(ensemble(), fused(0))
