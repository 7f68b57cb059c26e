"""The loop: one step and a sequence are the same; resets, stored beliefs, controls, masks, gradients."""

import pickle
import shutil
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.modules import set_recurrent_mode
from torchrl.modules.utils import get_env_transforms_from_module

from tests.filters.factories import (
    OBS,
    A,
    E,
    FixedEnsemble,
    M,
    NoisyLinear,
    S,
    linear_denkf,
    linear_kalman,
    linear_system,
    toy_denkf,
    toy_frames,
)
from torch_denkf.envs.linear import LinearGaussianEnv
from torch_denkf.filters import DEnKF, Filter
from torch_denkf.modules import (
    ConstantNoise,
    EnsembleAnalysis,
    FromSensor,
    GaussianPrior,
    ImageSensor,
    LinearObservation,
    Select,
    UnicycleMotion,
    UnicycleTransition,
)
from torch_denkf.transforms import DEnKFTransform

SCHEMES = ["sensor", "perturbed", "etkf", "sakov"]
BELIEF = [("belief", "ensemble"), ("belief", "mean"), ("belief", "var")]


def make_dyadic(module):
    """Rounds weights to multiples of 1/16, so that sums of their products with such numbers are exact.

    A frame module runs on [B, T] frames in a sequence and on [B] in a step, and a matrix product may sum in another
    order for another number of rows. Sums without rounding do not depend on the order.
    """
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_((parameter * 16).round() / 16)


def stepwise(filter, frames):
    """The same as ``filter.sequence(frames)``, by single steps as in an environment."""
    time = frames.ndim - 1
    rows, out = frames.unbind(time), []
    for t, row in enumerate(rows):
        row = row.copy()
        if row.get("action", None) is not None:
            row["action"] = rows[max(t - 1, 0)]["action"]
        carry = out[-1] if out else filter.initialise(row.copy())
        for key in filter.carry_keys:
            row[key] = carry[key]
        out.append(filter(row))
    return torch.stack([row.exclude("action", "next") for row in out], time)


def assert_equal(first, second, keys, *, atol=0.0):
    for key in keys:
        torch.testing.assert_close(first[key], second[key], rtol=0, atol=atol, msg=lambda m, k=key: f"{k}: {m}")


# ------------------------------------------------------------------------------------------ step equals sequence


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("layer", ["dropout", "flipout"])
@pytest.mark.parametrize("update_at_reset", [False, True])
@pytest.mark.parametrize(("batch", "masks"), [((3, 12), 1), ((3, 12), OBS), ((12,), 1), ((2, 2, 6), OBS)])
def test_step_equals_sequence_bit_for_bit(float64, scheme, layer, update_at_reset, batch, masks):
    filter = toy_denkf(scheme, layer, update_at_reset=update_at_reset)
    make_dyadic(filter["sensor"]), make_dyadic(filter["noise"])
    frames = toy_frames(batch, masks=masks)
    frames["measurement"] = (frames["measurement"] * 16).round() / 16
    assert frames["is_init"][..., 1:, :].any()
    assert len(batch) == 1 or not frames["is_init"][0].equal(frames["is_init"][1]), "rows differ"
    filter.draw_noise(frames)
    expected = {"sensor", "initial", "transition", *(["analysis"] if scheme == "perturbed" else [])}
    assert set(frames["noise"].keys()) == expected, "no noise is drawn on the way"
    steps, sequence = stepwise(filter, frames), filter.sequence(frames.copy())
    assert_equal(steps, sequence, map_keys(filter.out_keys))
    assert not sequence["belief", "mean"][..., 1, :].equal(sequence["belief", "mean"][..., 0, :])


def map_keys(keys):
    return list(dict.fromkeys(keys))


@pytest.mark.parametrize("layer", ["dropout", "flipout"])
def test_step_equals_sequence_with_images(float64, layer):
    filter = toy_denkf(layer=layer)
    filter = DEnKF(
        filter["transition"],
        ImageSensor(OBS, image_shape=(2, 9, 12), ensemble_size=E, num_cells=(8,), layer=layer),
        filter["observation"],
        filter["noise"],
        initial=filter.initial,
    )
    frames = toy_frames((2, 8)).set("pixels", torch.rand(2, 8, 2, 9, 12))
    filter.draw_noise(frames)
    # Convolutions round differently for different numbers of frames (1e-15), and the recursion may amplify it.
    assert_equal(stepwise(filter, frames), filter.sequence(frames.copy()), filter.out_keys, atol=1e-12)


def test_step_equals_sequence_from_the_sensor(float64):
    initial = FromSensor([0, 2], mean=[0.0, 1.0, 2.0], std=[1.0, 2.0, 3.0], ensemble_size=E)
    filter = toy_denkf(initial=initial, update_at_reset=True)
    frames = filter.draw_noise(toy_frames((3, 9)))
    assert_equal(stepwise(filter, frames), filter.sequence(frames.copy()), filter.out_keys, atol=1e-12)


def test_recurrent_mode_selects_the_sequence(float64):
    filter = toy_denkf()
    frames = filter.draw_noise(toy_frames((3, 5)))
    with set_recurrent_mode(True):
        out = filter(frames.copy())
    assert_equal(out, filter.sequence(frames.copy()), filter.out_keys)


def test_noise_that_is_given_is_kept_and_the_rest_drawn():
    filter = toy_denkf("perturbed")
    frames = toy_frames((3, 5))
    given = torch.ones(3, 5, E, 16, dtype=torch.bool)
    frames["noise", "transition"] = given
    filter.draw_noise(frames, generator=torch.Generator().manual_seed(3))
    assert frames["noise", "transition"] is given
    assert frames["noise", "analysis"].shape == (3, 5, E, OBS)
    again = filter.draw_noise(toy_frames((3, 5)), generator=torch.Generator().manual_seed(3))
    assert again["noise", "sensor"].equal(
        filter.draw_noise(toy_frames((3, 5)), generator=torch.Generator().manual_seed(3))["noise", "sensor"]
    )


def test_sequence_leaves_its_noise_out_of_the_result():
    frames = toy_frames((3, 5))
    assert toy_denkf().sequence(frames).get("noise", None) is None


def test_a_seed_repeats_a_sequence():
    filter, frames, out = toy_denkf("perturbed"), toy_frames((3, 5)), []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        out.append(filter.sequence(frames.copy())["belief", "mean"])
    assert out[0].equal(out[1])
    assert not out[0].equal(out[2])


# -------------------------------------------------------------------------------------------------- resets


def test_reset_rows_get_the_initial_belief_and_others_do_not(float64):
    members = torch.randn(E, S)
    filter = toy_denkf(initial=FixedEnsemble(members))
    frames = filter.draw_noise(toy_frames((3, 12)))
    out = filter.sequence(frames.copy())
    start = frames["is_init"].squeeze(-1)
    assert out["belief", "ensemble"][start].equal(members.expand(int(start.sum()), E, S))
    assert out["forecast", "ensemble"][start].equal(members.expand(int(start.sum()), E, S))
    assert (out["belief", "ensemble"][~start] != members).any(-1).any(-1).all()


def test_update_at_reset_is_the_analysis_of_the_initial_belief(float64):
    filter = linear_denkf(update_at_reset=True)
    td = TensorDict({"observation": torch.randn(3, 2)}, [3])
    out = filter.initialise(td.copy())
    row = filter.initial(td.copy())
    row["forecast", "ensemble"] = row["belief", "ensemble"]
    for name in ("noise", "observation", "analysis"):
        row = filter[name](row)
    assert_equal(out, row, BELIEF)
    assert_equal(filter.sequence(td.unsqueeze(1)).squeeze(1), row, BELIEF)
    plain = linear_denkf().initialise(td.copy())
    assert plain["belief", "ensemble"][0].equal(filter.initial.members)


def test_sequence_without_is_init_starts_anew_after_done(float64):
    filter = linear_denkf()
    frames = TensorDict({"observation": torch.randn(2, 9, 2)}, [2, 9])
    done = torch.zeros(2, 9, 1, dtype=torch.bool)
    done[0, 3] = done[1, 6] = True
    is_init = torch.zeros_like(done)
    is_init[:, 0] = is_init[0, 4] = is_init[1, 7] = True
    by_done = filter.sequence(frames.copy().set(("next", "done"), done))
    by_init = filter.sequence(frames.copy().set("is_init", is_init))
    neither = filter.sequence(frames.copy())
    assert_equal(by_done, by_init, BELIEF)
    assert by_done["belief", "ensemble"][0, 4].equal(filter.initial.members)
    assert not neither["belief", "mean"][0, 4].equal(by_done["belief", "mean"][0, 4])


def test_stored_belief_starts_the_sequence_and_is_not_updated_again(float64):
    for update_at_reset in (False, True):
        filter = linear_denkf(update_at_reset=update_at_reset)
        frames = TensorDict({"observation": torch.randn(2, 10, 2)}, [2, 10])
        whole = filter.sequence(frames.copy())
        tail = filter.sequence(whole[:, 4:].copy())
        assert tail["belief", "ensemble"][:, 0].equal(whole["belief", "ensemble"][:, 4])
        assert_equal(tail, whole[:, 4:], BELIEF)
        # An ensemble that was not stored: the sequence starts from the initial belief.
        fresh = filter.sequence(whole[:, 4:].exclude(("belief", "ensemble")))
        assert not fresh["belief", "mean"].equal(whole["belief", "mean"][:, 4:])
        assert fresh["belief", "mean"].equal(filter.sequence(frames[:, 4:].copy())["belief", "mean"])


def test_flat_slices_are_the_slices(float64):
    filter = linear_denkf()
    whole = filter.sequence(TensorDict({"observation": torch.randn(20, 2)}, [20]))
    starts = [3, 11, 7]
    slices = [whole[start : start + 5].copy() for start in starts]
    flat = torch.cat(slices)
    flat["is_init"] = (torch.arange(15) % 5 == 0).unsqueeze(-1)
    torch.nn.init.normal_(flat["forecast", "ensemble"])  # what follows from the belief is computed anew
    out = filter.sequence(flat)
    expected = torch.cat([filter.sequence(part) for part in slices])
    assert_equal(out, expected, [*BELIEF, ("forecast", "ensemble")])
    assert_equal(out, torch.cat([whole[start : start + 5] for start in starts]), BELIEF)


# ------------------------------------------------------------------------------------------------- controls


def adds_up_actions(**kwargs) -> DEnKF:
    return DEnKF(
        NoisyLinear(torch.eye(2), control=torch.eye(2)),
        None,
        LinearObservation(torch.eye(2)),
        ConstantNoise([1e6, 1e6], in_key="observation"),
        EnsembleAnalysis("etkf", sensor_key="observation"),
        initial=FixedEnsemble(torch.zeros(3, 2)),
        **kwargs,
    )


def test_action_is_read_one_step_earlier(float64):
    # x_t = x_{t-1} + a_{t-1} and no information from readings: x_t is the sum of all actions before t.
    filter = adds_up_actions()
    td = TensorDict({"observation": torch.randn(2, 6, 2), "action": torch.randn(2, 6, 2)}, [2, 6])
    expected = torch.cat([torch.zeros(2, 1, 2), td["action"].cumsum(1)[:, :-1]], 1)
    out = filter.sequence(td.copy())
    torch.testing.assert_close(out["belief", "mean"], expected, rtol=0, atol=1e-14)
    assert out["action"].equal(td["action"])
    # A step takes the action that is in its tensordict.
    row = filter.step(filter.initialise(td[:, 0].copy()))
    torch.testing.assert_close(row["belief", "mean"], td["action"][:, 0], rtol=0, atol=1e-14)


def test_control_keys_may_be_empty(float64):
    filter = adds_up_actions(control_keys=())
    td = TensorDict({"observation": torch.randn(6, 2), "action": torch.randn(6, 2)}, [6])
    expected = td["action"].cumsum(0) - td["action"][0]
    torch.testing.assert_close(filter.sequence(td)["belief", "mean"], expected, rtol=0, atol=1e-14)


# ---------------------------------------------------------------------------------------------------- masks


@pytest.mark.parametrize("scheme", SCHEMES)
def test_all_masked_is_pure_prediction(float64, scheme):
    filter = toy_denkf(scheme)
    frames = toy_frames((2, 6), resets=False, masks=0)
    frames["observed"] = torch.zeros(2, 6, 1, dtype=torch.bool)
    frames["measurement"][:] = torch.nan
    out = filter.sequence(frames)
    assert out["belief", "ensemble"].isfinite().all()
    assert out["belief", "ensemble"].equal(out["forecast", "ensemble"])
    assert (out["info", "innovation"] == 0).all()
    assert (out["info", "log_likelihood"] == 0).all()


@pytest.mark.parametrize("scheme", ["etkf", "sakov"])
@pytest.mark.parametrize("kept", [0, 1])
def test_partial_mask_is_the_filter_of_the_remaining_dimensions(float64, scheme, kept):
    both = linear_denkf(scheme)
    one = DEnKF(
        both["transition"],
        None,
        LinearObservation(both["observation"].matrix[[kept]]),
        ConstantNoise(linear_system()[3][[kept]].sqrt(), in_key="observation"),
        both["analysis"],
        initial=both.initial,
    )
    readings = torch.randn(2, 10, 2)
    observed = torch.tensor([kept == 0, kept == 1]).expand(2, 10, 2)
    broken = torch.where(observed, readings, torch.nan)
    masked = both.sequence(TensorDict({"observation": broken, "observed": observed}, [2, 10]))
    single = one.sequence(TensorDict({"observation": readings[..., [kept]]}, [2, 10]))
    # Cholesky factors of 2 x 2 with an identity row and of 1 x 1 may differ in the last digit.
    assert_equal(masked, single, [*BELIEF, ("info", "nis"), ("info", "log_likelihood")], atol=1e-12)


# ------------------------------------------------------------------------------------------------- gradients


@pytest.mark.parametrize("cut", [1, 3, 4])
@pytest.mark.parametrize("resets", [False, True])
def test_detach_every_cuts_exactly_there(float64, cut, resets):
    filter = toy_denkf("etkf")
    steps = 10
    frames = filter.draw_noise(toy_frames((2, steps), masks=0, resets=False))
    if resets:
        frames["is_init"] = torch.zeros(2, steps, 1, dtype=torch.bool)
        frames["is_init"][:, 0] = True
    frames["measurement"].requires_grad_()
    plain = filter.sequence(frames.copy())
    out = filter.sequence(frames.copy(), detach_every=cut)
    assert_equal(out.detach(), plain.detach(), filter.out_keys)
    for t in range(1, steps):
        first = max(cut * (t // cut), 1)  # the belief at 0 has not been updated
        (grad,) = torch.autograd.grad(out["belief", "mean"][:, t].sum(), frames["measurement"], retain_graph=True)
        size = grad.abs().sum((0, 2))
        assert (size[:first] == 0).all()
        assert (size[first : t + 1] > 0).all()
        assert (size[t + 1 :] == 0).all()
        (grad,) = torch.autograd.grad(plain["belief", "mean"][:, t].sum(), frames["measurement"], retain_graph=True)
        assert (grad.abs().sum((0, 2))[1 : t + 1] > 0).all()


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("layer", ["dropout", "flipout"])
def test_gradients_reach_every_sub_model_through_50_steps(scheme, layer):
    filter = toy_denkf(scheme, layer, sensor_layer=layer, ensemble_size=8)
    out = filter.sequence(toy_frames((3, 50), resets=False))
    out["belief", "mean"][:, -1].square().sum().backward()
    for name in ("transition", "sensor", "observation", "noise"):
        grads = [parameter.grad for parameter in filter[name].parameters() if parameter.grad is not None]
        assert grads, name
        assert all(grad.isfinite().all() for grad in grads), name
        assert sum(grad.abs().sum() for grad in grads) > 0, name


# ------------------------------------------------------------------------------------- parts of a composition


def test_parts():
    filter = toy_denkf()
    assert isinstance(filter["transition"], type(filter[2]))
    assert filter["transition"] is filter[2]
    part = filter[1:3]
    assert type(part) is TensorDictSequential
    assert list(part) == [filter["noise"], filter["transition"]]
    assert [filter.frame_modules, [filter.transition_module], filter.update_modules] == [
        [filter["sensor"], filter["noise"]],
        [filter["transition"]],
        [filter["observation"], filter["analysis"]],
    ]
    assert filter.carry_keys == [("belief", "ensemble")]
    assert filter.belief_keys == BELIEF


def test_select_subsequence():
    filter = toy_denkf()
    forecast = filter.select_subsequence(out_keys=[("forecast", "ensemble")])
    assert list(forecast) == [filter["transition"]]
    td = TensorDict({("belief", "ensemble"): torch.randn(E, S), "action": torch.zeros(A)})
    assert set(forecast(td).keys()) == {"belief", "action", "forecast"}
    assert list(filter.select_subsequence(out_keys=[("sensor", "noise")])) == [filter["sensor"], filter["noise"]]


def test_modules_are_sorted_by_their_keys_whatever_their_order(float64):
    filter = toy_denkf()
    frames = filter.draw_noise(toy_frames((2, 5)))
    # The sensor behind the transition: still a frame module.
    other = Filter(
        filter["transition"],
        filter["sensor"],
        filter["observation"],
        filter["noise"],
        filter["analysis"],
        initial=filter.initial,
    )
    assert other.frame_modules == [filter["sensor"], filter["noise"]]
    assert_equal(other.sequence(frames.copy()), filter.sequence(frames.copy()), filter.out_keys)


def test_nested_sequences_are_the_flat_filter(float64):
    flat = toy_denkf("perturbed")
    front = TensorDictSequential(flat["sensor"], flat["noise"])
    back = TensorDictSequential(flat["observation"], TensorDictSequential(flat["analysis"]))
    nested = Filter(front, flat["transition"], back, initial=flat.initial)
    frames = toy_frames((3, 9), masks=OBS)
    nested.draw_noise(frames)
    assert set(frames["noise"].keys()) == {"sensor", "initial", "transition", "analysis"}
    assert_equal(nested.sequence(frames.copy()), flat.sequence(frames.copy()), flat.out_keys)
    assert_equal(stepwise(nested, frames), nested.sequence(frames.copy()), BELIEF, atol=1e-12)


def test_motion_behind_the_analysis(float64):
    # The velocities of every step are those of the analysis, and the pose is their sum from the start.
    members = torch.randn(6, 5)
    filter = DEnKF(
        UnicycleTransition(torch.nn.Linear(2, 2), 0.1),
        None,
        Select([3, 4]),
        ConstantNoise([0.5, 0.5], in_key="y"),
        TensorDictSequential(EnsembleAnalysis("etkf", sensor_key="y", belief_key="analysis"), UnicycleMotion(0.1)),
        initial=FixedEnsemble(members),
    )
    frames = TensorDict({"y": torch.randn(3, 9, 2), "is_init": torch.zeros(3, 9, 1, dtype=torch.bool)}, [3, 9])
    frames["is_init"][:, 0] = frames["is_init"][1, 4] = True
    out = filter.sequence(frames.copy())
    assert_equal(stepwise(filter, frames), out, BELIEF)
    belief, velocity = out["belief", "ensemble"], out["analysis", "ensemble"][..., 3:]
    going = ~frames["is_init"].squeeze(-1)
    assert belief[..., 3:][going].equal(velocity[going])
    heading = members[:, 2] + 0.1 * velocity[0, 1:, :, 1].sum(0)
    torch.testing.assert_close(belief[0, -1, :, 2], heading, rtol=0, atol=1e-13)
    assert belief[1, 4].equal(members)


def test_unrelated_initial_belief():
    filter = toy_denkf()
    initial = GaussianPrior(torch.zeros(S), torch.ones(S), out_keys=[("b", "e"), ("b", "m"), ("b", "v")])
    with pytest.raises(ValueError, match="No module of the filter reads"):
        Filter(*filter, initial=initial)


def test_a_filter_with_other_keys(float64):
    # A second filter on the same tensordict, in its own name space.
    plain = linear_denkf()
    F, _, H, R = linear_system()

    class Renamed(NoisyLinear):
        def __init__(self):
            super().__init__(F)
            self.in_keys, self.out_keys = [("two", "ensemble")], [("two_forecast", "ensemble")]

    class RenamedStart(FixedEnsemble):
        def __init__(self, members):
            super().__init__(members)
            self.out_keys = [("two", name) for name in ("ensemble", "mean", "var")]

    names = {"predicted_key": ("two_forecast", "y"), "noise_variance_key": "r", "belief_key": "two", "info_key": "i"}
    other = Filter(
        Renamed(),
        LinearObservation(H, in_key=("two_forecast", "ensemble"), out_key=("two_forecast", "y")),
        ConstantNoise(R.sqrt(), in_key="y", out_key="r"),
        EnsembleAnalysis(
            "etkf", forecast_key=("two_forecast", "ensemble"), sensor_key="y", observed_key="seen", **names
        ),
        initial=RenamedStart(plain.initial.members),
        init_key="first",
    )
    y, seen, first = torch.randn(2, 7, 2), torch.rand(2, 7, 1) < 0.7, torch.rand(2, 7, 1) < 0.3
    expected = plain.sequence(TensorDict({"observation": y, "observed": seen, "is_init": first}, [2, 7]))
    out = other.sequence(TensorDict({"y": y, "seen": seen, "first": first}, [2, 7]))
    assert out["two"].keys() == expected["belief"].keys()
    assert all(out["two", name].equal(expected["belief", name]) for name in ("ensemble", "mean", "var"))


def test_errors():
    filter = toy_denkf()
    with pytest.raises(KeyError, match=r"carries its belief in \('belief', 'ensemble'\)"):
        filter.step(TensorDict({"measurement": torch.zeros(M), "action": torch.zeros(A)}))
    with pytest.raises(KeyError, match="carries its belief"):
        filter(TensorDict({"measurement": torch.zeros(M), "is_init": torch.tensor([True])}))
    with pytest.raises(KeyError, match="'measurement'"):
        filter.sequence(TensorDict({"action": torch.zeros(4, A)}, [4]))
    with pytest.raises(ValueError, match="time as its last batch dimension"):
        filter.sequence(TensorDict({"measurement": torch.zeros(M)}))


@pytest.mark.parametrize("copy", [lambda f: pickle.loads(pickle.dumps(f)), deepcopy])
def test_copies(float64, copy):
    filter = toy_denkf()
    frames = filter.draw_noise(toy_frames((2, 5)))
    expected = filter.sequence(frames.copy())
    other = copy(filter)
    assert_equal(other.sequence(frames.copy()), expected, filter.out_keys)
    fresh = toy_denkf()
    assert not fresh.sequence(frames.copy())["belief", "mean"].equal(expected["belief", "mean"])
    fresh.load_state_dict(other.state_dict())
    assert_equal(fresh.sequence(frames.copy()), expected, filter.out_keys)


def test_float32_agrees_with_float64(float64):
    filter = toy_denkf("etkf")
    frames = filter.draw_noise(toy_frames((3, 30), masks=OBS))
    expected = filter.sequence(frames.copy())
    single = frames.apply(lambda x: x.float() if x.is_floating_point() else x)
    out = filter.float().sequence(single)
    # 30 steps of arithmetic on numbers of size 1 at 6e-8 each.
    for key in filter.out_keys:
        assert out[key].dtype == torch.float32
        torch.testing.assert_close(out[key].double(), expected[key], rtol=1e-3, atol=1e-4)


# ------------------------------------------------------------------------------------------------ compilation


@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler")
@pytest.mark.parametrize("layer", ["dropout", "flipout"])
def test_compiled_step_equals_eager(float64, layer):
    filter = toy_denkf("sensor", layer)
    td = filter.initialise(toy_frames((3,), resets=False))
    filter.draw_noise(td)

    def loss(step, td):
        filter.zero_grad()
        out = step(td.copy())
        out["belief", "mean"].square().sum().backward()
        return out.detach(), [p.grad.clone() for p in filter.parameters() if p.grad is not None]

    torch._dynamo.reset()
    eager, grads = loss(filter.step, td)
    compiled, compiled_grads = loss(torch.compile(filter.step, fullgraph=True), td)
    # Inductor fuses sums and uses fused multiply-adds: rounding, 1e-16, amplified by the solve.
    assert_equal(compiled, eager, filter.out_keys, atol=1e-11)
    assert len(grads) == len(compiled_grads) > 10
    for grad, other in zip(grads, compiled_grads, strict=True):
        torch.testing.assert_close(grad, other, rtol=1e-9, atol=1e-11)


# ----------------------------------------------------------------------------------------------- in a policy


class Actor(TensorDictModule):
    def __init__(self):
        super().__init__(torch.nn.Linear(2, 1), in_keys=[("belief", "mean")], out_keys=["action"])


@pytest.mark.parametrize("update_at_reset", [False, True])
@pytest.mark.parametrize("make", [linear_denkf, linear_kalman])
def test_policy_transform_and_sequence_agree(float64, update_at_reset, make):
    F, Q, H, R = linear_system()
    filter, actor = make(update_at_reset=update_at_reset), Actor()

    def env(*transforms):
        base = LinearGaussianEnv(
            F, H, Q.diagonal().sqrt(), R.sqrt(), missing=0.3, batch_size=[3], max_steps=[4, 5, 30], seed=1
        )
        env = TransformedEnv(base)
        for transform in transforms:
            env.append_transform(transform)
        return env

    def rollout(env, policy):
        return env.rollout(12, policy, break_when_any_done=False)

    policy = TensorDictSequential(filter, actor)
    with torch.no_grad():
        by_policy = rollout(env(get_env_transforms_from_module(policy)), policy)
        by_transform = rollout(env(InitTracker(), DEnKFTransform(filter)), actor)
    assert by_policy["is_init"].sum(1).flatten().tolist() == [3, 3, 1]
    assert by_policy["state"].equal(by_transform["state"]), "the same episodes"
    # What LSTMModule does, too: at the root stands the belief that has seen the observation there.
    belief = [key for key in filter.belief_keys if key in by_policy.keys(True)]
    assert_equal(by_policy, by_transform, belief, atol=1e-13)
    assert_equal(by_policy["next"], by_policy, filter.carry_keys)
    frames = by_policy.select("observation", "observed", "is_init", "action")
    by_sequence = filter.sequence(frames.copy())
    assert_equal(by_sequence, by_policy, belief, atol=1e-13)
    assert (by_sequence["belief", "mean"][:, 2] - by_sequence["belief", "mean"][:, 0]).norm(dim=-1).min() > 0.1
    # A slice starts from what is stored.
    assert_equal(filter.sequence(by_policy[:, 2:9].copy()), by_policy[:, 2:9], belief, atol=1e-13)


def test_primer_of_every_kind_of_initial_belief():
    for filter in (
        linear_denkf(),
        linear_kalman(),
        linear_denkf(initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=6)),
        toy_denkf(initial=FromSensor([0], [0.0] * S, [1.0] * S, ensemble_size=E)),
    ):
        state = torch.get_rng_state()
        primer = filter.make_tensordict_primer()
        assert torch.get_rng_state().equal(state), "no random numbers are used up"
        assert set(primer.primers.keys(True, True)) == set(filter.carry_keys)


def test_summaries_follow_from_the_carry(float64):
    for filter in (linear_denkf(), linear_kalman()):
        td = filter.initial(TensorDict({}, [3]))
        carried = td.select(*filter.carry_keys)
        assert_equal(filter.summarise(carried), td, filter.belief_keys)


def test_select_observation(float64):
    # The paper's KITTI set-up: h selects known dimensions.
    filter = linear_denkf()
    filter = DEnKF(filter["transition"], None, Select([1]), ConstantNoise([0.5], in_key="y"),
                   EnsembleAnalysis("etkf", sensor_key="y"), initial=filter.initial)  # fmt: skip
    out = filter.step(filter.initialise(TensorDict({"y": torch.zeros(1)})))
    forecast = out["forecast", "ensemble"][:, 1]
    gain = forecast.var() / (forecast.var() + 0.25)
    torch.testing.assert_close(out["belief", "mean"][1], (1 - gain) * forecast.mean(), rtol=1e-12, atol=1e-14)
