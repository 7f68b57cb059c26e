"""Gated analyses: inert ones change nothing; the others against closed forms and simulated systems."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import FixedEnsemble, NoisyLinear, linear_denkf, linear_kalman, linear_system
from tests.filters.gaussian_for_tests import linear_filter
from torch_denkf.baselines import LSTMFilter
from torch_denkf.filters import KalmanFilter
from torch_denkf.imperfect import Visible
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, KalmanAnalysis, LinearObservation
from torch_denkf.monitoring import Gated, GatedAnalysis
from torch_denkf.monitoring.chi_square import chi_square_quantile

FILTERS = {
    "etkf": lambda: linear_denkf("etkf", noisy=True),
    "perturbed": lambda: linear_denkf("perturbed", noisy=True),
    "Kalman": linear_kalman,
    "EKF": lambda: linear_filter("EKF"),
    "UKF": lambda: linear_filter("UKF"),
}
RESPONSES = ("reject", "student", "huber")
DIM = 2


def data(runs=3, steps=12, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    values = {"observation": torch.randn(runs, steps, DIM, generator=generator, dtype=torch.float64).to(dtype)}
    return TensorDict(values, [runs, steps])


def run(filter, td, seed=3):
    torch.manual_seed(seed)
    dtype = next(value.dtype for value in filter.buffers() if value.is_floating_point())
    return filter.sequence(td.clone().set("observation", td["observation"].to(dtype)))


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("response", RESPONSES)
def test_an_inert_gate_is_the_filter_bit_for_bit(name, response):
    plain = run(FILTERS[name](), data())
    filter = FILTERS[name]()
    gated = run(Gated(filter, DIM, response=response, rate=0.0), data())
    for key in filter.out_keys:
        assert torch.equal(plain[key], gated[key]), key


def still(variance=1.0, noise=1.0, **kwargs):
    """Returns a state that does not move, in one dimension: the update is a weighted mean."""
    one = torch.eye(1, dtype=torch.float64)
    filter = KalmanFilter(
        one, one, process_noise_cov=0 * one, noise_cov=noise * one, mean=torch.zeros(1).double(), cov=variance * one
    )
    return Gated(filter, **kwargs)


def one_reading(gated, value):
    td = gated.initialise(TensorDict({"observation": torch.tensor([value], dtype=torch.float64)}))
    return gated.step(td)


@pytest.mark.parametrize("value", [1.0, 9.0])
def test_responses_are_their_closed_forms(value):
    limit, q = chi_square_quantile(1e-3, 1), value**2 / 2  # prior and noise of variance one: S = 2
    factors = {
        "reject": torch.inf if q > limit else 1.0,
        "student": (4 + q) / (4 + limit) if q > limit else 1.0,
        "huber": (q / limit) ** 0.5 if q > limit else 1.0,
    }
    for response, factor in factors.items():
        out = one_reading(still(response=response, window=1), value)
        assert out["gate", "factor"].item() == pytest.approx(factor, rel=1e-5), response  # the limits are float32's
        assert out["belief", "mean"].item() == pytest.approx(value / (1 + factor), rel=1e-5), response
        assert out["gate", "nis"].item() == pytest.approx(q)


def test_several_steps_decide():
    """A reading of 4.2 standard deviations passes among good ones, and does not pass as the third of its kind."""
    gated = still(1e-9, response="reject", window=3, rate=1e-4)  # the limit for three steps is 21.1
    values = torch.tensor([0, 0.1, 0.1, 4.2, 0.1, 0.1, 0.1, 4.2, 4.2, 4.2], dtype=torch.float64).unsqueeze(-1)
    factor = gated.sequence(TensorDict({"observation": values}, [10]))["gate", "factor"].flatten()
    assert factor.isinf().tolist() == [False] * 8 + [True, True]


@pytest.mark.parametrize("jump", [10.0, 100.0])
@pytest.mark.parametrize("response", RESPONSES)
@pytest.mark.parametrize("kind", ["Kalman", "ensemble"])
def test_each_response_comes_back_after_a_jump(kind, response, jump):
    """The motion holds it for impossible; once the gate has opened, the belief is the mean of what was read since."""
    steps, patience = 100, 20
    one = torch.eye(1, dtype=torch.float64)
    if kind == "Kalman":
        filter = KalmanFilter(
            one, one, process_noise_cov=1e-8 * one, noise_cov=0.09 * one, mean=torch.zeros(1).double(), cov=0.01 * one
        )
    else:
        members = torch.tensor([[-1.0], [0.0], [1.0]]).double() * 0.1
        filter = (
            linear_denkf("etkf")
            .double()
            .with_modules(
                initial=FixedEnsemble(members),
                transition=NoisyLinear(one),
                observation=LinearObservation(one),
                noise=ConstantNoise(0.3 * torch.ones(1).double(), in_key="observation"),
            )
        )
    torch.manual_seed(0)
    reading = jump + 0.3 * torch.randn(steps, 1, dtype=torch.float64)
    out = Gated(filter, 1, response=response, patience=patience).sequence(TensorDict({"observation": reading}, [steps]))
    opened = int((out["gate", "shut"].flatten().diff() < 0).nonzero()[0]) + 1
    assert opened == patience + 1
    since = reading[opened:].mean()
    assert out["belief", "mean"][-1].item() == pytest.approx(since.item(), abs=0.02)
    assert out["belief", "var"][-1].item() == pytest.approx(0.09 / (steps - opened), rel=0.05)
    assert out["belief", "mean"][patience // 2].abs() < jump / 2


@pytest.mark.parametrize("name", ["Kalman", "EKF", "etkf", "perturbed"])
@pytest.mark.parametrize("response", RESPONSES)
def test_gate_around_an_update_with_visibility(name, response):
    """A sensor that surely sees is one without Visible, and an inert gate is no gate."""
    filter, td = FILTERS[name]().double(), data(steps=8)
    heeds = filter.with_modules(analysis=Visible(filter["analysis"], visible_key="visible"))
    options = {"response": response, "rate": 0.3, "patience": 2}
    sees = td.clone().set("visible", torch.ones(3, 8, 1, dtype=torch.float64))
    expected, out = run(Gated(filter, DIM, **options), td), run(Gated(heeds, DIM, **options), sees)
    for key in (("belief", "mean"), ("belief", "var"), ("gate", "factor"), ("gate", "shut")):
        torch.testing.assert_close(out[key], expected[key])
    assert (expected["gate", "factor"] > 1).any()
    unsure = td.clone().set("visible", torch.rand(3, 8, 1, dtype=torch.float64))
    plain, inert = run(heeds, unsure), run(Gated(heeds, DIM, response=response, rate=0.0), unsure)
    assert all(torch.equal(plain[key], inert[key]) for key in heeds.out_keys)


def test_missing_readings_do_not_open_the_gate():
    one = torch.eye(1, dtype=torch.float64)
    analysis = Visible(KalmanAnalysis(one, 0.09 * one), visible_key="visible")
    filter = still(0.01, 0.09).with_modules(analysis=analysis)
    reading = torch.full((60, 1), 20.0, dtype=torch.float64)
    td = TensorDict({"observation": reading, "visible": torch.full_like(reading, 1e-3)}, [60])
    out = Gated(filter, 1, patience=5).sequence(td)
    assert out["gate", "shut"].max() == 0
    assert out["belief", "mean"].abs().max() < 0.1
    assert out["belief", "var"].max() < 0.02
    seen = Gated(filter, 1, patience=5).sequence(td.set("visible", torch.full_like(reading, 0.9)))
    assert seen["belief", "mean"][-1].item() == pytest.approx(20.0, abs=0.1)


def simulate(runs, steps, factor=1.0):
    """Returns states and readings of the linear system whose noise variance is larger by a factor than R."""
    F, Q, H, R = linear_system(torch.float64)
    generator = torch.Generator().manual_seed(0)
    moved, read = torch.randn(2, runs, steps, DIM, generator=generator, dtype=torch.float64)
    moved, state, states = moved @ torch.linalg.cholesky(Q).mT, torch.zeros(runs, DIM, dtype=torch.float64), []
    for t in range(steps):
        state = state @ F.mT + moved[:, t]
        states.append(state)
    truth = torch.stack(states, 1)
    return truth, TensorDict({"observation": truth @ H.mT + (factor * R).sqrt() * read}, [runs, steps])


@pytest.mark.parametrize("kind", ["Kalman", "etkf", "etkf by component"])
@pytest.mark.parametrize("factor", [0.2, 8.0])
def test_adaptive_noise_converges_to_the_true_one(kind, factor):
    """The filter is told a noise that is wrong by a factor; the truth is a linear Gaussian system."""
    filter = linear_kalman() if kind == "Kalman" else linear_denkf("etkf", noisy=True, ensemble_size=100)
    gated = Gated(filter, DIM, rate=0.0, adapt_noise=0.02, by_component="by" in kind)
    with torch.no_grad():
        out = run(gated, simulate(32, 700, factor)[1])
    found = out["gate", "log_noise"][:, 450:].double().exp().mean((0, 1))
    assert found.tolist() == pytest.approx([factor] * len(found), rel=0.15)


def test_adaptive_inflation_finds_the_missing_process_noise():
    """A random walk whose steps are 16 times as large in variance as the filter was told: NIS returns to its mean."""
    generator, one = torch.Generator().manual_seed(0), torch.eye(1, dtype=torch.float64)
    walk = (0.4 * torch.randn(16, 600, 1, generator=generator)).cumsum(1).double()
    readings = walk + 0.1 * torch.randn(16, 600, 1, generator=generator).double()
    std = torch.tensor([0.1], dtype=torch.float64)
    told = {"process_noise": std, "noise": std}
    td = TensorDict({"observation": readings}, [16, 600])
    plain = KalmanFilter(one, one, **told, mean=torch.zeros(1).double(), cov=one)
    wider = Gated(copy.deepcopy(plain), rate=0.0, adapt_inflation=0.02)
    out = {"plain": plain.sequence(td.clone()), "wider": wider.sequence(td.clone())}
    nis = {name: each["info", "nis"][:, 200:].mean().item() for name, each in out.items()}
    error = {name: (each["belief", "mean"] - walk)[:, 200:].square().mean().sqrt().item() for name, each in out.items()}
    assert nis["plain"] > 4
    assert nis["wider"] == pytest.approx(1.0, abs=0.15)
    assert error["wider"] < 0.95 * error["plain"]


@pytest.mark.parametrize("name", FILTERS)
def test_outliers_do_less_harm(name):
    truth, td = simulate(32, 36)
    td["observation"][:, 5::6] += 30 * linear_system()[3].sqrt()
    error = {}
    for response in ("none", *RESPONSES):
        rate = 0.0 if response == "none" else 1e-3
        gated = Gated(FILTERS[name](), DIM, response="reject" if response == "none" else response, rate=rate)
        with torch.no_grad():
            out = run(gated, td)
        error[response] = (out["belief", "mean"].double() - truth)[:, 6:].square().mean().sqrt().item()
    assert error["reject"] < 0.5 * error["none"]
    assert error["student"] < 0.6 * error["none"]
    assert error["huber"] < 0.9 * error["none"]


@pytest.mark.parametrize("response", ["student", "huber"])
def test_gradients_are_those_of_finite_differences(response):
    gated = still(1.0, response=response, window=2)
    values = torch.tensor([[0.0], [1.0], [8.0], [7.5]], dtype=torch.float64)

    def final(values):
        return gated.sequence(TensorDict({"observation": values}, [4]))["belief", "mean"][-1]

    assert torch.autograd.gradcheck(final, values.requires_grad_())


@pytest.mark.parametrize("response", RESPONSES)
def test_masked_components_have_no_effect(response):
    td = data(steps=20)
    td["observation"][:, 5:8] = torch.nan
    td["observed"] = torch.ones(3, 20, 1, dtype=torch.bool)
    td["observed"][:, 5:8] = False
    for name in FILTERS:
        gated = Gated(FILTERS[name](), DIM, response=response, adapt_noise=0.1)
        out = run(gated, td)
        assert out["belief", "mean"].isfinite().all(), name
        for key in ("terms", "log_noise", "shut"):
            assert torch.equal(out["gate", key][:, 4], out["gate", key][:, 7]), (name, key)


def test_calibration_matches_the_false_alarm_rate():
    """Innovations twice as large as expected open no gate that was calibrated on such."""
    gated = still(1.0, 0.25, response="reject", window=3, rate=0.01)
    readings = torch.randn(40, 200, 1, generator=torch.Generator().manual_seed(0)).double()
    clean, fresh = (TensorDict({"observation": part}, [20, 200]) for part in readings.split(20))
    naive = gated.sequence(fresh.clone())["gate", "factor"].isinf().double().mean()
    gated.calibrate([clean])
    share = gated.sequence(fresh.clone())["gate", "factor"].isinf().double().mean()
    assert naive > 0.1
    assert share < 0.015


def gate_of(kind, dim=1, **options):
    """Returns a gate around the update of a forecast N(0, 1) by readings with noise 1, and that forecast."""
    if kind == "ensemble":
        members = torch.randn(5 * dim, dim).double()
        members = members - members.mean(0)
        members = members @ torch.linalg.inv(torch.linalg.cholesky(members.mT.cov().reshape(dim, dim))).mT
        forecast = {"ensemble": members, "observation": members}
        analysis = EnsembleAnalysis("etkf", observation_key="reading")
    else:
        forecast = {"mean": torch.zeros(dim).double(), "cov": torch.eye(dim).double()}
        analysis = KalmanAnalysis(torch.eye(dim).double(), None, observation_key="reading")
    gate = GatedAnalysis(analysis, dim, **options).double()
    td = TensorDict({"forecast": forecast, "sensor": {"noise": torch.ones(dim).double()}})
    for key, value in zip(gate.state_keys, gate.initial_state([], dtype=torch.float64), strict=True):
        td[key] = value
    return gate, td


@pytest.mark.parametrize("kind", ["Kalman", "ensemble"])
def test_an_adapted_factor_multiplies_the_forecasts_variance(kind):
    gate, td = gate_of(kind, rate=0.0, adapt_inflation=0.1)
    td["gate", "log_inflation"] += math.log(4.0)
    out = gate(td.set("reading", torch.tensor([2.0]).double()))
    assert out["belief", "mean"].item() == pytest.approx(2.0 * 4 / 5)
    assert out["belief", "var"].item() == pytest.approx(4 / 5)
    assert out["gate", "log_inflation"].item() == pytest.approx(math.log(4.0) + 0.1 * (2.0**2 / 5 - 1))


@pytest.mark.parametrize("kind", ["Kalman", "ensemble"])
def test_a_gate_that_opens_spreads_the_forecast_by_the_innovation_of_each_component(kind):
    """Three components: q = |y|^2 / 2, of which each explains a third."""
    reading = torch.tensor([9.0, -6.0, 12.0]).double()
    reach = reading.square().sum().item() / 2 / 3
    gate, td = gate_of(kind, 3, response="reject", window=1, patience=2)
    td["gate", "shut"] += 2
    out = gate(td.set("reading", reading))
    assert out["gate", "factor"].item() == 1
    torch.testing.assert_close(out["belief", "mean"], reading * reach / (reach + 1))
    torch.testing.assert_close(out["belief", "var"], torch.full((3,), reach / (reach + 1)).double())


@pytest.mark.parametrize("kind", ["Kalman", "ensemble"])
def test_adapted_spread_is_never_below_the_forecasts_own(kind):
    """Innovations that are far too small: the factor stays one, and the belief is that without a gate."""
    gate, td = gate_of(kind, rate=0.0, adapt_inflation=0.5)
    plain = gate.module(td.copy().set("reading", torch.tensor([0.1]).double()))
    for _ in range(3):
        td = gate(td.set("reading", torch.tensor([0.1]).double()))
        assert td["gate", "log_inflation"].item() == 0
        assert torch.equal(td["belief", "var"], plain["belief", "var"])


def test_rejected_sensor_is_accepted_again_when_consistent():
    """6.0 lies below the limit, 10.8, and above that of a reading whose forerunner was rejected, 3.8."""
    gate, td = gate_of("Kalman", response="reject", window=1, rate=1e-3)
    factors = []
    for q in (6.0, 20.0, 6.0, 2.0, 6.0):
        td = gate(td.set("reading", torch.tensor([math.sqrt(2 * q)]).double()))
        factors.append(td["gate", "factor"].item())
    assert factors == [1.0, math.inf, math.inf, 1.0, 1.0]


def test_gap_does_not_reset_the_patience():
    gate, td = gate_of("Kalman", response="reject", window=1, patience=3)
    td["reading"], shut = torch.tensor([50.0]).double(), []
    for observed in (True, True, False, True, True):
        td = gate(td.set("observed", torch.tensor([observed])))
        shut.append(td["gate", "shut"].item())
    assert shut == [1, 2, 2, 3, 0]


@pytest.mark.parametrize("kind", ["Kalman", "ensemble"])
def test_a_rejected_reading_is_no_measure_of_the_noise(kind):
    gate, td = gate_of(kind, response="reject", window=1, adapt_noise=0.1)
    found = []
    for value in (1.0, 50.0, -50.0):
        td = gate(td.set("reading", torch.tensor([value]).double()))
        found.append(td["gate", "log_noise"].item())
    assert found == pytest.approx([0.1 * (1 / 2 - 1)] * 3)


def test_by_component_combines_mask_and_rejection():
    gate, td = gate_of("ensemble", 3, response="reject", window=1, by_component=True)
    td["reading"] = torch.tensor([1.0, 40.0, 2.0]).double()
    given, kept = torch.tensor([True, True, False]), torch.tensor([True, False, False])
    out = gate(td.copy().set("observed", given))
    assert out["gate", "factor"].tolist() == [1.0, math.inf, 1.0]
    expected = gate.module(td.copy().set("observed", kept))
    torch.testing.assert_close(out["belief", "ensemble"], expected["belief", "ensemble"], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("name", "by_component"), [*((name, False) for name in FILTERS), ("etkf", True)])
@pytest.mark.parametrize("response", ["reject", "huber"])
def test_adapted_spread_ignores_missing_and_rejected_readings(name, by_component, response):
    """The spread is adapted where a reading is used: without one it would grow from step to step, without end."""
    gated = Gated(FILTERS[name](), DIM, adapt_inflation=0.3, response=response, window=1, by_component=by_component)
    row, outs = run(gated, data(steps=20))[:, -1], {}
    row["gate", "log_inflation"].fill_(1.0)
    for kind in ("none", "hidden", *(["rejected"] if response == "reject" else [])):
        step = row.clone()
        step["observation"] = 1e3 + step["observation"].to(step["belief", "mean"].dtype)
        step["observed"] = torch.full((3, 1), kind == "rejected")
        torch.manual_seed(5)
        outs[kind] = gated.predict(step) if kind == "none" else gated.step(step)
        for key in ("mean", "var"):
            torch.testing.assert_close(outs[kind]["belief", key], outs["none"]["belief", key])
    assert response != "reject" or outs["rejected"]["gate", "factor"].isinf().all()


def test_wrong_arguments_are_named():
    with pytest.raises(TypeError, match="no analysis that a gate goes around"):
        Gated(LSTMFilter(None, state_dim=2, hidden_size=8, observation_dim=2, observation_key="observation"))
    with pytest.raises(TypeError, match="does not say where"):
        GatedAnalysis(torch.nn.Identity(), 2)
    with pytest.raises(ValueError, match="by_component"):
        Gated(linear_kalman(), by_component=True)
    with pytest.raises(ValueError, match="response"):
        Gated(linear_kalman(), response="tukey")
    with pytest.raises(ValueError, match="window"):
        Gated(linear_kalman(), window=0)
