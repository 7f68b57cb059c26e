"""Gated analyses: inert ones change nothing; the others against closed forms and simulated systems."""

import copy

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import linear_denkf, linear_kalman
from tests.filters.gaussian_for_tests import linear_filter
from torch_denkf import DEnKFTransform, LinearGaussianEnv
from torch_denkf.filters import Gated, KalmanFilter, LSTMFilter, Monitored
from torch_denkf.functional import adapt, chi_square_quantile, disbelief
from torch_denkf.modules import GatedAnalysis, InnovationMonitor, MonitoredSensor

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


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("response", RESPONSES)
def test_a_limit_of_infinity_is_inert_too(name, response):
    """Here the gate does run the analysis again, with factors of one."""
    plain, filter = run(FILTERS[name](), data()), FILTERS[name]()
    gated = Gated(filter, DIM, response=response)
    gated.gates[0].limits.fill_(torch.inf)
    out = run(gated, data())
    for key in filter.out_keys:
        assert torch.equal(plain[key], out[key]), key


def still(variance=1.0, noise=1.0, **kwargs):
    """A state that does not move, in one dimension: the update is a weighted mean."""
    one = torch.eye(1, dtype=torch.float64)
    filter = KalmanFilter(one, 0 * one, one, noise * one, mean=torch.zeros(1).double(), cov=variance * one)
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


def test_the_pull_of_an_outlier():
    """Student's falls with distance, Huber's stays, that of a rejected reading is none."""
    pull = {
        response: [
            one_reading(still(1e-3, response=response, window=1), value)["belief", "mean"].item() for value in (20, 200)
        ]
        for response in RESPONSES
    }
    assert pull["student"][1] < 0.2 * pull["student"][0]
    assert pull["huber"][1] == pytest.approx(pull["huber"][0], rel=0.02)
    assert pull["reject"] == [0.0, 0.0]


def test_several_steps_decide():
    """A reading of 4.2 standard deviations passes among good ones, and does not pass as the third of its kind."""
    gated = still(1e-9, response="reject", window=3, rate=1e-4)  # the limit for three steps is 21.1
    values = torch.tensor([0, 0.1, 0.1, 4.2, 0.1, 0.1, 0.1, 4.2, 4.2, 4.2], dtype=torch.float64).unsqueeze(-1)
    factor = gated.sequence(TensorDict({"observation": values}, [10]))["gate", "factor"].flatten()
    assert factor.isinf().tolist() == [False] * 8 + [True, True]


def test_a_gate_that_shut_itself_out_opens_again():
    """The state jumps, which the filter holds for impossible: after so many steps it must believe it."""
    jump = torch.cat([torch.zeros(5), torch.full((25,), 100.0)]).double().unsqueeze(-1)
    td = TensorDict({"observation": jump}, [30])
    never = still(1e-4, 0.01, response="reject", window=2, patience=1000).sequence(td.clone())
    opens = still(1e-4, 0.01, response="reject", window=2, patience=10).sequence(td.clone())
    assert never["belief", "mean"][-1].abs() < 1.0
    assert opens["gate", "factor"].isinf().sum() == 10
    assert opens["belief", "mean"][-1].item() == pytest.approx(100.0, abs=5.0)
    assert opens["belief", "mean"][5:15].abs().max() < 1.0


@pytest.mark.parametrize("kind", ["Kalman", "etkf", "etkf by component"])
@pytest.mark.parametrize("factor", [0.2, 8.0])
def test_adaptive_noise_converges_to_the_true_one(kind, factor):
    """The filter is told a noise that is wrong by a factor; the truth is a linear Gaussian system."""
    from tests.filters.factories import linear_system

    F, Q, H, R = (part.double() for part in linear_system())
    generator = torch.Generator().manual_seed(0)
    runs, steps = 16, 900
    state, readings = torch.zeros(runs, len(F), dtype=torch.float64), []
    scale = R.diag() if R.ndim == 2 else R
    true = scale * factor
    for _ in range(steps):
        state = state @ F.mT + torch.randn(runs, len(F), generator=generator).double() @ torch.linalg.cholesky(Q).mT
        readings.append(state @ H.mT + true.sqrt() * torch.randn(runs, len(H), generator=generator).double())
    td = TensorDict({"observation": torch.stack(readings, 1)}, [runs, steps])
    filter = linear_kalman() if kind == "Kalman" else linear_denkf("etkf", noisy=True, ensemble_size=100)
    gated = Gated(filter, len(H), rate=0.0, adapt_noise=0.02, by_component="by" in kind)
    with torch.no_grad():
        out = run(gated, td)
    found = out["gate", "log_noise"][:, 400:].double().exp().mean((0, 1))
    assert found.tolist() == pytest.approx([factor] * len(found), rel=0.15)


def test_adaptive_inflation_finds_the_missing_process_noise():
    """A random walk whose steps are 16 times as large in variance as the filter was told: NIS returns to its mean."""
    generator, one = torch.Generator().manual_seed(0), torch.eye(1, dtype=torch.float64)
    walk = (0.4 * torch.randn(16, 600, 1, generator=generator)).cumsum(1).double()
    readings = walk + 0.1 * torch.randn(16, 600, 1, generator=generator).double()
    told = (one, 0.01 * one, one, 0.01 * one)
    td = TensorDict({"observation": readings}, [16, 600])
    plain = KalmanFilter(*told, mean=torch.zeros(1).double(), cov=one)
    wider = Gated(copy.deepcopy(plain), rate=0.0, adapt_inflation=0.02)
    out = {"plain": plain.sequence(td.clone()), "wider": wider.sequence(td.clone())}
    nis = {name: each["info", "nis"][:, 200:].mean().item() for name, each in out.items()}
    error = {name: (each["belief", "mean"] - walk)[:, 200:].square().mean().sqrt().item() for name, each in out.items()}
    assert nis["plain"] > 4
    assert nis["wider"] == pytest.approx(1.0, abs=0.15)
    assert error["wider"] < 0.95 * error["plain"]


def test_components_are_judged_by_themselves():
    td = data(runs=1, steps=10, dtype=torch.float32)
    td["observation"][:, 6, 1] = 300.0
    gated = Gated(linear_denkf(), DIM, response="reject", window=1, by_component=True)
    out = run(gated, td)
    assert out["gate", "factor"][0, 6].isinf().tolist() == [False, True]
    masked = td.clone()
    masked["observed"] = torch.ones(1, 10, DIM, dtype=torch.bool)
    masked["observed"][:, 6, 1] = False
    plain = run(linear_denkf(), masked)
    assert torch.allclose(out["belief", "mean"][:, 6], plain["belief", "mean"][:, 6], atol=1e-4)


@pytest.mark.parametrize("name", FILTERS)
def test_outliers_do_less_harm(name):
    from tests.filters.factories import linear_system

    F, Q, H, R = (part.double() for part in linear_system())
    generator = torch.Generator().manual_seed(0)
    state, states, readings = torch.zeros(20, len(F), dtype=torch.float64), [], []
    noise = (R.diag() if R.ndim == 2 else R).sqrt()
    for _ in range(60):
        state = state @ F.mT + torch.randn(20, len(F), generator=generator).double() @ torch.linalg.cholesky(Q).mT
        states.append(state)
        readings.append(state @ H.mT + noise * torch.randn(20, len(H), generator=generator).double())
    truth, td = torch.stack(states, 1), TensorDict({"observation": torch.stack(readings, 1)}, [20, 60])
    td["observation"][:, 5::6] += 30 * noise
    error = {}
    for response in ("none", *RESPONSES):
        rate = 0.0 if response == "none" else 1e-3
        gated = Gated(FILTERS[name](), len(H), response="reject" if response == "none" else response, rate=rate)
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
def test_nothing_behind_the_mask_counts(response):
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


@pytest.mark.parametrize("name", FILTERS)
def test_steps_without_a_reading_keep_the_state(name):
    gated = Gated(FILTERS[name](), DIM)
    td = run(gated, data())[:, -1]
    before = td["gate", "terms"].clone()
    after = gated.predict(td.clone())
    assert torch.equal(after["gate", "terms"], before)
    assert (after["gate", "factor"] == 1).all()


@pytest.mark.parametrize("response", RESPONSES)
def test_steps_sequences_and_environments_agree(response):
    F = torch.tensor([[1.0, 0.1], [-0.1, 0.9]])
    kalman = KalmanFilter(
        F, 0.05 * torch.eye(2), torch.eye(2), 0.01 * torch.eye(2), mean=torch.zeros(2), cov=torch.eye(2)
    )
    gated = Gated(kalman, response=response, rate=0.2, patience=3, adapt_noise=0.1)  # acts often
    gated = Monitored(gated, InnovationMonitor({"gps": MonitoredSensor("gate", 2)}))
    env = LinearGaussianEnv(F, torch.eye(2), [0.3, 0.3], [0.3, 0.3], batch_size=[3], seed=0)
    rollout = env.append_transform(DEnKFTransform(gated)).rollout(30)
    stream = torch.cat([rollout["observation"][:, :1], rollout["next", "observation"]], 1)
    sequence = gated.sequence(TensorDict({"observation": stream}, [3, 31]))[:, 1:]
    assert (sequence["gate", "factor"] > 1).any()
    for key in (
        ("belief", "mean"),
        ("gate", "terms"),
        ("gate", "shut"),
        ("gate", "log_noise"),
        ("monitor", "gps", "cusum"),
    ):
        assert torch.allclose(rollout["next", *key], sequence[key], atol=1e-4), key


@pytest.mark.parametrize(
    "response", ["reject", *(pytest.param(soft, marks=pytest.mark.slow) for soft in ("student", "huber"))]
)
def test_compiled_steps_give_the_same(response):
    def made():
        return Gated(linear_denkf(), DIM, response=response, rate=0.3, by_component=True, adapt_inflation=0.1)

    td = data(2, 7)
    eager, compiled = run(made(), td), run(made().compile(chunk=2, backend="aot_eager"), td)
    for key in (("belief", "mean"), ("gate", "factor"), ("gate", "terms")):
        assert torch.allclose(eager[key], compiled[key], atol=1e-5, equal_nan=False), key


def test_calibration_holds_what_clean_data_show():
    """Innovations twice as large as expected open no gate that was calibrated on such."""
    gated = still(1.0, 0.25, response="reject", window=3, rate=0.01)
    readings = torch.randn(40, 200, 1, generator=torch.Generator().manual_seed(0)).double()
    clean, fresh = (TensorDict({"observation": part}, [20, 200]) for part in readings.split(20))
    naive = gated.sequence(fresh.clone())["gate", "factor"].isinf().double().mean()
    gated.calibrate([clean])
    share = gated.sequence(fresh.clone())["gate", "factor"].isinf().double().mean()
    assert naive > 0.1
    assert share < 0.015


def test_functions_refuse_and_hold():
    with pytest.raises(ValueError, match="reject, student, huber"):
        disbelief(torch.ones(1), torch.ones(1), "tukey")
    assert torch.equal(adapt(torch.ones(2), torch.ones(2), torch.zeros(2), 0.1), torch.ones(2))


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
