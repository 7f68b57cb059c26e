"""The warning that an observed mask hides a reading which a module uses all the same."""

import warnings

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from tests.filters.factories import Perturbed, linear_denkf, linear_kalman, linear_system
from tests.filters.particle_for_tests import bootstrap
from torch_denkf.envs import LinearGaussianEnv, MissingFrames
from torch_denkf.filters import KalmanFilter
from torch_denkf.transforms import DEnKFTransform


def with_analysis(analysis, **kwargs):
    return linear_denkf("perturbed", noisy=True, **kwargs).with_modules(analysis=analysis)


def readings(*batch, observed=None):
    frames = TensorDict({"observation": torch.randn(*batch, 2)}, batch)
    return frames if observed is None else frames.set("observed", observed)


def said(record):
    return [str(one.message) for one in record if "Said once" in str(one.message)]


# ---------------------------------------------------------------------------------------------------------- masks


def hidden(*batch):
    mask = torch.ones(*batch, 1, dtype=torch.bool)
    mask[..., -1, :] = False
    return mask


class HiddenEnv(LinearGaussianEnv):
    """Readings that are finite, and hidden."""

    def _emit(self, state, step):
        out = super()._emit(state, step)
        return out.set("observed", torch.zeros_like(out["observed"]))


@pytest.mark.parametrize("way", ["sequence", "step", "policy", "environment"])
def test_a_mask_that_the_analysis_does_not_read_is_said_once(way):
    filter = with_analysis(Perturbed())
    F, Q, H, R = linear_system()
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        for _ in range(2):
            if way == "sequence":
                filter.sequence(readings(2, 3, observed=hidden(2, 3)))
            elif way == "environment":
                env = HiddenEnv(F, H, Q.diag().sqrt(), R.sqrt())
                TransformedEnv(env, DEnKFTransform(filter)).rollout(5)
            else:
                td = filter.initialise(readings(observed=torch.tensor([False])))
                filter.step(td) if way == "step" else filter(td)
    assert len(said(record)) == 1
    for word in ("'observed'", "Perturbed", "'analysis'", "optional_keys"):
        assert word in said(record)[0]


@pytest.mark.parametrize(
    "make", [linear_denkf, linear_kalman, lambda: bootstrap(20), lambda: with_analysis(Perturbed(masked=True))]
)
def test_no_false_alarm_where_the_mask_is_read(make):
    filter = make()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        filter.sequence(readings(2, 3, observed=hidden(2, 3)))
        filter.step(filter.initialise(readings(observed=torch.tensor([False]))))


# ------------------------------------------------------------------------------------------- masks of one reading


@pytest.mark.parametrize("observed", [None, True])
@pytest.mark.parametrize("make", [linear_denkf, linear_kalman, lambda: bootstrap(20)])
def test_forward_filled_reading_used_again_warns_once(make, observed):
    filter, frames = make(), readings(2, 4).set("observation_observed", hidden(2, 4))
    if observed:  # the mask of another sensor
        frames["observed"] = torch.ones(2, 4, 1, dtype=torch.bool)
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        filter.sequence(frames.copy())
        filter.sequence(frames.copy())
    assert len(said(record)) == 1
    assert "observed_key='observation_observed'" in said(record)[0]


@pytest.mark.parametrize("case", ["its key", "hidden, too", "all new"])
def test_no_warning_if_forward_filled_readings_are_masked(case):
    filter, frames = linear_kalman(), readings(2, 4).set("observation_observed", hidden(2, 4))
    if case == "its key":
        filter = linear_kalman(observed_key="observation_observed")
    elif case == "hidden, too":
        frames["observed"] = hidden(2, 4)
    else:
        frames["observation_observed"] = torch.ones(2, 4, 1, dtype=torch.bool)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        filter.sequence(frames)


def identity(**options):
    one = torch.eye(2)
    noises = {"process_noise": [1.0, 1.0], "noise": [1.0, 1.0]}
    return KalmanFilter(one, one, **noises, mean=torch.zeros(2), cov=one, **options)


class TestMasksThatNothingReads:
    def test_misspelt_mask_is_named_once(self):
        frames = readings(3, 5).set("obsrved", torch.zeros(3, 5, 1, dtype=torch.bool))
        filter = linear_kalman()
        with pytest.warns(UserWarning, match="reads the mask 'observed', which is not there, .*'obsrved'"):
            filter.sequence(frames.clone())
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            filter.sequence(frames.clone())

    @pytest.mark.parametrize("name", ["seen", "observed", "obsrved_too_far", "unobserved_wheel"])
    def test_other_names_are_left_alone(self, name):
        frames = readings(3, 5).set(name, torch.zeros(3, 5, 1, dtype=torch.bool))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            linear_kalman().sequence(frames)

    def test_mask_of_another_entry_is_left_alone(self):
        mask = torch.zeros(3, 5, 1, dtype=torch.bool)
        frames = readings(3, 5).update({"gps2": torch.zeros(3, 5, 1), "gps2_observed": mask})
        filter = identity(observed_key="gps_observed")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            filter.sequence(frames)
        frames = frames.exclude("gps2")
        filter = identity(observed_key="gps_observed")
        with pytest.warns(UserWarning, match="'gps2_observed'"):
            filter.sequence(frames)

    @pytest.mark.parametrize(("mask", "warns"), [("seen", True), ("observed", False)])
    def test_frames_that_go_missing_under_another_mask(self, mask, warns):
        filter = identity()
        world = LinearGaussianEnv(torch.eye(2), torch.eye(2), transition_std=[1.0, 1.0], observation_std=[1.0, 1.0])
        env = TransformedEnv(world, MissingFrames(0.5, in_keys=["observation"], observed_key=mask))
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            env.append_transform(DEnKFTransform(filter))
            env.rollout(3)
        assert sum("MissingFrames marks where 'observation'" in str(one.message) for one in said) == warns
