"""Names what a loss cannot score: labels of another shape, another kind of belief, what is no key."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict

from tests.borders.test_constructors import message_of
from tests.filters.factories import linear_denkf, linear_kalman, toy_denkf
from tests.filters.gaussian_for_tests import learned_filter
from tests.filters.particle_for_tests import bootstrap, toy_filter
from tests.objectives.denkf_for_tests import TERMS
from tests.objectives.problem_for_tests import only, problem
from torch_denkf.baselines import LSTMFilter
from torch_denkf.objectives import DEnKFLoss, GaussianLoss, MixtureLoss, TransitionLoss
from torch_denkf.smoothers import EnKS

LOSSES = {
    "DEnKFLoss": lambda **options: DEnKFLoss(linear_denkf("etkf"), **options),
    "GaussianLoss": lambda **options: GaussianLoss(linear_kalman(), **options),
    "MixtureLoss": lambda **options: MixtureLoss(bootstrap(8), **options),
    "TransitionLoss": lambda **options: TransitionLoss(linear_denkf("etkf"), **options),
}
LABELS = {  # of a state of two dimensions, for a batch [4, 5]
    "without a last dimension": ({"state": torch.zeros(4, 5)}, {}, "'state'", "[4, 5, 'N']", "got [4, 5]"),
    "with one more": ({"state": torch.zeros(4, 5, 2, 1)}, {}, "'state'", "got [4, 5, 2, 1]"),
    "empty": ({"state": torch.zeros(4, 5, 0)}, {}, "'state'", "got [4, 5, 0]"),
    "of more dimensions": ({"state": torch.zeros(4, 5, 3)}, {}, "'state' is [4, 5, 3]", "has 2 components"),
    "dims beyond the belief": ({"state": torch.zeros(4, 5, 3)}, {"dims": [2]}, "dims=[2]", "has 2 components"),
    "dims beyond the labels": ({"state": torch.zeros(4, 5, 1)}, {"dims": [1, 0]}, "dims=[1, 0]", "'state' has 1"),
    "mask without a last dimension": (
        {"state": torch.zeros(4, 5, 2), "state_observed": torch.ones(4, 5, dtype=torch.bool)},
        {},
        "'state_observed'",
        "[4, 5, 1] or [*B, N] = [4, 5, 2]",
        "got [4, 5]",
    ),
    "mask of more": (
        {"state": torch.zeros(4, 5, 1), "state_observed": torch.ones(4, 5, 2, dtype=torch.bool)},
        {},
        "'state_observed'",
        "got [4, 5, 2]",
    ),
    "mask of numbers": (
        {"state": torch.zeros(4, 5, 2), "state_observed": torch.ones(4, 5, 1)},
        {},
        "'state_observed'",
        "must be boolean",
    ),
}


@pytest.mark.parametrize("case", LABELS.values(), ids=LABELS)
@pytest.mark.parametrize("make", LOSSES.values(), ids=LOSSES)
def test_labels_of_another_shape(make, case):
    entries, options, *words = case
    if make is LOSSES["TransitionLoss"] and options:  # a step starts from all of the state, whatever is scored
        words = ["'state' is [4, 5, 3]"] if options["dims"] == [2] else ["whole true state of 2", "'state' has 1"]
    data = TensorDict({"observation": torch.zeros(4, 5, 2), **entries}, [4, 5])
    message_of(lambda: make(**options)(data), *words)


# ------------------------------------------------------------------------------------------- settings, missing entries


def lstm():
    return LSTMFilter(None, state_dim=2, observation_dim=2, observation_key="observation")


SETTINGS = [
    ("DEnKFLoss", {"score": "nll"}, "'nll'"),
    ("GaussianLoss", {"score": "energy"}, '"crps", "nll" or "mse"'),
    ("GaussianLoss", {"dims": [0, 1], "state_scale": [1.0] * 5}, "one entry for each of dims=[0, 1]; got 5"),
    ("MixtureLoss", {"score": "mse"}, "'mse'"),
    ("MixtureLoss", {"state_scale": [1.0], "dims": [0, 1]}, "state_scale has one entry"),
    ("MixtureLoss", {"component_std": [1.0, 0.0]}, "component_std is the width"),
    ("MixtureLoss", {"component_std": [1.0] * 3, "dims": [0, 1]}, "component_std has one entry"),
    ("TransitionLoss", {"score": "nll"}, '"crps", "energy" or "mse"'),
    ("TransitionLoss", {"spread": -1.0}, "not negative"),
    ("TransitionLoss", {"belief": "analysis"}, "Pass the prefix"),
]


@pytest.mark.parametrize(("loss", "options", "words"), SETTINGS)
def test_settings(loss, options, words):
    message_of(lambda: LOSSES[loss](**options), words)


OBSERVATION, SENSOR = only(TERMS, "observation"), only(TERMS, "sensor")
MISSING = [
    ("state", DEnKFLoss, toy_denkf, {}, "DEnKFLoss reads", "state", "set_keys"),
    ("state", MixtureLoss, toy_filter, {}, "MixtureLoss reads 'state'", "set_keys"),
    ("state", TransitionLoss, toy_denkf, {}, "'state', which is missing"),
    ("measurement", DEnKFLoss, toy_denkf, {}, "measurement"),
    ("target_observation", DEnKFLoss, toy_denkf, {}, "'target_observation'"),
    ("target_observation", DEnKFLoss, toy_denkf, OBSERVATION, "target_observation"),
    ("target_observation", MixtureLoss, toy_filter, {"sensor": 1.0}, "target_observation"),
    ("target_observation", GaussianLoss, partial(learned_filter, "EKF"), {}, "set_keys(target_observation=...)"),
    ("target_observation", DEnKFLoss, lstm, SENSOR, "no observation model"),
]


@pytest.mark.parametrize(("left_out", "loss", "make", "options", "words"), [(*case[:4], case[4:]) for case in MISSING])
def test_missing_entries(left_out, loss, make, options, words):
    frames, _ = problem(toy_denkf())
    frames = frames.set("observation", torch.zeros(2, 7, 2)).exclude(left_out, "noise")
    message_of(lambda: loss(make(), **options)(frames), *words, error=KeyError)


# --------------------------------------------------------------------------------------------- another kind of belief


def test_another_belief_raises_and_the_right_loss_named():
    data = TensorDict({"observation": torch.zeros(4, 5, 2), "state": torch.zeros(4, 5, 2)}, [4, 5])
    for score in ("crps", "energy", "mse"):
        loss = DEnKFLoss(bootstrap(8), score=score)
        message_of(lambda loss=loss: loss(data), "log_weight", "MixtureLoss", 'score="crps"', error=TypeError)
    smoothed = DEnKFLoss(bootstrap(8), state=0.0, transition=0.0, smoothed=1.0, smoother=particle_smoother)
    message_of(lambda: smoothed(data), "log_weight", "MixtureLoss", error=TypeError)
    wrong = [DEnKFLoss(linear_kalman()), MixtureLoss(linear_kalman())]
    wrong += [GaussianLoss(linear_denkf("etkf")), GaussianLoss(bootstrap(8))]
    for loss in wrong:
        with pytest.raises(KeyError, match=r"DEnKFLoss scores members.*MixtureLoss particles.*GaussianLoss a mean"):
            loss(data)


def particle_smoother(filter):
    return EnKS(linear_denkf("etkf"))  # its smoothed members do not count: the filter's own have weights
