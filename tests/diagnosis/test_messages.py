"""What a filter says once: that a compiled one runs eagerly, and that a module ignores a mask."""

import warnings

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.modules import set_recurrent_mode

from tests.filters.factories import NoisyLinear, linear_denkf, linear_kalman, linear_system
from tests.filters.particle_for_tests import bootstrap
from tests.filters.test_noise_sizes import SizeAtTheStep
from torch_denkf.envs import LinearGaussianEnv, MissingFrames
from torch_denkf.filters import DEnKF, Filter, KalmanFilter
from torch_denkf.functional import analyse, ensemble_mean, ensemble_var
from torch_denkf.modules import ConstantNoise, LinearObservation, SubModel
from torch_denkf.transforms import DEnKFTransform

MEAN = ("belief", "mean")
_DIAGNOSTICS = ("innovation", "nis", "log_likelihood")


class Perturbed(SubModel):
    """A stochastic analysis as a user writes it, with or without a mask; it names no ``noise_variance_key``."""

    noise_names = ("",)

    def __init__(self, *, masked=False, reading="observation", info="info"):
        reads = [("forecast", "ensemble"), ("forecast", "observation"), reading, ("sensor", "noise")]
        writes = [("belief", name) for name in ("ensemble", "mean", "var")] + [(info, name) for name in _DIAGNOSTICS]
        super().__init__(nn.Identity(), reads, writes, optional_keys=["observed"] if masked else [])
        self.reading_keys, self.info_prefix = self.in_keys[2:], info

    def draw_noise(self, batch_size, *, members=None, observation_dim=None, device=None, dtype=None, **_):
        if members is None or observation_dim is None:
            return None
        return torch.randn(*batch_size, members, observation_dim, device=device, dtype=dtype)

    def noise_sizes(self, forecast, predicted, *_):
        return {"members": forecast.shape[-2], "observation_dim": predicted.shape[-1]}

    def compute(self, forecast, predicted, reading, variance, observed=None, *, noise):
        ensemble, *rest = analyse(
            forecast, predicted, reading, variance, scheme="perturbed", observed=observed, perturbation=noise
        )
        return ensemble, ensemble_mean(ensemble), ensemble_var(ensemble), *rest


def with_analysis(analysis, **kwargs):
    filter = linear_denkf("perturbed", noisy=True, **kwargs)
    filter = filter.with_modules(analysis=analysis)
    return filter


def readings(*batch, observed=None):
    frames = TensorDict({"observation": torch.randn(*batch, 2)}, batch)
    return frames if observed is None else frames.set("observed", observed)


def said(record):
    return [str(one.message) for one in record if "Said once" in str(one.message)]


# ------------------------------------------------------------------------------------------------------- compiled


def test_a_stochastic_analysis_that_names_no_variances_compiles(float64):
    """And gives what the library's own gives for the same seed, compiled or not."""
    frames, outs = readings(3, 5), []
    for analysis, chunk in ((None, 0), (Perturbed(), 0), (Perturbed(), 2)):
        filter = linear_denkf("perturbed", noisy=True) if analysis is None else with_analysis(analysis)
        filter.compile(chunk=chunk, backend="eager")
        torch.manual_seed(1)
        out = filter.sequence(frames.copy())
        outs.append(torch.cat([out[MEAN], filter.step(out[:, -1].copy())[MEAN].unsqueeze(1)], 1))
    assert {kind[0] for kind in filter.compiled._functions} == {"first", "chunk", "step"}
    for out in outs[1:]:
        torch.testing.assert_close(out, outs[0], rtol=0, atol=1e-12)


def test_a_compiled_filter_that_cannot_draw_its_noise_says_so_once():
    F, Q, _, _ = linear_system()
    filter = linear_denkf("perturbed", noisy=True)
    filter = filter.with_modules(transition=SizeAtTheStep(F, torch.linalg.cholesky(Q)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        out = filter.sequence(readings(2, 3))
    filter.compile(chunk=2, backend="eager")
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        for _ in range(2):
            out = filter.sequence(readings(2, 3))
            filter.step(out[:, -1])
    assert len(said(record)) == 1
    assert "SizeAtTheStep at place 'transition'" in said(record)[0]
    assert "noise_variance_key" in said(record)[0]


@pytest.mark.parametrize("make", [linear_kalman, linear_denkf])
def test_predictions_of_a_compiled_filter_are_compiled_and_equal(make):
    eager, filter = make(), make().compile(backend="eager")
    td = filter.initialise(TensorDict({"observation": torch.zeros(2)}))
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        predicted, left_out = filter.predict(td.copy()), filter.step(td.copy(), without=["observation"])
    assert len(filter.compiled._functions) == 1
    expected = eager.predict(td.copy())["belief"]
    for belief in (predicted["belief"], left_out["belief"]):
        for key in ("mean", "var"):
            torch.testing.assert_close(belief[key], expected[key], rtol=0, atol=1e-6)


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
    "make",
    [
        linear_denkf,
        linear_kalman,
        lambda: bootstrap(20),
        lambda: with_analysis(Perturbed(masked=True)),
    ],
)
def test_no_false_alarm_where_the_mask_is_read(make):
    filter = make()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        filter.sequence(readings(2, 3, observed=hidden(2, 3)))
        filter.step(filter.initialise(readings(observed=torch.tensor([False]))))


@pytest.mark.parametrize("case", ["no mask", "nothing hidden", "another reads it"])
def test_no_false_alarm_for_an_analysis_without_a_mask(case):
    filter = with_analysis(Perturbed())
    if case == "another reads it":
        plain = linear_denkf("perturbed", noisy=True)
        plain = plain.with_modules(analysis=linear_denkf("etkf")["analysis"])
        second = Perturbed(reading="encoders", info="other")
        second.in_keys[0] = ("belief", "ensemble")
        filter = Filter({**dict(plain.module.items()), "second": second}, initial=plain.initial)
    observed = {"no mask": None, "nothing hidden": torch.tensor([True])}.get(case, torch.tensor([False]))
    td = filter.initialise(readings(observed=observed).set("encoders", torch.zeros(2)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        filter.step(td)


def test_an_analysis_without_a_mask_cannot_do_without_its_reading():
    filter = with_analysis(Perturbed())
    td = filter.initialise(readings())
    with pytest.raises(KeyError, match="its reading_keys and its observed_key"):
        filter.predict(td)


# ---------------------------------------------------------------------------------------------------------- twice


def linear_env(*transforms):
    F, Q, H, R = linear_system()
    env = TransformedEnv(LinearGaussianEnv(F, H, Q.diag().sqrt(), R.sqrt(), batch_size=[2]))
    for transform in transforms:
        env.append_transform(transform)
    return env


def test_a_filter_in_environment_and_policy_counts_readings_twice_and_says_so():
    filter = linear_kalman()
    env = linear_env(DEnKFTransform(filter))
    actor = TensorDictModule(lambda mean: mean[..., :1], [MEAN], ["action"])
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        env.rollout(6, TensorDictSequential(filter, actor))
    assert len(said(record)) == 1
    assert "counts twice" in said(record)[0]
    assert "make_tensordict_primer" in said(record)[0]


@pytest.mark.parametrize("case", ["environment", "policy", "loop", "data"])
def test_no_false_alarm_for_a_filter_in_one_place(case):
    filter = linear_kalman()
    actor = TensorDictModule(lambda mean: mean[..., :1], [MEAN], ["action"])
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*counts twice.*")
        if case == "environment":
            linear_env(DEnKFTransform(filter)).rollout(4, actor)
        elif case == "policy":
            linear_env(InitTracker(), filter.make_tensordict_primer()).rollout(4, TensorDictSequential(filter, actor))
        else:
            data = linear_env(DEnKFTransform(filter)).rollout(4, actor)
            if case == "data":
                with set_recurrent_mode(True):
                    filter(data)
            else:  # what the transform left, and the next frame
                filter.step(data[:, -1]["next"].exclude("reward").set("observation", torch.zeros(2, 2)))


# ------------------------------------------------------------------------------------------- masks of one reading


@pytest.mark.parametrize("observed", [None, True])
@pytest.mark.parametrize("make", [linear_denkf, linear_kalman, lambda: bootstrap(20)])
def test_a_held_reading_that_counts_anew_is_said_once(make, observed):
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
def test_no_false_alarm_where_held_readings_are_hidden(case):
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


def test_the_mask_of_a_filters_default_analysis_can_be_named(float64):
    """Oracle: the mask under its usual name."""
    F, Q, H, R = linear_system()
    frames = readings(3, 6).set("gps_observed", torch.rand(3, 6, 2) < 0.5)
    renamed = frames.clone().rename_key_("gps_observed", "observed")
    noise = ConstantNoise(R.sqrt(), in_key="observation")
    initial = linear_denkf().initial
    for make in (
        lambda **keys: linear_kalman(**keys),
        lambda **keys: DEnKF(
            NoisyLinear(F, torch.linalg.cholesky(Q)),
            None,
            LinearObservation(H),
            noise,
            initial=initial,
            observation_key="observation",
            **keys,
        ),
    ):
        outs = []
        for filter, given in ((make(), renamed), (make(observed_key="gps_observed"), frames)):
            torch.manual_seed(1)
            outs.append(filter.sequence(given.copy())[MEAN])
        assert outs[0].equal(outs[1])
    with pytest.raises(ValueError, match="observed_key are for the default analysis"):
        DEnKF(noise, None, noise, noise, linear_denkf()["analysis"], initial=initial, observed_key="gps_observed")


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
        matrices = {
            "transition": torch.eye(2),
            "observation": torch.eye(2),
            "cov": torch.eye(2),
            "mean": torch.zeros(2),
        }
        filter = KalmanFilter(**matrices, process_noise=[1.0, 1.0], noise=[1.0, 1.0], observed_key="gps_observed")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            filter.sequence(frames)
        frames = frames.exclude("gps2")
        filter = KalmanFilter(**matrices, process_noise=[1.0, 1.0], noise=[1.0, 1.0], observed_key="gps_observed")
        with pytest.warns(UserWarning, match="'gps2_observed'"):
            filter.sequence(frames)

    @pytest.mark.parametrize(("mask", "warns"), [("seen", True), ("observed", False)])
    def test_frames_that_go_missing_under_another_mask(self, mask, warns):
        matrices = {
            "transition": torch.eye(2),
            "observation": torch.eye(2),
            "cov": torch.eye(2),
            "mean": torch.zeros(2),
        }
        filter = KalmanFilter(**matrices, process_noise=[1.0, 1.0], noise=[1.0, 1.0])
        world = LinearGaussianEnv(torch.eye(2), torch.eye(2), transition_std=[1.0, 1.0], observation_std=[1.0, 1.0])
        env = TransformedEnv(world, MissingFrames(0.5, in_keys=["observation"], observed_key=mask))
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            env.append_transform(DEnKFTransform(filter))
            env.rollout(3)
        assert sum("MissingFrames marks where 'observation'" in str(one.message) for one in said) == warns
