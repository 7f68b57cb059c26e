"""What a user meets at the border: stored beliefs, groups, precision, NaN, no frame, no rows, unstable systems."""

import warnings

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs import FrameSkipTransform, TransformedEnv

from tests.filters.factories import (
    NoisyLinear,
    linear_denkf,
    linear_kalman,
    linear_system,
    toy_denkf,
    toy_frames,
)
from tests.filters.gaussian_for_tests import linear_filter
from tests.filters.particle_for_tests import bootstrap
from tests.transforms.envs_for_tests import base_env
from torch_denkf.filters import EKF, UKF, DEnKF, Filter, KalmanFilter
from torch_denkf.modules import (
    ConstantNoise,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedObservation,
    LinearObservation,
    MomentPrior,
    Select,
    StochasticMLP,
)
from torch_denkf.transforms import DEnKFTransform

ENSEMBLE, MEAN, COV, VAR = (("belief", name) for name in ("ensemble", "mean", "cov", "var"))
BELIEF = [ENSEMBLE, MEAN, VAR]


def close(first, second, keys, atol=1e-12):
    for key in keys:
        torch.testing.assert_close(first[key], second[key], rtol=0, atol=atol)


# --------------------------------------------------------------------------------------------------- stored beliefs


@pytest.mark.parametrize("make", [linear_denkf, linear_kalman])
@pytest.mark.parametrize("marked", [False, True])
def test_a_stored_carry_alone_starts_the_sequence(float64, make, marked):
    filter = make()
    whole = filter.sequence(TensorDict({"observation": torch.randn(2, 80, 2)}, [2, 80]))
    tail = whole[:, 50:].select("observation", *filter.carry_keys).copy()
    if marked:  # as SliceSampler marks the beginning of a slice
        tail["is_init"] = torch.zeros(2, 30, 1, dtype=torch.bool)
        tail["is_init"][:, 0] = True
    close(filter.sequence(tail), whole[:, 50:], filter.belief_keys)


def test_stored_beliefs_start_anew_where_marks_say_so_and_nowhere_else(float64):
    filter = linear_denkf()
    frames = TensorDict({"observation": torch.randn(2, 9, 2)}, [2, 9])
    frames["is_init"] = torch.zeros(2, 9, 1, dtype=torch.bool)
    frames["is_init"][1, 5] = True
    stored = frames.copy().set(ENSEMBLE, 100 + torch.randn(2, 9, 6, 2))
    out = filter.sequence(stored.copy())
    assert out[ENSEMBLE][1, 5].equal(stored[ENSEMBLE][1, 5])
    assert not out[ENSEMBLE][0, 5].equal(stored[ENSEMBLE][0, 5])


# ----------------------------------------------------------------------------------------------------------- groups


@pytest.mark.parametrize("mark", ["is_init", "done"])
def test_marks_in_a_group_of_agents_reset_the_belief(float64, mark):
    filter = linear_denkf()
    frames = TensorDict({"observation": torch.randn(2, 9, 2)}, [2, 9])
    start = torch.zeros(2, 9, 1, dtype=torch.bool)
    start[:, 0] = start[1, 4] = True
    expected = filter.sequence(frames.copy().set("is_init", start))
    agents = torch.zeros(2, 9, 3, 1, dtype=torch.bool)
    if mark == "is_init":
        agents[..., 1, :] = start
        grouped = frames.copy().set(("agents", "is_init"), agents)
    else:
        agents[1, 3, 2] = True
        grouped = frames.copy().set(("next", "agents", "done"), agents)
    close(filter.sequence(grouped), expected, BELIEF)


# ------------------------------------------------------------------------------------------------------- the forecast


class Reversed(NoisyLinear):
    """Writes something else before the forecast, and the forecast of a Kalman filter in another order."""

    def __init__(self, matrix):
        super().__init__(matrix)
        self.out_keys = [("forecast", "speed"), ("forecast", "ensemble")]

    def compute(self, state, *, noise):
        moved = super().compute(state, noise=noise)
        return (moved - state).norm(dim=-1), moved


def test_forecasts_are_told_by_their_names(float64):
    F, _, _, _ = linear_system()
    plain = linear_denkf(update_at_reset=True)
    other = Filter(
        {"transition": Reversed(F), **{name: plain[name] for name in ("noise", "observation", "analysis")}},
        initial=plain.initial,
        update_at_reset=True,
    )
    assert other.structure.forecast_of == {ENSEMBLE: ("forecast", "ensemble")}
    frames = TensorDict({"observation": torch.randn(3, 6, 2)}, [3, 6])
    out = other.sequence(frames.copy())
    close(out, plain.sequence(frames.copy()), BELIEF)
    assert (out["forecast", "speed"][:, 0] == 0).all()
    assert (out["forecast", "speed"][:, 1:] > 0).all()


def test_two_forecasts_of_one_name_are_refused_until_one_is_named():
    F, *_ = linear_system()

    class Two(NoisyLinear):
        def __init__(self):
            super().__init__(F)
            self.out_keys = [("a", "ensemble"), ("forecast", "ensemble")]

        def compute(self, state, *, noise):
            moved = super().compute(state, noise=noise)
            return moved, moved

    plain = linear_denkf()
    modules = {"transition": Two(), **{name: plain[name] for name in ("noise", "observation", "analysis")}}
    with pytest.raises(ValueError, match="forecast_keys="):
        Filter(modules, initial=plain.initial)
    Filter(modules, initial=plain.initial, forecast_keys={ENSEMBLE: ("forecast", "ensemble")})
    with pytest.raises(ValueError, match="forecast_keys names"):
        Filter(modules, initial=plain.initial, forecast_keys={ENSEMBLE: ("nowhere", "ensemble")})


def test_a_module_that_undoes_another_is_refused():
    plain = linear_denkf()
    with pytest.raises(ValueError, match=r"over what 'analysis' .* before any module has read it"):
        Filter(
            {name: plain[name] for name in ("noise", "transition", "observation", "analysis")}
            | {"again": EnsembleAnalysis("etkf", sensor_key="observation")},
            initial=plain.initial,
        )
    with pytest.raises(ValueError, match="'observation' is a tensor"):
        Filter(
            {
                "noise": ConstantNoise([1.0, 1.0], in_key="observation", out_key=("observation", "noise")),
                "transition": plain["transition"],
                "observation": plain["observation"],
                "analysis": EnsembleAnalysis(
                    "etkf", sensor_key="observation", noise_variance_key=("observation", "noise")
                ),
            },
            initial=plain.initial,
        )


# ---------------------------------------------------------------------------------------------- precision, Q = 0


def test_float64_matrices_beside_float32_are_refused():
    F, Q, H, R = linear_system(torch.float64)
    with pytest.raises(TypeError, match=r"transition\.matrix.*float64.*float32"):
        KalmanFilter(F, Q, H, R, mean=torch.zeros(2), cov=torch.eye(2))
    kf = KalmanFilter(F, Q, H, R, mean=torch.zeros(2).double(), cov=torch.eye(2).double())
    frames = TensorDict({"observation": torch.randn(5, 2, dtype=torch.float64)}, [5])
    assert kf.sequence(frames)[MEAN].dtype == torch.float64


def test_float64_readings_are_refused_by_name():
    filter = linear_filter("EKF")
    td = filter.initialise(TensorDict({"observation": torch.zeros(2, dtype=torch.float64)}))
    with pytest.raises(TypeError, match=r"observation.*float64"):
        filter.step(td)
    # A dictionary is one robot's: numbers, lists and arrays come in the filter's precision.
    belief = filter.initialise({"observation": torch.zeros(2, dtype=torch.float64).numpy()})
    assert filter.step(belief)[MEAN].dtype == torch.float32


@pytest.mark.parametrize("kind", [EKF, UKF])
@pytest.mark.parametrize("q", [0.0, [0.0, 0.0]])
def test_no_process_noise_is_zero(float64, kind, q):
    F, _, H, R = linear_system()
    parts = (None, LinearObservation(H), ConstantNoise(R.sqrt(), in_key="observation"))
    prior = MomentPrior(torch.zeros(2), torch.eye(2))
    filter = kind(NoisyLinear(F), q, *parts, initial=prior, observation_key="observation")
    exact = KalmanFilter(F, torch.zeros(2, 2), H, R, mean=torch.zeros(2), cov=torch.eye(2))
    frames = TensorDict({"observation": torch.randn(3, 6, 2)}, [3, 6])
    # The sigma points' ridge is 10 eps of the correlations.
    close(filter.sequence(frames.copy()), exact.sequence(frames.copy()), [MEAN, COV], atol=1e-10)


def test_process_noise_is_a_part_of_an_ensemble_filter(float64):
    torch.manual_seed(0)
    F, Q, H, R = linear_system()
    parts = (None, LinearObservation(H), ConstantNoise(R.sqrt(), in_key="observation"))
    kalman = KalmanFilter(F, torch.diag(Q.diagonal()), H, R, mean=torch.zeros(2), cov=torch.eye(2))
    prior = GaussianPrior(torch.zeros(2), torch.ones(2), ensemble_size=20_000)
    filter = DEnKF(
        NoisyLinear(F), *parts, initial=prior, observation_key="observation", process_noise=Q.diagonal().sqrt()
    )
    frames = TensorDict({"observation": torch.randn(8, 2)}, [8])
    exact, out = kalman.sequence(frames.copy()), filter.sequence(frames.copy())
    torch.testing.assert_close(out[MEAN], exact[MEAN], rtol=0, atol=0.05)  # 5 standard errors of 20,000 members
    torch.testing.assert_close(out[VAR], exact[VAR], rtol=0.06, atol=0)
    collapsed = DEnKF(NoisyLinear(F), *parts, initial=prior, observation_key="observation").sequence(frames.copy())
    assert (collapsed[VAR][-1] < 0.3 * exact[VAR][-1]).all()


def test_a_replaced_network_draws_its_own_noise():
    filter, frames = toy_denkf(action=False), toy_frames((2, 5), resets=False)
    filter.sequence(frames.copy())
    filter["transition"].module = StochasticMLP(3, 3, (16, 16, 4), rate=0.3)
    assert filter.draw_noise(frames.copy())["noise", "transition"].shape[-1] == 36
    assert filter.sequence(frames.copy())[MEAN].isfinite().all()
    filter.module["observation"] = Select([0, 1])
    out = filter.sequence(frames.copy())
    assert out["forecast", "observation"][:, 1:].equal(out["forecast", "ensemble"][:, 1:, :, :2])


# ------------------------------------------------------------------------------------- NaN, no frame, no readings


@pytest.mark.parametrize("make", [linear_denkf, linear_kalman, lambda: bootstrap(50)])
def test_a_step_refuses_nan_and_leaves_the_belief_as_it_was(make):
    filter = make()
    td = filter.initialise(TensorDict({"observation": torch.zeros(2)}))
    before = td.copy()
    td["observation"] = torch.tensor([0.0, torch.nan])
    with pytest.raises(ValueError, match=r"NaN or infinity in \['observation'\]"):
        filter.step(td)
    assert all(td[key] is before[key] for key in filter.carry_keys)
    filter.check_finite = False
    assert not filter.step(td)[MEAN].isfinite().all()


@pytest.mark.parametrize(
    "make",
    [linear_denkf, linear_kalman, lambda: bootstrap(50), *(lambda n=n: linear_filter(n) for n in ("EKF", "UKF"))],
)
def test_a_step_without_a_frame_is_the_forecast(float64, make):
    filter = make()
    td = filter.initialise(TensorDict({"observation": torch.randn(2)}))
    hidden = td.copy().set("observed", torch.tensor([False]))
    torch.manual_seed(0)
    expected = filter.step(hidden)
    torch.manual_seed(0)
    out = filter.predict(td.exclude("observation"))
    close(out, expected, filter.belief_keys)
    assert out.get("observation", None) is None
    with pytest.raises(KeyError, match="'observation'"):
        filter.step(td.exclude("observation"))


def test_only_readings_are_left_out_of_a_prediction(float64):
    F, *_ = linear_system()
    plain = linear_denkf()

    class Wind(NoisyLinear):
        def __init__(self):
            super().__init__(F)
            self.in_keys, self.out_keys = [("forecast", "ensemble"), "wind"], [("forecast", "ensemble")]

        def compute(self, ensemble, wind, *, noise):
            return ensemble + wind.unsqueeze(-2)

    names = ("noise", "observation", "analysis")
    filter = Filter(
        {"transition": plain["transition"], "wind": Wind(), **{name: plain[name] for name in names}},
        initial=plain.initial,
    )
    assert filter.structure.readings == ("observation",)
    td = filter.initialise(TensorDict({"wind": torch.tensor([3.0, -1.0])}))
    moved = td[MEAN] @ F.mT + td["wind"]
    close(filter.predict(td), {MEAN: moved}, [MEAN])
    with pytest.raises(KeyError, match="which no module must find"):
        filter.step(td, without=["analysis"])
    with pytest.raises(TypeError, match="list of keys"):
        filter.step(td, without="observation")


def test_a_filter_under_vmap_is_the_filter_row_by_row(float64):
    filter, frames = linear_denkf(), torch.randn(4, 3, 6, 2)

    def means(observation):
        return filter.sequence(TensorDict({"observation": observation}, observation.shape[:-1]))[MEAN]

    expected = torch.stack([means(rows) for rows in frames])
    torch.testing.assert_close(torch.vmap(means)(frames), expected, rtol=0, atol=1e-12)


def test_one_of_two_sensors_may_be_missing(float64):
    _, _, H, R = linear_system()
    plain = linear_denkf()
    both = Filter(
        {
            "transition": plain["transition"],
            "r0": ConstantNoise(R[:1].sqrt(), in_key="y0", out_key="r0"),
            "r1": ConstantNoise(R[1:].sqrt(), in_key="y1", out_key="r1"),
            "h0": LinearObservation(H[:1], out_key="p0"),
            "a0": EnsembleAnalysis(
                "etkf", predicted_key="p0", sensor_key="y0", noise_variance_key="r0", belief_key="mid"
            ),
            "h1": LinearObservation(H[1:], in_key=("mid", "ensemble"), out_key="p1"),
            "a1": EnsembleAnalysis(
                "etkf", forecast_key=("mid", "ensemble"), predicted_key="p1", sensor_key="y1", noise_variance_key="r1"
            ),
        },
        initial=plain.initial,
    )
    y = torch.randn(2)
    td = both.initialise(TensorDict({"y0": y[:1], "y1": y[1:]}))
    for missing, kept in (("y0", 1), ("y1", 0)):
        one = Filter(
            {
                "transition": plain["transition"],
                "noise": ConstantNoise(R[[kept]].sqrt(), in_key="y"),
                "observation": LinearObservation(H[[kept]]),
                "analysis": EnsembleAnalysis("etkf", sensor_key="y"),
            },
            initial=plain.initial,
        )
        expected = one.step(td.select("belief").copy().set("y", y[[kept]]))
        close(both.step(td.exclude(missing).copy(), without=[missing]), expected, BELIEF)


@pytest.mark.parametrize("kind", ["ensemble", "kalman", "particles"])
def test_an_unstable_system_that_nobody_observes_stays_finite_and_comes_back(kind):
    """Unheld it overflows at step 872 in float32: the standard deviation grows by a tenth a step."""
    F, one = 1.1 * torch.eye(1), torch.eye(1)
    if kind == "kalman":
        filter = KalmanFilter(F, one, one, one, mean=torch.ones(1), cov=one)
    else:
        parts = {"observation": LinearObservation(one), "noise": ConstantNoise([1.0], in_key="observation")}
        prior = GaussianPrior([1.0], [1.0], ensemble_size=64)
        if kind == "ensemble":
            filter = DEnKF(NoisyLinear(F, one), None, **parts, initial=prior, observation_key="observation")
        else:
            filter = bootstrap(64, initial=prior)
            filter.module["transition"].module = NoisyLinear(F, one)
            filter.module["observation"], filter.module["noise"] = parts["observation"], parts["noise"]
    td = filter.initialise(TensorDict({"observation": torch.zeros(1)}))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for _ in range(2_000):
            td = filter.predict(td)
    assert sum("variance_ceiling" in str(warning.message) for warning in said) == 1
    assert td[MEAN].isfinite().all()
    assert td[VAR] <= 1.001e12
    if kind == "particles":  # a reading that none of the 64 particles explains leaves one of them
        return
    for reading in (3.0, 3.3, 3.6, 4.0, 4.4, 4.8):
        td = filter.step(td.set("observation", torch.tensor([reading])))
    assert (td[MEAN] - 4.8).abs() < 3.0
    assert td[VAR] < 3.0
    loose = KalmanFilter(F, one, one, one, mean=torch.ones(1), cov=one, variance_ceiling=None)
    frames = TensorDict(
        {"observation": torch.zeros(1000, 1), "observed": torch.zeros(1000, 1, dtype=torch.bool)}, [1000]
    )
    assert not loose.sequence(frames)[VAR].isfinite().all()


# ------------------------------------------------------------------------------------------------ no rows, no steps


@pytest.mark.parametrize("scheme", ["sensor", "perturbed", "etkf", "sakov"])
@pytest.mark.parametrize("members", [2, 8])
def test_no_rows(scheme, members):
    filter = toy_denkf(scheme, ensemble_size=members, action=False)
    frames = toy_frames((0, 4))
    assert filter.sequence(frames)[MEAN].shape == (0, 4, 3)
    step = filter.step(filter.initialise(toy_frames((0,), resets=False)))
    assert step[ENSEMBLE].shape == (0, members, 3)


@pytest.mark.parametrize(
    "make", [linear_kalman, lambda: bootstrap(5), lambda: linear_filter("EKF"), lambda: linear_filter("UKF")]
)
def test_no_rows_of_other_filters(make):
    frames = TensorDict(
        {"observation": torch.randn(0, 4, 2), "observed": torch.ones(0, 4, 2, dtype=torch.bool)}, [0, 4]
    )
    assert make().sequence(frames)[MEAN].shape == (0, 4, 2)


def test_no_steps_are_refused():
    with pytest.raises(ValueError, match=r"at least one step.*\[3, 0\]"):
        linear_denkf().sequence(TensorDict({"observation": torch.zeros(3, 0, 2)}, [3, 0]))


# ------------------------------------------------------------------------------------------------- what is returned


def test_keep_returns_what_is_asked_for(float64):
    filter, frames = toy_denkf(), toy_frames((2, 6))
    filter.draw_noise(frames)
    expected, keep = filter.sequence(frames.copy()), [MEAN, ("sensor", "ensemble"), ("info", "nis")]
    for chunk in (0, 2):
        out = filter.compile(chunk=chunk, backend="eager").sequence(frames.copy(), keep=keep)
        assert set(out.exclude(*frames.keys()).keys(True, True)) == set(keep)
        close(out, expected, keep)
    with pytest.raises(ValueError, match=r"keep names \['nothing'\]"):
        filter.sequence(frames, keep=["nothing"])


def test_the_covariance_of_an_ensemble_on_request(float64):
    filter = linear_denkf()
    filter.module["analysis"] = EnsembleAnalysis("etkf", sensor_key="observation", covariance=True)
    frames = TensorDict({"observation": torch.randn(3, 5, 2)}, [3, 5])
    out = filter.sequence(frames)
    deviations = out[ENSEMBLE] - out[MEAN].unsqueeze(-2)
    close({COV: out[COV]}, {COV: deviations.mT @ deviations / 5}, [COV])
    assert COV in filter.belief_keys
    env = TransformedEnv(base_env(seed=0, batch_size=[2]), DEnKFTransform(filter))
    assert env.reset()[COV].shape == (2, 2, 2)


# ------------------------------------------------------------------------------------------------- compiled, guards


class Keyed(nn.Module):
    """A network under a name that sounds like entries."""

    def __init__(self):
        super().__init__()
        self.keys = nn.Linear(2, 2)

    def forward(self, state):
        return self.keys(state)


def test_freezing_a_network_called_keys_is_noticed():
    filter = linear_denkf()
    filter.module["observation"] = LearnedObservation(Keyed())
    filter.compile(chunk=2, backend="eager")
    frames, network = TensorDict({"observation": torch.randn(3, 5, 2)}, [3, 5]), filter["observation"].module.keys
    network.requires_grad_(False)
    filter.sequence(frames.copy())
    network.requires_grad_(True)
    filter.sequence(frames.copy())[MEAN].square().sum().backward()
    assert network.weight.grad.abs().sum() > 0


def test_guards_that_are_left_out_are_not_about_what_users_change():
    from torch_denkf.filters.inductor import worth_checking

    class Guard:
        def __init__(self, name, kind="TYPE_MATCH", is_global=False):
            self.name, self.guard_type, self.is_global = name, kind, is_global

    kept = ["L['steps'].structure.update[0][1].keys.weight", "L['x'].monkeys", "L['module']._modules['keys_in']"]
    dropped = ["L['module'].in_keys[0]", "L['module'].optional_keys", "G['torch'].nn"]
    guards = [Guard(name, is_global=name.startswith("G")) for name in (*kept, *dropped)]
    assert worth_checking(guards) == [True] * 3 + [False] * 3


def test_other_versions_of_torch_get_plain_inductor(monkeypatch, caplog):
    from torch_denkf.filters import inductor

    monkeypatch.setattr(torch, "__version__", "3.1.0")
    monkeypatch.setattr(inductor, "_said", False)
    assert inductor.options_for_processors() == {"cpp_wrapper": True}
    inductor.options_for_processors()
    assert sum("plain inductor" in record.message for record in caplog.records) == 1


# ------------------------------------------------------------------------------------------------------ frame skips


def test_behind_a_frame_skip_the_belief_takes_one_step_a_skip():
    env = base_env(seed=0, batch_size=[2])
    filter = linear_denkf()
    skipping = TransformedEnv(TransformedEnv(env, DEnKFTransform(filter)), FrameSkipTransform(3))
    rollout = skipping.rollout(2)
    row = filter.step(
        rollout[:, 0].select("belief", "action").copy().set("observation", rollout["next", "observation"][:, 0])
    )
    close(rollout["next"][:, 0], row, [MEAN], atol=1e-6)
    inside = TransformedEnv(
        TransformedEnv(base_env(seed=0, batch_size=[2]), FrameSkipTransform(3)), DEnKFTransform(filter)
    )
    close(inside.rollout(2), rollout, [MEAN], atol=1e-6)


def test_an_initial_belief_is_drawn_in_the_filters_precision():
    filter = toy_denkf(action=False).double()
    assert filter.initialise(TensorDict({}, [3]))[ENSEMBLE].dtype == torch.float64
