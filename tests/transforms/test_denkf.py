"""The ten points of the check-list for a drop-in part, and the transform's own options.

``kind`` names how the transform is combined with an environment: on a batch-locked environment of batch size [] or
[3], inside or outside of a ``SerialEnv`` or ``ParallelEnv`` of two.
"""

import pickle
from copy import deepcopy
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Binary, LazyTensorStorage, ReplayBuffer, SliceSampler
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    InitTracker,
    ParallelEnv,
    RenameTransform,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
    check_env_specs,
)

from tests.filters.factories import FixedEnsemble, NoisyLinear, linear_denkf, linear_kalman, linear_system
from tests.transforms.envs_for_tests import (
    PRIOR_MEAN,
    base_env,
    filtered_env,
    fixed_filter,
    known_start_filter,
    random_filter,
    toy_base_env,
    toy_filter,
)
from torch_denkf.filters import DEnKF
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, GaussianPrior, LinearObservation
from torch_denkf.objectives import DEnKFLoss
from torch_denkf.transforms import DEnKFTransform, MissingFrames

BELIEF = [("belief", "ensemble"), ("belief", "mean"), ("belief", "var")]
STEPS = [3, 5]  # episode lengths of the two (or first two) rows


def seeded_env(seed, **kwargs):
    return base_env(seed=seed, **kwargs)


def make_env(kind, make_filter=known_start_filter):
    if kind == "[]":
        return filtered_env(make_filter, max_steps=STEPS[0])
    if kind == "[3]":
        return filtered_env(make_filter, batch_size=[3], max_steps=[*STEPS, 30])
    batched = SerialEnv if "serial" in kind else ParallelEnv
    if "inside" in kind:
        return batched(2, [partial(filtered_env, make_filter, max_steps=n, seed=n) for n in STEPS])
    plain = batched(2, [partial(seeded_env, n, max_steps=n) for n in STEPS])
    return TransformedEnv(plain, DEnKFTransform(make_filter()))


KINDS = ["[]", "[3]", "serial inside", "serial outside", "parallel inside", "parallel outside"]


@pytest.fixture(scope="module", params=KINDS)
def env(request):
    env = make_env(request.param)
    env.first = env.reset()  # before anything was seeded
    yield env
    env.close()


def assert_equal(first, second, keys, *, atol=0.0):
    for key in keys:
        torch.testing.assert_close(first[key], second[key], rtol=0, atol=atol, msg=lambda m, k=key: f"{k}: {m}")


def random_rollout(env, steps=12):
    return env.rollout(steps, break_when_any_done=False)


# ------------------------------------------------------------------------------------------------- the check-list


def test_point_01_specs(env):
    check_env_specs(env)
    shape = (*env.batch_size, 6, 2)
    for spec in (env.full_observation_spec, env.full_state_spec):
        assert spec["belief", "ensemble"].shape == shape
    assert ("belief", "mean") in env.full_observation_spec.keys(True, True)


def test_point_02_partial_resets(env):
    prior = torch.tensor(PRIOR_MEAN)
    rollout = random_rollout(env)
    if not env.batch_size:
        rollout = rollout.unsqueeze(0)
    ensemble, next_ensemble = rollout["belief", "ensemble"], rollout["next", "belief", "ensemble"]
    done = rollout["next", "done"].squeeze(-1)
    # 12 steps of episodes of 3 and 5: resets after steps 3, 6, 9 (12) and 5, 10.
    for row, length in enumerate(STEPS[: len(rollout)]):
        assert (done[row].nonzero().flatten() + 1).tolist() == list(range(length, 13, length))
    assert (ensemble[:, 0] == prior).all()
    after = done[:, :-1]
    assert (ensemble[:, 1:][after] == prior).all(), "rows that reset get the prior"
    assert ensemble[:, 1:][~after].equal(next_ensemble[:, :-1][~after]), "other rows keep their belief"
    # It is not the prior that they keep: two steps on, every member has moved.
    assert (next_ensemble[:, 1:][~after] != prior).all()
    assert_equal(
        rollout["next", "belief"].exclude("ensemble"),
        {"mean": next_ensemble.mean(-2), "var": next_ensemble.var(-2)},
        ["mean", "var"],
        atol=1e-6,
    )


@pytest.mark.parametrize("update_at_reset", [False, True])
@pytest.mark.parametrize("kind", ["[]", "[3]", "serial outside"])
def test_point_03_steps_equal_the_sequence(kind, update_at_reset):
    env = make_env(kind, partial(fixed_filter, update_at_reset=update_at_reset))
    env = TransformedEnv(env, InitTracker())
    rollout = random_rollout(env)
    assert rollout["is_init"].sum() > rollout.shape[:-1].numel(), "resets in mid-sequence"
    frames = rollout.select("observation", "observed", "is_init", "action")
    transform = next(part for part in env.transform if isinstance(part, DEnKFTransform))
    # As a replay buffer would: from the initial belief, and from the belief that is stored.
    # float32 arithmetic in another order; the filter contracts the differences.
    assert_equal(transform(frames), rollout, BELIEF, atol=1e-5)
    assert_equal(transform(rollout[..., 2:].copy()), rollout[..., 2:], BELIEF, atol=1e-5)
    assert frames["forecast", "ensemble"].shape == frames["belief", "ensemble"].shape


def test_point_04_collector_replay_buffer_loss_gradients():
    filter = toy_filter()
    env = TransformedEnv(
        toy_base_env(batch_size=[3], max_steps=[7, 9, 50], missing=0.2),
        Compose(InitTracker(), DEnKFTransform(filter)),
    )
    policy = TensorDictModule(nn.Linear(3, 2), in_keys=[("belief", "mean")], out_keys=["action"])
    collector = Collector(env, policy, frames_per_batch=90, total_frames=180)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(300),
        sampler=SliceSampler(slice_len=6, end_key=("next", "done"), strict_length=True),
        batch_size=48,
    )
    for data in collector:
        assert data["belief", "mean"].isfinite().all()
        buffer.extend(data.reshape(-1))
    collector.shutdown()
    batch = buffer.sample()
    batch["is_init"] = batch["is_init"].clone()
    batch["is_init"].view(8, 6, 1)[:, 0] = True
    loss = DEnKFLoss(filter)
    loss.set_keys(target_observation="truth")
    batch["truth"] = batch["state"][..., :2]
    losses = loss(batch)
    sum(losses.values()).backward()
    for name in ("transition", "sensor", "observation", "noise"):
        grads = [parameter.grad for parameter in filter[name].parameters() if parameter.grad is not None]
        assert grads, name
        assert all(grad.isfinite().all() for grad in grads), name
        assert any((grad != 0).any() for grad in grads), name


@pytest.mark.parametrize("copy", [lambda t: pickle.loads(pickle.dumps(t)), deepcopy, lambda t: t.clone()])
def test_point_05_copies_compute_the_same(copy):
    transform = DEnKFTransform(toy_filter())
    rollouts = []
    for part in (transform, copy(transform)):
        torch.manual_seed(1)
        rollouts.append(random_rollout(TransformedEnv(toy_base_env(batch_size=[3], max_steps=5), part)))
    assert_equal(*rollouts, BELIEF)


def test_point_05_state_dict():
    first, second = (DEnKFTransform(toy_filter()) for _ in range(2))
    env, other = (TransformedEnv(toy_base_env(batch_size=[3]), part) for part in (first, second))

    def run(env):
        torch.manual_seed(1)
        env.set_seed(1)
        return random_rollout(env)

    assert not run(env)["next", "belief", "mean"].equal(run(other)["next", "belief", "mean"])
    second.load_state_dict(first.state_dict())
    assert_equal(run(env), run(other), BELIEF)
    assert set(first.state_dict()) == {f"filter.{name}" for name in first.filter.state_dict()}


def test_point_05_float64(float64):
    rollout = random_rollout(filtered_env(random_filter, batch_size=[3]))
    assert {rollout["next", key].dtype for key in (("belief", "ensemble"), ("belief", "var"))} == {torch.float64}
    check_env_specs(filtered_env(random_filter, batch_size=[3]))


def test_point_06_kalman_filter_in_the_transform(float64):
    kf = linear_kalman()
    env = filtered_env(lambda: kf, batch_size=[3], max_steps=[4, 7, 50], missing=0.2)
    check_env_specs(env)
    rollout = random_rollout(TransformedEnv(env, InitTracker()))
    expected = kf.sequence(rollout.select("observation", "observed", "is_init"))
    assert_equal(rollout, expected, [("belief", "mean"), ("belief", "cov"), ("belief", "var")], atol=1e-13)


def test_point_06_a_large_ensemble_follows_the_kalman_filter(float64):
    size, rollouts = 20_000, []
    kf = linear_kalman()
    env = TransformedEnv(base_env(batch_size=[3]), DEnKFTransform(linear_kalman()))
    rollouts.append(env.rollout(20))
    prior_std = kf.initial.cov.diagonal().sqrt()
    prior = GaussianPrior(kf.initial.mean, prior_std, ensemble_size=size)
    denkf = linear_denkf("etkf", noisy=True, initial=prior, ensemble_size=size)
    rollouts.append(TransformedEnv(base_env(batch_size=[3]), DEnKFTransform(denkf)).rollout(20))
    exact, ours = (rollout["next", "belief"] for rollout in rollouts)
    # An iid sample has 1 / sqrt(E) = 0.7 % of a standard deviation; 5 of those, and a factor 2 for what accumulates.
    assert ((ours["mean"] - exact["mean"]) / exact["var"].sqrt()).abs().max() < 10 / size**0.5
    assert (ours["var"] / exact["var"] - 1).abs().max() < 10 * (2 / size) ** 0.5


def test_point_07_nothing_observed_is_pure_prediction(float64):
    env = filtered_env(fixed_filter, batch_size=[3], missing=1.0)
    rollout = env.rollout(5)
    assert rollout["observation"].isnan().all()
    F = linear_system()[0]
    assert_equal(
        {"belief": rollout["next", "belief", "ensemble"]},
        {"belief": rollout["belief", "ensemble"] @ F.mT},
        ["belief"],
        atol=1e-14,
    )
    assert not rollout["belief", "mean"][:, 0].equal(rollout["belief", "mean"][:, 4])


class MaskColumns(Transform):
    """Only the first reading is observed; the others are NaN."""

    def _call(self, next_tensordict):
        reading = next_tensordict["observation"]
        observed = torch.zeros_like(reading, dtype=torch.bool)
        observed[..., 0] = True
        next_tensordict["observation"] = torch.where(observed, reading, torch.nan)
        return next_tensordict.set("both_observed", observed)

    _reset = lambda self, tensordict, tensordict_reset: self._call(tensordict_reset)  # noqa: E731

    def transform_observation_spec(self, observation_spec):
        shape = observation_spec["observation"].shape
        observation_spec["both_observed"] = Binary(shape=shape, dtype=torch.bool)
        return observation_spec


def test_point_07_partial_mask_is_the_filter_of_the_rest(float64):
    F, _, H, R = linear_system()
    start = FixedEnsemble(torch.randn(6, 2))

    def make(rows, **kwargs):
        analysis = EnsembleAnalysis("etkf", sensor_key="observation", **kwargs)
        noise = ConstantNoise(R[rows].sqrt(), in_key="observation")
        return DEnKF(NoisyLinear(F), None, LinearObservation(H[rows]), noise, analysis, initial=start)

    masked = TransformedEnv(base_env(batch_size=[3]))
    masked.append_transform(MaskColumns())
    masked.append_transform(DEnKFTransform(make([0, 1], observed_key="both_observed")))
    both = masked.rollout(8)
    filter = make([0])
    single = filter.sequence(TensorDict({"observation": both["observation"][..., :1]}, [3, 8]))
    assert_equal(both, single, BELIEF, atol=1e-12)


def test_point_08_same_seed_same_rollout(env):
    def run(seed):
        torch.manual_seed(seed)  # of the filter, where it runs in this process
        env.set_seed(seed)
        return random_rollout(env, 6)

    first, again, other = run(1), run(1), run(2)
    assert_equal(first, again, [*BELIEF, "observation", "action"])
    assert not first["next", "belief", "mean"].equal(other["next", "belief", "mean"])


@pytest.mark.parametrize("kind", ["[3]", "serial inside", "serial outside", "parallel inside", "parallel outside"])
def test_point_08_rows_and_workers_differ(kind):
    env = make_env(kind, random_filter)
    try:
        unseeded = env.reset()["belief", "ensemble"]
        assert not unseeded[0].equal(unseeded[1]), "also where nothing was seeded"
        env.set_seed(0)
        seeded = env.reset()["belief", "ensemble"]
        assert not seeded[0].equal(seeded[1])
        assert not seeded.equal(unseeded)
        rollout = random_rollout(env, 4)
        noise = rollout["next", "belief", "ensemble"] - rollout["next", "belief", "mean"].unsqueeze(-2)
        assert not noise[0].allclose(noise[1])
    finally:
        env.close()


def test_point_09_nothing_on_self():
    transform = DEnKFTransform(random_filter())
    env = TransformedEnv(base_env(batch_size=[3]), transform)
    before = {name: value for name, value in vars(transform).items() if name not in ("_modules", "_parent")}
    snapshot = pickle.dumps({k: v for k, v in before.items() if not callable(v)})
    check_env_specs(env)
    random_rollout(env)
    for value in vars(transform).values():
        assert not isinstance(value, (torch.Tensor, TensorDict))
    after = {name: vars(transform)[name] for name in before}
    assert pickle.dumps({k: v for k, v in after.items() if not callable(v)}) == snapshot
    # Two environments on clones of one transform do not touch each other.
    other = TransformedEnv(base_env(batch_size=[2]), transform.clone())
    assert other.rollout(3).shape == (2, 3)
    assert env.rollout(3).shape == (3, 3)


def test_point_09_spec_cache_is_cleared_on_append():
    env = TransformedEnv(base_env(batch_size=[3]))
    assert "belief" not in env.full_observation_spec
    assert "belief" not in env.full_state_spec
    env.append_transform(DEnKFTransform(known_start_filter()))
    for spec in (env.full_observation_spec, env.full_state_spec):
        assert ("belief", "ensemble") in spec.keys(True, True)
    check_env_specs(env)
    env.append_transform(StepCounter())
    check_env_specs(env)


# --------------------------------------------------------------------------------------------------- missing frames


class BreakObservation(Transform):
    """NaN in the reading from the third step on; ``observed`` says so, or lies."""

    def __init__(self, honest):
        super().__init__()
        self.honest = honest

    def _call(self, next_tensordict):
        bad = next_tensordict["step"] >= 3
        next_tensordict["observation"] = torch.where(bad, torch.nan, next_tensordict["observation"])
        next_tensordict["observed"] = ~bad if self.honest else torch.ones_like(bad)
        return next_tensordict

    _reset = lambda self, tensordict, tensordict_reset: self._call(tensordict_reset)  # noqa: E731


class ZeroUnobserved(Transform):
    def _call(self, next_tensordict):
        reading = next_tensordict["observation"]
        next_tensordict["observation"] = torch.where(next_tensordict["observed"], reading, 0.0)
        return next_tensordict

    _reset = lambda self, tensordict, tensordict_reset: self._call(tensordict_reset)  # noqa: E731


@pytest.mark.parametrize(("make_base", "make_filter"), [(base_env, random_filter), (toy_base_env, toy_filter)])
def test_unobserved_nan_changes_nothing(make_base, make_filter):
    filter, rollouts = make_filter(), []
    for transforms in ([BreakObservation(True)], [BreakObservation(True), ZeroUnobserved()]):
        env = TransformedEnv(make_base(batch_size=[3]), Compose(*transforms, DEnKFTransform(filter)))
        torch.manual_seed(1)
        rollouts.append(env.rollout(8))
    assert rollouts[0]["observation"].isnan().any()
    assert not rollouts[1]["observation"].isnan().any()
    assert rollouts[0]["belief", "mean"].isfinite().all()
    assert_equal(rollouts[0]["next"], rollouts[1]["next"], BELIEF)


@pytest.mark.parametrize(("make_base", "make_filter"), [(base_env, random_filter), (toy_base_env, toy_filter)])
def test_observed_nan_raises_and_names_the_key(make_base, make_filter):
    def make(**kwargs):
        transforms = Compose(BreakObservation(False), DEnKFTransform(make_filter(), **kwargs))
        return TransformedEnv(make_base(batch_size=[3]), transforms)

    assert make().rollout(2).shape == (3, 2)
    with pytest.raises(ValueError, match=r"NaN or infinity in \['observation'\].*'observed'"):
        make().rollout(8)
    assert make(check_finite=False).rollout(8)["next", "belief", "mean"].isnan().any()


def test_nan_at_reset_with_an_update_there():
    env = TransformedEnv(base_env(), Compose(NanAtReset(), DEnKFTransform(fixed_filter(update_at_reset=True))))
    with pytest.raises(ValueError, match=r"NaN or infinity in \['observation'\]"):
        env.reset()


class NanAtReset(Transform):
    def _call(self, next_tensordict):
        return next_tensordict

    def _reset(self, tensordict, tensordict_reset):
        return tensordict_reset.set("observation", torch.full_like(tensordict_reset["observation"], torch.nan))


def test_divergence_is_told_apart():
    filter = linear_denkf()
    filter["transition"].matrix.mul_(1e30)
    with pytest.raises(ValueError, match="the filter diverged"):
        TransformedEnv(base_env(), DEnKFTransform(filter)).rollout(5)


def test_missing_frames_before_the_filter():
    env = TransformedEnv(
        base_env(batch_size=[3]), Compose(MissingFrames(0.5, in_keys=["observation"]), DEnKFTransform(random_filter()))
    )
    check_env_specs(env)
    rollout = env.rollout(20)
    seen = rollout["observed"].squeeze(-1)
    assert seen.any()
    assert (rollout["observation"][~seen] == 0).all()
    assert not seen.all()


# ------------------------------------------------------------------------------------------------------ errors


def test_missing_key_names_key_and_environment():
    filter = linear_kalman(observation_key="gps")
    with pytest.raises(KeyError, match=r"'gps'.*LinearGaussianEnv"):
        TransformedEnv(base_env(), DEnKFTransform(filter)).reset()
    with pytest.raises(KeyError, match=r"'gps'.*LinearGaussianEnv"):
        _ = TransformedEnv(base_env(), DEnKFTransform(filter)).observation_spec


def test_lost_belief_is_an_error():
    env = filtered_env()
    td = env.rand_action(env.reset()).exclude("belief")
    with pytest.raises(KeyError, match=r"carries the belief in \('belief', 'ensemble'\)"):
        env.step(td)


def test_float64_environment_and_float32_filter():
    torch.set_default_dtype(torch.float64)
    try:
        base = base_env()
    finally:
        torch.set_default_dtype(torch.float32)
    with pytest.raises(TypeError, match="DoubleToFloat"):
        _ = TransformedEnv(base, DEnKFTransform(linear_denkf())).observation_spec
    mended = TransformedEnv(
        base,
        Compose(DoubleToFloat(in_keys=["observation"], in_keys_inv=["action"]), DEnKFTransform(linear_denkf())),
    )
    assert mended.rollout(3)["next", "belief", "mean"].dtype == torch.float32


def test_constructor_errors():
    with pytest.raises(TypeError, match="together with its initial belief"):
        DEnKFTransform(TensorDictSequential(*fixed_filter()))
    with pytest.raises(TypeError, match="Linear"):
        DEnKFTransform(nn.Linear(1, 1))
    with pytest.raises(TypeError, match="has its initial belief already"):
        DEnKFTransform(fixed_filter(), initial=fixed_filter().initial)
    with pytest.raises(KeyError, match="'info', 'gain'"):
        DEnKFTransform(fixed_filter(), diagnostics=[("info", "gain")])


# ----------------------------------------------------------------------------------------------------- options


def test_plain_sequential_with_its_initial_belief():
    filter = fixed_filter()
    plain = TensorDictSequential(*filter)
    rollouts = [
        random_rollout(TransformedEnv(base_env(batch_size=[3], max_steps=[3, 5, 9]), transform))
        for transform in (DEnKFTransform(filter), DEnKFTransform(plain, initial=filter.initial))
    ]
    assert_equal(rollouts[0]["next"], rollouts[1]["next"], BELIEF)


def test_store_ensemble_false_holds_the_same_numbers():
    rollouts = []
    for store in (True, False):
        env = filtered_env(random_filter, transform={"store_ensemble": store}, batch_size=[3], max_steps=[3, 5, 30])
        check_env_specs(env)
        torch.manual_seed(1)
        env.set_seed(1)
        rollouts.append(random_rollout(env))
    full, small = rollouts
    assert ("belief", "ensemble") in full.keys(True, True)
    for part in (small, small["next"]):
        assert set(part["belief"].keys()) == {"mean", "var"}
    for key in (("belief", "mean"), ("belief", "var")):
        assert full[key].equal(small[key])
        assert full["next"][key].equal(small["next"][key])


def test_store_ensemble_false_outside_of_a_batched_environment():
    plain = SerialEnv(2, [partial(seeded_env, n, max_steps=n) for n in STEPS])
    env = TransformedEnv(plain, DEnKFTransform(known_start_filter(), store_ensemble=False))
    check_env_specs(env)
    rollout = random_rollout(env)
    assert set(rollout["next", "belief"].keys()) == {"mean", "var"}
    assert (rollout["belief", "mean"][0, [0, 3, 6, 9]] == torch.tensor(PRIOR_MEAN)).all()
    assert (rollout["belief", "mean"][0, [1, 2, 4, 5]] != torch.tensor(PRIOR_MEAN)).all()


@pytest.mark.parametrize("use_buffers", [False, True])
def test_store_ensemble_false_in_a_collector(use_buffers):
    def collect(store):
        torch.manual_seed(1)
        env = filtered_env(random_filter, transform={"store_ensemble": store}, batch_size=[2], max_steps=[3, 5])
        collector = Collector(env, None, frames_per_batch=16, total_frames=32, use_buffers=use_buffers)
        data = [batch.clone() for batch in collector]
        collector.shutdown()
        return torch.cat(data, -1)

    full, small = collect(True), collect(False)
    # A collector's buffers hold what env.reset() gives: an ensemble there would be data, of zeros.
    assert set(small["belief"].keys()) == set(small["next", "belief"].keys()) == {"mean", "var"}
    assert small["next", "belief", "mean"].equal(full["next", "belief", "mean"])
    assert small["belief", "mean"].equal(full["belief", "mean"])


def test_store_ensemble_false_inside_of_workers_raises():
    make = partial(filtered_env, transform={"store_ensemble": False})
    with pytest.raises(RuntimeError, match="cannot live inside a SerialEnv or ParallelEnv"):
        SerialEnv(2, make).reset()


@pytest.mark.parametrize("no_grad", [True, False])
def test_gradients_through_a_rollout(no_grad):
    filter = toy_filter()
    env = TransformedEnv(toy_base_env(batch_size=[3]), DEnKFTransform(filter, no_grad=no_grad))
    td, beliefs = env.reset(), []
    for _ in range(4):
        td = env.step(env.rand_action(td))["next"]
        beliefs.append(td["belief", "mean"])
    assert [belief.requires_grad for belief in beliefs] == [not no_grad] * 4
    if not no_grad:
        beliefs[-1].square().sum().backward()
        for name in ("transition", "sensor", "observation", "noise"):
            assert any(p.grad is not None and (p.grad != 0).any() for p in filter[name].parameters()), name
        assert all(p.grad is None or p.grad.isfinite().all() for p in filter.parameters())


def test_prior_given_to_reset(float64):
    env = filtered_env(known_start_filter, batch_size=[3])
    given = torch.randn(3, 6, 2)
    td = env.reset(TensorDict({("belief", "ensemble"): given}, [3]))
    assert td["belief", "ensemble"].equal(given)
    torch.testing.assert_close(td["belief", "mean"], given.mean(-2), rtol=0, atol=1e-15)
    torch.testing.assert_close(td["belief", "var"], given.var(-2), rtol=0, atol=1e-15)


def test_reset_of_some_rows_leaves_the_others(float64):
    env = filtered_env(known_start_filter, batch_size=[3])
    td = env.rollout(3)[:, -1]["next"].clone()
    before = td["belief"].clone()
    td["_reset"] = torch.tensor([[False], [True], [False]])
    after = env.reset(td)["belief"]
    assert (after["ensemble"][1] == torch.tensor(PRIOR_MEAN)).all()
    assert after["ensemble"][[0, 2]].equal(before["ensemble"][[0, 2]])
    torch.testing.assert_close(after["mean"][[0, 2]], before["mean"][[0, 2]], rtol=0, atol=1e-15)
    assert (after["var"][1] == 0).all()


@pytest.mark.parametrize("shape", [(3,), (3, 1)])
def test_reset_mask_of_the_transform_alone(float64, shape):
    # An environment merges the rows once more; the transform does not rely on it.
    given = torch.randn(3, 6, 2)
    mask = torch.tensor([False, True, False]).reshape(shape)
    td = TensorDict({("belief", "ensemble"): given, "_reset": mask}, [3])
    observed = TensorDict({"observation": torch.zeros(3, 2)}, [3])
    transform = DEnKFTransform(known_start_filter())
    out = transform._reset(td, observed.copy())
    expected = given.clone()
    expected[1] = torch.tensor(PRIOR_MEAN)
    # Environments that reset by themselves hand over one tensordict for both.
    both = td.copy().update(observed)
    assert transform._reset_on_native_autoreset(both, both)["belief", "ensemble"].equal(expected)
    assert out["belief", "ensemble"].equal(expected)
    torch.testing.assert_close(out["belief", "mean"], expected.mean(-2), rtol=0, atol=1e-15)
    torch.testing.assert_close(out["belief", "var"], expected.var(-2), rtol=0, atol=1e-15)


def test_nested_reset_key(float64):
    # done and _reset inside of a group, as in multi-agent environments: the mask is agent-wise.
    env = TransformedEnv(
        base_env(batch_size=[3], max_steps=[3, 5, 30]),
        Compose(
            RenameTransform(
                in_keys=["done", "terminated", "truncated"],
                out_keys=[("group", "done"), ("group", "terminated"), ("group", "truncated")],
                create_copy=True,
            ),
            DEnKFTransform(known_start_filter()),
        ),
    )
    rollout = random_rollout(env)
    start = torch.cat([torch.ones(3, 1, dtype=torch.bool), rollout["next", "done"][:, :-1].squeeze(-1)], 1)
    ensemble = rollout["belief", "ensemble"]
    assert (ensemble[start] == torch.tensor(PRIOR_MEAN)).all()
    assert ensemble[:, 1:][~start[:, 1:]].equal(rollout["next", "belief", "ensemble"][:, :-1][~start[:, 1:]])


@pytest.mark.parametrize("update_at_reset", [False, True])
def test_diagnostics(float64, update_at_reset):
    keys = [("info", "nis"), ("info", "innovation"), ("forecast", "ensemble")]
    filter = fixed_filter(update_at_reset=update_at_reset)
    env = TransformedEnv(base_env(batch_size=[3]), DEnKFTransform(filter, diagnostics=keys))
    check_env_specs(env)
    rollout = env.rollout(6)
    expected = filter.sequence(rollout.select("observation", "observed"))
    assert_equal(rollout, expected, keys, atol=1e-12)
    assert (rollout["info", "nis"][:, 1:] > 0).all()
    start = filter.initialise(rollout[:, 0].select("observation", "observed"))
    assert_equal(rollout[:, 0], start, [("forecast", "ensemble")], atol=1e-12)
    if not update_at_reset:  # an initial belief has no innovation, and is its own forecast
        assert all((rollout[key][:, 0] == 0).all() for key in keys[:2])
        assert rollout["forecast", "ensemble"][:, 0].equal(rollout["belief", "ensemble"][:, 0])


def test_randomness_does_not_depend_on_the_mode():
    transform = DEnKFTransform(toy_filter())
    env, rollouts = TransformedEnv(toy_base_env(batch_size=[3]), transform), []
    assert not transform.training
    for mode in (True, False):
        transform.train(mode)
        torch.manual_seed(1)
        env.set_seed(1)
        rollouts.append(env.rollout(4))
    assert_equal(*rollouts, BELIEF)
    assert (rollouts[0]["next", "belief", "var"] > 0).all()


def test_specs_use_up_no_random_numbers():
    env = filtered_env(random_filter)
    state = torch.get_rng_state()
    _ = env.observation_spec, env.state_spec
    assert torch.get_rng_state().equal(state)


def test_gradient_mode_in_a_replay_buffer():
    filter = toy_filter()
    frames = TensorDict({"observation": torch.randn(2, 5, 4), "action": torch.randn(2, 5, 2)}, [2, 5])
    assert not DEnKFTransform(filter)(frames.copy())["belief", "mean"].requires_grad
    assert DEnKFTransform(filter, no_grad=False)(frames.copy())["belief", "mean"].requires_grad


def test_in_a_replay_buffer(float64):
    filter = fixed_filter()
    buffer = ReplayBuffer(storage=LazyTensorStorage(4), transform=DEnKFTransform(filter), batch_size=3)
    frames = TensorDict(
        {"observation": torch.randn(4, 7, 2), "number": torch.arange(4).unsqueeze(-1).expand(4, 7)}, [4, 7]
    )
    buffer.extend(frames)
    sample = buffer.sample()
    expected = filter.sequence(frames[sample["number"][:, 0]].clone())
    assert_equal(sample, expected, BELIEF, atol=1e-14)
