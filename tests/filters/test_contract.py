"""Tests what every filter promises, whatever its belief: one table of filters, one list of promises.

The oracles are the filter's own: another way to compute the same, which must agree. That the numbers are right is
shown in each filter's own file, against a Kalman filter.
"""

import pickle
from copy import deepcopy
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import InitTracker, TransformedEnv, check_env_specs
from torchrl.modules import set_recurrent_mode

from tests.filters.factories import NoisyLinear, assert_equal, believing, linear_denkf, linear_kalman, linear_system
from tests.filters.gaussian_for_tests import linear_filter
from tests.transforms.envs_for_tests import base_env
from torch_denkf.baselines import LSTMFilter
from torch_denkf.filters import ParticleFilter
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.modules import (
    ConstantNoise,
    GaussianLikelihood,
    GaussianPrior,
    LinearObservation,
    LinearTransition,
    MomentPrior,
    Select,
)
from torch_denkf.monitoring import Gated, InnovationMonitor, Monitored, MonitoredSensor
from torch_denkf.smoothers import FixedLag
from torch_denkf.transforms import DEnKFTransform


def particles(scheme, **kwargs):
    F, Q, H, R = linear_system()
    return ParticleFilter(
        NoisyLinear(F, torch.linalg.cholesky(Q)),
        None,
        LinearObservation(H),
        GaussianLikelihood(observation_key="observation"),
        noise=ConstantNoise(R.sqrt(), in_key="observation"),
        initial=GaussianPrior([0.5, -0.25], [1.0, 1.0], ensemble_size=16),
        resampling=scheme,
        **kwargs,
    )


def lstm():
    torch.manual_seed(0)
    return LSTMFilter(None, state_dim=2, hidden_size=8, observation_dim=2, observation_key="observation")


def fused(kind, *, late=False, **kwargs):
    """Returns two sensors that read the same entry, the second one perhaps two steps late."""
    F, Q, H, R = linear_system()
    if kind == "Kalman":
        motion, initial = LinearTransition(F, Q), MomentPrior(torch.zeros(2), torch.eye(2))
    else:
        motion = NoisyLinear(F, torch.linalg.cholesky(Q))
        initial = GaussianPrior([0.5, -0.25], [1.0, 1.0], ensemble_size=8)
    shared = {"observation_key": "observation", "observed_key": "observed"}
    sensors = {
        "first": FusedSensor(LinearObservation(H), R.sqrt(), **shared),
        "second": FusedSensor(Select([0, 1]), 2 * R.sqrt(), delay=2 * late, **shared),
    }
    return FusedFilter(motion, sensors, initial=initial, **kwargs)


FILTERS = {
    "DEnKF etkf": linear_denkf,
    "DEnKF perturbed": lambda: linear_denkf("perturbed", noisy=True),
    "DEnKF sakov": lambda: linear_denkf("sakov", noisy=True),
    "DEnKF significance": lambda: believing(torch.tensor([0.5, 1.0])),
    "Kalman": linear_kalman,
    "EKF": lambda: linear_filter("EKF"),
    "UKF": lambda: linear_filter("UKF"),
    "Backprop KF": lambda: linear_filter("BackpropKF"),
    "particles, systematic": lambda: particles("systematic"),
    "particles, jitter": lambda: particles("systematic", jitter=0.7, ess_threshold=0.5),
    "particles, soft": lambda: particles("soft"),
    "particles, transport": lambda: particles("transport"),
    "LSTM": lambda: lstm(),
    "monitored": lambda: Monitored(linear_kalman(), InnovationMonitor({"gps": MonitoredSensor("info", 2)}).double()),
    "gated DEnKF": lambda: Gated(linear_denkf("perturbed", noisy=True), 2, response="reject", rate=0.2, patience=2),
    "gated UKF": lambda: Gated(linear_filter("UKF"), 2, rate=0.2, adapt_noise=0.1),
    "fused": lambda: fused("ensemble"),
    "fused, late": lambda: fused("ensemble", late=True),
    "fused, late, joint": lambda: fused("ensemble", late=True, joint=True),
    "fused Kalman, late": lambda: fused("Kalman", late=True),
    "fused Kalman, late, joint": lambda: fused("Kalman", late=True, joint=True),
}
LAGGED = ("DEnKF etkf", "DEnKF significance", "DEnKF perturbed", "Kalman", "UKF", "particles, jitter")
FILTERS |= {f"{name}, lag": partial(lambda inner: FixedLag(inner(), 3), FILTERS[name]) for name in LAGGED}
#: Of their own.
FILTERS_WITHOUT_NOISE = {"DEnKF etkf", "DEnKF significance", "Kalman", "EKF", "UKF", "Backprop KF", "LSTM"}
FILTERS_WITHOUT_NOISE |= {"fused Kalman, late", "fused Kalman, late, joint"}
FILTERS_WITHOUT_NOISE |= {f"{name}, lag" for name in FILTERS_WITHOUT_NOISE}
every_filter = pytest.mark.parametrize("name", FILTERS)
#: One of each belief. To trace a step takes dynamo up to half a minute; `make test-all` traces all.
TRACED = {"DEnKF significance, lag", "Backprop KF", "particles, soft"}
some_filters = pytest.mark.parametrize(
    "name", [name if name in TRACED else pytest.param(name, marks=pytest.mark.slow) for name in FILTERS]
)


def readings(*batch, width=1):
    """Returns readings, masks, and resets that differ between rows."""
    frames = TensorDict({"observation": torch.randn(*batch, 2)}, batch)
    frames["observed"] = torch.rand(*batch, width) < 0.7
    frames["is_init"] = torch.rand(*batch, 1) < 0.2
    frames["is_init"][..., 0, :] = True
    return frames


def with_noise(name, *batch, width=1):
    """Returns a filter, and readings with the noise of all its steps."""
    filter = FILTERS[name]()
    return filter, filter.draw_noise(readings(*batch, width=width))


def filtered(name, **kwargs):
    env = TransformedEnv(base_env(seed=0, **kwargs), DEnKFTransform(FILTERS[name]()))
    return TransformedEnv(env, InitTracker())


@pytest.mark.parametrize(
    ("name", "batch"), [*((name, [3]) for name in FILTERS), *((name, []) for name in sorted(TRACED))]
)
def test_specs(name, batch):
    check_env_specs(filtered(name, batch_size=batch, max_steps=4))


@every_filter
def test_partial_resets(name):
    env = filtered(name, batch_size=[2], max_steps=[3, 5])
    rollout = env.rollout(12, break_when_any_done=False)
    done = rollout["next", "done"].squeeze(-1)[:, :-1]
    for key in FILTERS[name]().belief_keys:
        now, then = rollout[key][:, 1:], rollout["next", key][:, :-1]
        assert now[~done].equal(then[~done]), key
        # Of equal weights the last step's may be, too, and a gate or a monitor may have had nothing to say.
        if key[-1] != "log_weight" and key[0] not in ("gate", "monitor"):
            assert not now[done].equal(then[done]), key


@every_filter
def test_steps_are_the_sequence(float64, name):
    filter, frames = with_noise(name, 3, 7, width=2)
    expected = filter.sequence(frames.copy())
    row, rows = filter.initialise(frames[:, 0].copy()), []
    for t in range(7):
        row = frames[:, t].copy().update(row.select(*filter.carry_keys))
        row = filter(row)  # a start starts again
        rows.append(row)
    assert_equal(torch.stack(rows, 1), expected, filter.out_keys, atol=1e-10)
    with set_recurrent_mode(True):
        assert_equal(filter(frames.copy()), expected, filter.out_keys)


@some_filters
def test_compiled_is_eager(float64, name):
    """Forward and backward. What inductor makes of a graph is tested in test_compiled.py."""
    filter, frames = with_noise(name, 3, 5, width=2)
    frames["observation"].requires_grad_()
    outs = []
    for chunk in (0, 2):
        out = filter.compile(chunk=chunk, backend="eager").sequence(frames.copy())
        torch.manual_seed(0)
        step = filter.step(out[:, 3].select(*filter.carry_keys, *frames.keys()).exclude("noise"))
        gradient = torch.autograd.grad(out["belief", "mean"].square().sum(), frames["observation"])
        outs.append((out, step, gradient[0]))
    assert {kind[0] for kind in filter.compiled._functions} == {"chunk", "step"}
    for eager, compiled in zip(*outs, strict=True):
        if isinstance(eager, torch.Tensor):
            torch.testing.assert_close(compiled, eager, rtol=0, atol=1e-11)
        else:
            assert_equal(compiled, eager, filter.out_keys, atol=1e-11)


@every_filter
@pytest.mark.parametrize("width", [1, 2])
def test_missing_readings_may_have_any_value(float64, name, width):
    filter, frames = with_noise(name, 3, 6, width=width)
    expected = filter.sequence(frames.copy())
    frames["observation"] = torch.where(frames["observed"], frames["observation"], torch.nan).requires_grad_()
    leaf = frames["observation"]
    broken = filter.sequence(frames.copy())
    assert_equal(broken, expected, filter.belief_keys)
    broken["belief", "mean"].sum().backward()
    assert leaf.grad.isfinite().all()


@every_filter
def test_a_step_without_a_reading_is_the_forecast(float64, name):
    filter, frames = with_noise(name, 3, 2)
    row = frames[:, 1].copy().update(filter.initialise(frames[:, 0].copy()).select(*filter.carry_keys))
    hidden = filter.step(row.copy().set("observed", torch.zeros(3, 1, dtype=torch.bool)))
    out = filter.predict(row.exclude("observation", "observed"))
    assert_equal(out, hidden, filter.belief_keys, atol=1e-12)
    assert out.get("observation", None) is None
    with pytest.raises(KeyError, match="'observation'"):
        filter.step(row.exclude("observation"))


@every_filter
def test_unobserved_doubt_grows_and_a_reading_shrinks_it(float64, name):
    filter = FILTERS[name]()
    torch.manual_seed(1)
    frames = TensorDict({"observation": torch.zeros(200, 6, 2)}, [200, 6])
    frames["observed"] = torch.tensor([True] * 3 + [False] * 2 + [True]).reshape(1, 6, 1).expand(200, 6, 1)
    spread = filter.sequence(frames)["belief", "var"].sum(-1).mean(0)
    if name == "LSTM":  # that it must learn
        return
    if name.startswith(("DEnKF etkf", "DEnKF significance")):  # without process noise its members come together
        assert spread[5] < spread[4]
        return
    assert spread[2] < spread[3] < spread[4] > spread[5]


@every_filter
def test_copies_compute_the_same(name):
    filter, frames = with_noise(name, 2, 4)
    expected = filter.sequence(frames.copy())
    for copy in (pickle.loads(pickle.dumps(filter)), deepcopy(filter)):
        assert_equal(copy.sequence(frames.copy()), expected, filter.belief_keys)


@every_filter
def test_a_batch_of_no_rows_stays_one(name):
    filter, frames = with_noise(name, 0, 4)
    out = filter.sequence(frames.copy())
    assert out["belief", "mean"].shape == (0, 4, 2)
    assert filter.step(frames[:, 1].update(out[:, 0].select(*filter.carry_keys)))["belief", "mean"].shape == (0, 2)


@every_filter
def test_seeds_decide_and_nothing_is_kept_between_rollouts(name):
    env = filtered(name, batch_size=[2], max_steps=5)
    rollouts = []
    for _ in range(2):
        env.set_seed(3)
        torch.manual_seed(3)
        rollouts.append(env.rollout(8, break_when_any_done=False))
    assert_equal(*rollouts, FILTERS[name]().belief_keys)


@every_filter
def test_the_primer_carries_the_belief_of_a_policy(float64, name):
    filter = FILTERS[name]()
    torch.manual_seed(0)
    env = TransformedEnv(base_env(seed=0, batch_size=[2], max_steps=4), InitTracker())
    env.append_transform(filter.make_tensordict_primer())
    zeros = torch.zeros(env.action_spec.shape)
    policy = TensorDictSequential(filter, TensorDictModule(lambda mean: zeros, [("belief", "mean")], ["action"]))
    rollout = env.rollout(6, policy=policy, break_when_any_done=False)
    if FILTERS_WITHOUT_NOISE.isdisjoint({name}):
        assert rollout["belief", "mean"].isfinite().all()
        return
    frames = rollout.select("observation", "observed", "is_init", "action")
    assert rollout["is_init"].sum() == 4, "each row starts again once"
    assert_equal(filter.sequence(frames), rollout, filter.belief_keys, atol=1e-10)
    resumed = filter.sequence(rollout[:, 2:].exclude("belief"))
    assert_equal(resumed, rollout[:, 2:], filter.belief_keys, atol=1e-10)
