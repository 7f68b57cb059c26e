"""Tests the warning of an ensemble that is too narrow for its readings."""

import warnings

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.factories import random_draws
from torch_denkf.filters import DEnKF
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, GaussianPrior, LearnedTransition, Select
from torch_denkf.monitoring import Gated

STEP, NOISE, STEPS = 0.3, 0.1, 80


def walk_filter(process_noise, members=32, **options):
    """Filters two walks, both of which are read."""
    return DEnKF(
        LearnedTransition(nn.Identity(), residual=False),
        None,
        Select([0, 1]),
        ConstantNoise([NOISE, NOISE], in_key="reading"),
        EnsembleAnalysis("etkf", observation_key="reading"),
        process_noise=process_noise,
        initial=GaussianPrior([0.0, 0.0], [0.1, 0.1], ensemble_size=members),
        **options,
    )


def walks(moving=(1.0, 1.0), steps=STEPS):
    """Returns readings of random walks, some of which are constant."""
    torch.manual_seed(0)
    state = (STEP * torch.tensor(moving) * torch.randn(2, steps, 2)).cumsum(1)
    return TensorDict({"reading": state + NOISE * torch.randn_like(state)}, [2, steps])


def said(filter, data, **options):
    with warnings.catch_warnings(record=True) as caught, torch.no_grad():
        warnings.simplefilter("always")
        torch.manual_seed(1)
        filter.sequence(data.clone(), **options)
    return [str(each.message) for each in caught if "too narrow" in str(each.message)]


def test_consistent_filter_does_not_warn():
    assert not said(walk_filter([STEP, STEP]), walks())


@pytest.mark.parametrize("component", [0, 1])
def test_warning_names_reading_and_narrow_component(component):
    noise = [STEP, STEP]
    noise[component] = 1e-3
    (text,) = said(random_draws(walk_filter(noise)), walks())
    assert "'reading' at place 'analysis'" in text
    assert f"Component {component} correlates most with state component {component}" in text
    assert 'localisation="significance"' in text


@pytest.mark.parametrize("members", [32, 256])
def test_warning_names_outliers_and_few_members(members):
    """A jump that the motion holds for impossible: 256 members are as far off, and gating is the cure."""
    data = TensorDict({"reading": torch.zeros(1, STEPS, 2)}, [1, STEPS])
    data["reading"][:, 5:] = 1e3
    (text,) = said(walk_filter([1e-3, 1e-3], members), data)
    assert "Outliers, or a jump, may have displaced the belief: put a gate around the filter, Gated(filter)" in text
    assert ("few members" in text) == (members == 32)
    gated = Gated(walk_filter([1e-3, 1e-3], members), 2, patience=10)
    assert (gated.sequence(data)["belief", "mean"][0, -1] - 1e3).abs().max() < 1.0


@pytest.mark.parametrize(("distance", "warned"), [(2.0, False), (6.0, True)])
def test_the_distance_is_that_of_one_component(distance, warned):
    """Nine components at two standard deviations are six together."""
    filter = DEnKF(
        LearnedTransition(nn.Identity(), residual=False),
        None,
        Select([0] * 9),
        ConstantNoise([1.0] * 9, in_key="reading"),
        EnsembleAnalysis("etkf", observation_key="reading"),
        process_noise=1e-4,
        initial=GaussianPrior([0.0], [1e-4], ensemble_size=8),
    )
    torch.manual_seed(0)
    reading = distance * (2.0 * (torch.rand(1, STEPS, 9) > 0.5) - 1)
    assert bool(said(filter, TensorDict({"reading": reading}, [1, STEPS]))) == warned


def test_a_wrong_start_and_outliers_are_forgiven():
    data = walks()
    data["reading"][:, : STEPS // 2 - 1] += 50.0  # as far off as a start could be
    data["reading"][:, ::3] += 20.0 * (torch.arange(0, STEPS, 3) % 2).unsqueeze(-1)
    assert not said(walk_filter([STEP, STEP]), data)


def test_hidden_readings_do_not_count():
    data = walks()
    data["observed"] = torch.zeros(2, STEPS, 1, dtype=torch.bool)
    data["observed"][:, : STEPS // 2] = True
    data["observed"][:, -9:] = True  # 18 readings of the second half: too few to tell
    assert not said(walk_filter([1e-3, 1e-3]), data)
    data["observed"][:, -10:] = True
    assert said(walk_filter([1e-3, 1e-3]), data)


def test_no_check_in_training_or_without_diagnostics():
    assert not said(walk_filter([1e-3, 1e-3]), walks(), keep=[("belief", "mean")])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        walk_filter([1e-3, 1e-3]).sequence(walks())
    assert said(walk_filter([1e-3, 1e-3]), walks(), keep=[("info", "nis"), ("info", "innovation")])
