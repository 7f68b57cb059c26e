"""DEnKFTransform with a packaged step; oracle: the same transform without."""

from functools import partial

import pytest
import torch
from torchrl.envs import TransformedEnv

from tests.functional.checks import assert_raises
from tests.transforms.envs_for_tests import BELIEF, base_env, fixed_filter, random_filter, toy_base_env, toy_filter
from torch_denkf.deployment import export_step, load_step
from torch_denkf.transforms import DEnKFTransform


def one_step(env, filter, without=()):
    """Returns what a step of ``env`` gives the filter, as an example to export from."""
    filtered = TransformedEnv(env, DEnKFTransform(filter))
    start = filtered.rand_action(filtered.reset())
    example = filtered.step(start)["next"].select(*(key for key in ("observation", "observed") if key not in without))
    example.update(start.select("action", *filter.carry_keys, strict=False))
    return example


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    """Returns steps of a filter without randomness in a batch and of one with an action alone; not compiled: fast."""
    folder, out = tmp_path_factory.mktemp("packages"), {}
    plain_toy = partial(toy_filter, sensor_layer="none", layer="none")
    cases = {"[3]": (base_env, fixed_filter, [3]), "action": (toy_base_env, plain_toy, [])}
    for name, (make_env, make_filter, batch) in cases.items():
        torch.manual_seed(0)
        filter = make_filter()
        example = one_step(make_env(seed=0, batch_size=batch), filter)
        diagnostics = [("info", "nis")]
        path = export_step(filter, example, folder / f"{name}.pt2", out_keys=diagnostics, compiled=False)
        out[name] = filter, path, make_env, batch
    return out


def envs(packages, name, **options):
    """Makes the same environment with and without the package."""
    filter, path, make_env, batch = packages[name]
    length = [4, 6, 30] if batch else 4
    out = []
    for packaged in (None, load_step(path)):
        transform = DEnKFTransform(filter, packaged=packaged, diagnostics=[("info", "nis")], **options)
        out.append(TransformedEnv(make_env(seed=0, batch_size=batch, max_steps=length), transform))
        out[-1].set_seed(0)
    return out


@pytest.mark.parametrize("name", ["[3]", "action"])
@pytest.mark.parametrize("store_ensemble", [True, False])
def test_rollouts_over_resets_are_the_same(packages, name, store_ensemble):
    plain, packaged = envs(packages, name, store_ensemble=store_ensemble)
    rollouts = []
    for env in (plain, packaged):
        torch.manual_seed(1)
        rollouts.append(env.rollout(15, break_when_any_done=False))
    done = rollouts[0]["next", "done"].squeeze(-1)
    assert done[..., :-1].any()
    for key in [*(BELIEF if store_ensemble else BELIEF[1:]), ("info", "nis")]:
        torch.testing.assert_close(rollouts[1]["next", key], rollouts[0]["next", key], rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(rollouts[1][key], rollouts[0][key], rtol=1e-5, atol=1e-6)
    assert (("belief", "ensemble") in rollouts[1].keys(True)) == store_ensemble


def test_packaged_step_runs(packages):
    """And not the filter's own modules, of which the first raises."""

    def fail(*_):
        raise RuntimeError("it runs")

    filter, path, _, _ = packages["[3]"]
    plain, packaged = (packaged_env(filter, step, batch_size=[3]) for step in (None, load_step(path)))
    rows = [env.rand_action(env.reset()) for env in (plain, packaged)]
    hook = filter["transition"].register_forward_pre_hook(fail)
    assert packaged.step(rows[1])["next", "belief", "mean"].isfinite().all()
    assert_raises(RuntimeError, "it runs", plain.step, rows[0])
    hook.remove()


def packaged_env(filter, step, batch_size=(), **options):
    return TransformedEnv(base_env(seed=0, batch_size=batch_size), DEnKFTransform(filter, packaged=step, **options))


def test_mismatched_packages_raise(packages, tmp_path):
    filter, path, _, _ = packages["[3]"]
    step = load_step(path)
    with pytest.raises(KeyError, match="log_likelihood"):
        DEnKFTransform(filter, packaged=step, diagnostics=[("info", "log_likelihood")])
    assert_raises(ValueError, "records no graph", DEnKFTransform, filter, packaged=step, no_grad=False)
    alone, three = (packaged_env(filter, step, batch_size=batch) for batch in ([], [3]))
    words = r"must be torch.float32 \[3, 2\], got torch.float32 \[2\]"
    assert_raises(ValueError, words, alone.rollout, 2)
    start = three.rand_action(three.reset().exclude("belief"))
    assert_raises(KeyError, "carries the belief", three.step, start)

    blind = export_step(filter, one_step(base_env(seed=0), filter, ["observed"]), tmp_path / "a.pt2", compiled=False)
    env = packaged_env(filter, load_step(blind))
    assert_raises(ValueError, "emits 'observed', which the packaged step was exported without", env.rollout, 2)

    noisy = random_filter()
    example = noisy.draw_noise(one_step(base_env(seed=0), noisy))
    given = export_step(noisy, example, tmp_path / "b.pt2", compiled=False)
    assert_raises(KeyError, r"noise\.transition", DEnKFTransform, noisy, packaged=load_step(given))


@pytest.mark.parametrize("check", [True, False])
def test_nan_raises_unless_check_finite_is_off(packages, check):
    filter, path, _, _ = packages["[3]"]
    env = packaged_env(filter, load_step(path), batch_size=[3], check_finite=check)
    td = env.rand_action(env.reset())
    td["belief", "ensemble"][0, 0] = torch.nan
    if check:
        assert_raises(ValueError, "the filter diverged", env.step, td)
    else:
        assert env.step(td)["next", "belief", "mean"].isnan().any()
