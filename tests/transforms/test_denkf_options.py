"""The transform's options: what is stored, gradients, priors and masks given to resets, diagnostics, buffers."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import (
    ClipTransform,
    Compose,
    DoubleToFloat,
    ObservationNorm,
    RenameTransform,
    SerialEnv,
    TransformedEnv,
    UnsqueezeTransform,
    VecNormV2,
    check_env_specs,
)

from tests.filters.factories import assert_equal, linear_kalman, linear_system
from tests.transforms import envs_for_tests as envs
from torch_denkf.envs import LinearGaussianEnv
from torch_denkf.transforms import DEnKFTransform


@pytest.mark.parametrize("no_grad", [True, False])
def test_gradients_through_a_rollout(no_grad):
    filter = envs.toy_filter()
    env = TransformedEnv(envs.toy_base_env(batch_size=[3]), DEnKFTransform(filter, no_grad=no_grad))
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


class SettableEnv(LinearGaussianEnv):
    """Begins in a given state where it is asked to, as torchrl's own pendulum does."""

    _supports_set_state = True

    def _reset(self, tensordict=None, *, set_state=False, **kwargs):
        out = super()._reset(tensordict)
        return tensordict.copy().update(self._emit(tensordict["state"], out["step"])) if set_state else out


def settable_env():
    F, Q, H, R = linear_system()
    env = SettableEnv(F, H, Q.diagonal().sqrt(), R.sqrt(), batch_size=[3])
    return TransformedEnv(env, DEnKFTransform(envs.known_start_filter()))


@pytest.mark.parametrize("set_state", [False, True])
@pytest.mark.parametrize("workers", [None, 2])
def test_prior_given_to_reset_whether_or_not_the_state_is_set(float64, set_state, workers):
    env = settable_env() if workers is None else SerialEnv(workers, settable_env)
    entries = {("belief", "ensemble"): torch.randn(*env.batch_size, 6, 2), "state": torch.randn(*env.batch_size, 2)}
    td = env.reset(TensorDict(entries, env.batch_size), set_state=set_state)
    assert td["belief", "ensemble"].equal(entries["belief", "ensemble"])
    for name, moment in (("mean", torch.mean), ("var", torch.var)):
        torch.testing.assert_close(td["belief", name], moment(entries["belief", "ensemble"], -2), rtol=0, atol=1e-15)
    assert td["state"].equal(entries["state"]) == set_state
    # A row that resets alone has the filter's own prior, and its neighbours keep what they were given.
    mask = torch.zeros(*env.batch_size, 1, dtype=torch.bool)
    mask.view(-1)[1] = True
    td = env.reset(td.set("_reset", mask), set_state=set_state)
    expected = entries["belief", "ensemble"].clone()
    expected.view(-1, 6, 2)[1] = torch.tensor(envs.PRIOR_MEAN)
    assert td["belief", "ensemble"].equal(expected)


@pytest.mark.parametrize("shape", [(3,), (3, 1)])
def test_reset_mask_of_the_transform_alone(float64, shape):
    # An environment merges the rows once more; the transform does not rely on it.
    given = torch.randn(3, 6, 2)
    mask = torch.tensor([False, True, False]).reshape(shape)
    td = TensorDict({("belief", "ensemble"): given, "_reset": mask}, [3])
    observed = TensorDict({"observation": torch.zeros(3, 2)}, [3])
    transform = DEnKFTransform(envs.known_start_filter())
    out = transform._reset(td, observed.copy())
    expected = given.clone()
    expected[1] = torch.tensor(envs.PRIOR_MEAN)
    # Environments that reset by themselves hand over one tensordict for both.
    both = td.copy().update(observed)
    assert transform._reset_on_native_autoreset(both, both)["belief", "ensemble"].equal(expected)
    assert out["belief", "ensemble"].equal(expected)
    torch.testing.assert_close(out["belief", "mean"], expected.mean(-2), rtol=0, atol=1e-15)
    torch.testing.assert_close(out["belief", "var"], expected.var(-2), rtol=0, atol=1e-15)


@pytest.mark.parametrize("resetting", [[], ["one"], ["two"], ["one", "two"]])
def test_belief_is_reset_with_any_group(float64, resetting):
    done = ["done", "terminated", "truncated"]
    groups = [RenameTransform(done, [(name, key) for key in done], create_copy=True) for name in ("one", "two")]
    env = TransformedEnv(envs.base_env(batch_size=[3]), Compose(*groups, DEnKFTransform(envs.known_start_filter())))
    given, masks = torch.randn(3, 6, 2), {"one": [0, 1, 0], "two": [0, 0, 1]}
    td = TensorDict({("belief", "ensemble"): given}, [3])
    for name, mask in masks.items():
        td[name, "_reset"] = torch.tensor(mask if name in resetting else [0, 0, 0]).bool().unsqueeze(-1)
    assert {("one", "_reset"), ("two", "_reset")} <= set(env.reset_keys)
    out = env.transform[-1]._reset(td, TensorDict({"observation": torch.zeros(3, 2)}, [3]))
    expected = given.clone()
    for name in resetting:
        expected[masks[name].index(1)] = torch.tensor(envs.PRIOR_MEAN)
    assert out["belief", "ensemble"].equal(expected)


@pytest.mark.parametrize("update_at_reset", [False, True])
def test_diagnostics(float64, update_at_reset):
    keys = [("info", "nis"), ("info", "innovation"), ("forecast", "ensemble")]
    filter = envs.fixed_filter(update_at_reset=update_at_reset)
    env = TransformedEnv(envs.base_env(batch_size=[3]), DEnKFTransform(filter, diagnostics=keys))
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


# ----------------------------------------------------------------------------------- transforms that come behind it

MEAN, NORM = ("belief", "mean"), {"loc": 0.0, "scale": 10.0}


def env_with(filter, *behind, **options):
    env = TransformedEnv(envs.base_env(batch_size=[3]), DEnKFTransform(filter, **options))
    for transform in behind:
        env.append_transform(transform)
    env.set_seed(0)
    torch.manual_seed(0)
    return env


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: ObservationNorm(in_keys=[MEAN], **NORM), MEAN),
        (lambda: ClipTransform(in_keys=[MEAN], low=-0.01, high=0.01), MEAN),
        (lambda: VecNormV2(in_keys=["observation", ("belief", "cov")]), ("belief", "cov")),
        (lambda: Compose(DoubleToFloat(), UnsqueezeTransform(dim=-1, in_keys=[MEAN])), MEAN),
        (lambda: RenameTransform(["observation"], [MEAN]), MEAN),
    ],
)
def test_a_transform_that_writes_over_the_carry_is_named(float64, make, key):
    env = env_with(linear_kalman(), make())
    with pytest.raises(
        ValueError, match=r"(ObservationNorm|Clip|VecNorm|Unsqueeze|Rename).* writes over .*out_keys="
    ) as e:
        env.rollout(2)
    assert repr(key) in str(e.value)


@pytest.mark.parametrize("given", ["mean", "cov"])
def test_a_part_of_a_belief_given_to_reset_raises(float64, given):
    env = env_with(linear_kalman())
    start = env.reset()
    lacking = ({"mean", "cov"} - {given}).pop()
    with pytest.raises(KeyError, match=rf"reads \('belief', '{lacking}'\), which is missing.*a complete belief"):
        env.reset(start.select(("belief", given)))
    assert env.reset(start.set(MEAN, start[MEAN] + 1))[MEAN].equal(start[MEAN])
