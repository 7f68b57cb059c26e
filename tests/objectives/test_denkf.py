"""Oracles: each term worked out by hand from the filter's own outputs, the joint Gaussian, finite differences."""

import math

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import OBS, A, E, M, S, linear_kalman, toy_denkf, toy_frames
from tests.filters.test_kalman import joint_gaussian
from torch_denkf.filters import LSTMFilter
from torch_denkf.modules import Select, StochasticMLP
from torch_denkf.objectives import DEnKFLoss

TERMS = ["state", "transition", "sensor", "observation", "nll", "kl"]
ONLY_STATE = {"transition": 0.0, "sensor": 0.0}
# The loss and the oracle add the same numbers in another order.
CLOSE = {"rtol": 1e-12, "atol": 1e-13}


def problem(filter, batch=(2, 7), **kwargs):
    """Frames with noise, true states and true observations, and what the filter makes of them."""
    frames = filter.draw_noise(toy_frames(batch, **kwargs))
    frames["state"], frames["target_observation"] = torch.randn(*batch, S), torch.randn(*batch, OBS)
    return frames, filter.sequence(frames.copy())


def only(name, weight=1.0):
    return {term: weight * (term == name) for term in TERMS}


def pairs(x, distance):
    """Mean distance of different members, by a double loop."""
    size = x.shape[-2]
    terms = [distance(x[..., i, :] - x[..., j, :]) for i in range(size) for j in range(size) if i != j]
    return sum(terms) / len(terms)


def score_by_hand(score, ensemble, truth):
    """Per element [*B, T]."""
    errors = ensemble - truth.unsqueeze(-2)
    if score == "mse":
        return errors.mean(-2).square().mean(-1)
    if score == "energy":
        norm = torch.linalg.vector_norm
        return norm(errors, dim=-1).mean(-1) - pairs(ensemble, lambda d: norm(d, dim=-1)) / 2
    return (errors.abs().mean(-2) - pairs(ensemble, torch.abs) / 2).mean(-1)


def stepped(frames):
    mask = ~frames["is_init"].squeeze(-1)
    mask[..., 0] = False
    return mask


@pytest.mark.parametrize("score", ["crps", "energy", "mse"])
@pytest.mark.parametrize("width", [1, OBS])
def test_scores_by_hand(float64, score, width):
    filter = toy_denkf("perturbed")
    frames, out = problem(filter, masks=width)
    losses = DEnKFLoss(filter, score=score)(frames)
    assert set(losses.keys()) == {"loss_state", "loss_transition", "loss_sensor"}
    steps, observed = stepped(frames), frames["observed"].all(-1)
    assert 0 < steps.sum() < steps[..., 1:].numel()
    assert 0 < observed.sum() < observed.numel()
    for name, key, truth, mask in (
        ("state", ("belief", "ensemble"), frames["state"], steps),
        ("transition", ("forecast", "ensemble"), frames["state"], steps),
        ("sensor", ("sensor", "ensemble"), frames["target_observation"], observed),
    ):
        expected = score_by_hand(score, out[key], truth)[mask].mean()
        torch.testing.assert_close(losses[f"loss_{name}"], expected, **CLOSE)


def test_every_element_counts_for_the_sensor_without_a_mask(float64):
    filter = toy_denkf()
    frames, out = problem(filter, masks=0)
    expected = score_by_hand("crps", out["sensor", "ensemble"], frames["target_observation"]).mean()
    torch.testing.assert_close(DEnKFLoss(filter)(frames)["loss_sensor"], expected, **CLOSE)


def test_observation_by_hand(float64):
    filter = toy_denkf()
    frames, _ = problem(filter)
    loss = DEnKFLoss(filter, **only("observation"), observation_scale=[0.5, 4.0])
    error = (filter["observation"].module(frames["state"]) - frames["target_observation"]) / torch.tensor([0.5, 4.0])
    torch.testing.assert_close(loss(frames)["loss_observation"], error.square().mean(), **CLOSE)


def test_nll_by_hand(float64):
    filter = toy_denkf()
    frames, out = problem(filter)
    expected = -out["info", "log_likelihood"].squeeze(-1)[stepped(frames)].mean()
    losses = DEnKFLoss(filter, **only("nll"))(frames.exclude("state", "target_observation"))
    assert list(losses.keys()) == ["loss_nll"]
    torch.testing.assert_close(losses["loss_nll"], expected, **CLOSE)


@pytest.mark.parametrize("update_at_reset", [False, True])
def test_nll_of_a_kalman_filter_is_the_joint_density(float64, update_at_reset):
    T = 10
    kf = linear_kalman(update_at_reset=update_at_reset)
    readings = torch.randn(3, T, 2)
    loss = DEnKFLoss(kf, **only("nll"), reduction="sum")
    joint = joint_gaussian(kf, T)
    if update_at_reset:  # the first reading is given
        first = torch.distributions.MultivariateNormal(joint.mean[:2], joint.covariance_matrix[:2, :2])
        expected = joint.log_prob(readings.reshape(3, -1)) - first.log_prob(readings[:, 0])
    else:  # the first reading is not used
        rest = torch.distributions.MultivariateNormal(joint.mean[2:], joint.covariance_matrix[2:, 2:])
        expected = rest.log_prob(readings[:, 1:].reshape(3, -1))
    value = loss(TensorDict({"observation": readings}, [3, T]))["loss_nll"]
    torch.testing.assert_close(value, -expected.sum(), rtol=1e-11, atol=0)


def test_kl_by_hand(float64):
    filter = toy_denkf(layer="flipout", sensor_layer="flipout")
    frames, _ = problem(filter)
    nets = [net for net in filter.modules() if isinstance(net, StochasticMLP)]
    expected = sum(net.kl() for net in nets)
    assert sum(net.layer == "flipout" for net in nets) == 2
    losses = DEnKFLoss(filter, **only("kl", 0.01))(frames)
    torch.testing.assert_close(losses["loss_kl"], 0.01 * expected, **CLOSE)
    assert DEnKFLoss(toy_denkf(), **only("kl"))(problem(toy_denkf())[0])["loss_kl"] == 0


def test_weights_scale_the_terms(float64):
    filter = toy_denkf(layer="flipout")
    frames, _ = problem(filter)
    ones = DEnKFLoss(filter, **dict.fromkeys(TERMS, 1.0))(frames)
    weights = dict(zip(TERMS, (0.5, 2.0, 3.0, 0.1, 7.0, 1e-3), strict=True))
    weighted = DEnKFLoss(filter, **weights)(frames)
    for name, weight in weights.items():
        torch.testing.assert_close(weighted[f"loss_{name}"], weight * ones[f"loss_{name}"], **CLOSE)
    assert DEnKFLoss(filter, **weights).out_keys == [f"loss_{name}" for name in TERMS]


# -------------------------------------------------------------------------------------------- units and angles


@pytest.mark.parametrize("score", ["crps", "energy", "mse"])
def test_scales(float64, score):
    filter = toy_denkf()
    frames, out = problem(filter)
    scale = torch.tensor([0.5, 10.0, math.inf])
    losses = DEnKFLoss(filter, score=score, state_scale=scale, observation_scale=[2.0, 3.0])(frames)
    # Of truth and ensemble divided by the scale; nothing is left of a dimension with infinite scale.
    expected = score_by_hand(score, out["belief", "ensemble"] / scale, frames["state"] / scale)[stepped(frames)].mean()
    torch.testing.assert_close(losses["loss_state"], expected, **CLOSE)
    scale = torch.tensor([2.0, 3.0])
    expected = score_by_hand(score, out["sensor", "ensemble"] / scale, frames["target_observation"] / scale)
    torch.testing.assert_close(losses["loss_sensor"], expected[frames["observed"].all(-1)].mean(), **CLOSE)


@pytest.mark.parametrize("score", ["crps", "energy", "mse"])
def test_angles_wrap(float64, score):
    filter = toy_denkf()
    frames, out = problem(filter)
    frames["state"] = out["belief", "ensemble"][..., 0, :].detach() + 0.1  # near: no error exceeds pi
    assert (out["belief", "ensemble"] - frames["state"].unsqueeze(-2)).abs().max() < math.pi
    near = DEnKFLoss(filter, score=score, **ONLY_STATE, angles=[1])(frames)["loss_state"]
    expected = score_by_hand(score, out["belief", "ensemble"], frames["state"])[stepped(frames)].mean()
    torch.testing.assert_close(near, expected, **CLOSE)
    turned = frames.clone()
    turned["state"][..., 1] += 2 * math.pi * torch.randint(-3, 4, (2, 7))
    far = DEnKFLoss(filter, score=score, **ONLY_STATE, angles=[1])(turned)["loss_state"]
    torch.testing.assert_close(far, near, rtol=1e-9, atol=1e-12)  # 6 pi costs a digit
    plain = DEnKFLoss(filter, score=score, **ONLY_STATE)(turned)["loss_state"]
    assert plain > near + 1
    turned["state"][..., 0] += 2 * math.pi  # not an angle
    assert DEnKFLoss(filter, score=score, **ONLY_STATE, angles=[1])(turned)["loss_state"] > near + 0.5


# ---------------------------------------------------------------------------------------------- what counts


def test_first_and_reset_elements_do_not_count(float64):
    filter = toy_denkf()
    frames, _ = problem(filter)
    loss = DEnKFLoss(filter, **ONLY_STATE)
    before = loss(frames)
    frames = frames.clone()
    frames["state"][~stepped(frames)] = 1e6
    assert loss(frames)["loss_state"].equal(before["loss_state"])
    frames["state"][stepped(frames)] += 1
    assert not loss(frames)["loss_state"].equal(before["loss_state"])


def test_done_marks_starts_where_is_init_is_missing(float64):
    filter = toy_denkf()
    frames, _ = problem(filter, resets=False)
    done = torch.zeros(2, 7, 1, dtype=torch.bool)
    done[0, 2] = True
    frames["next", "done"] = done
    value = DEnKFLoss(filter, **ONLY_STATE, reduction="none")(frames)["loss_state"]
    counts = torch.ones(2, 7, dtype=torch.bool)
    counts[:, 0] = counts[0, 3] = False
    assert (value != 0).equal(counts)


@pytest.mark.parametrize("score", ["crps", "mse"])
def test_reductions(float64, score):
    filter = toy_denkf(layer="flipout")
    frames, out = problem(filter)
    values = {
        kind: DEnKFLoss(filter, score=score, kl=0.1, nll=1.0, reduction=kind)(frames)
        for kind in ("none", "sum", "mean")
    }
    masks = {name: stepped(frames) for name in ("state", "transition", "nll")}
    masks["sensor"] = frames["observed"].all(-1)
    for name, mask in masks.items():
        none, total, mean = (values[kind][f"loss_{name}"] for kind in ("none", "sum", "mean"))
        assert none.shape == (2, 7)
        assert (none[~mask] == 0).all()
        if name != "nll":  # the likelihood of no observation is one
            assert (none[mask] != 0).all()
        torch.testing.assert_close(none.sum(), total, **CLOSE)
        torch.testing.assert_close(total / mask.sum(), mean, **CLOSE)
    expected = score_by_hand(score, out["belief", "ensemble"], frames["state"])
    torch.testing.assert_close(values["none"]["loss_state"][masks["state"]], expected[masks["state"]], **CLOSE)


@pytest.mark.parametrize("reduction", ["none", "sum", "mean"])
def test_collector_mask(float64, reduction):
    # Padding at the end of trajectories, as split_trajectories leaves it: it may hold anything.
    filter = toy_denkf()
    frames, _ = problem(filter, resets=False)
    frames["is_init"] = torch.zeros(2, 7, 1, dtype=torch.bool)
    frames["is_init"][:, 0] = True
    mask = torch.ones(2, 7, 1, dtype=torch.bool)
    mask[0, 4:] = mask[1, 6:] = False
    frames["collector", "mask"] = mask
    loss = DEnKFLoss(filter, reduction=reduction)
    before = loss(frames)
    padded = frames.clone()
    padded["state"][~mask.squeeze(-1)] = torch.nan
    padded["target_observation"][~mask.squeeze(-1)] = torch.nan
    after = loss(padded)
    without = frames.exclude("collector")
    for key in list(before.keys()):
        assert before[key].isfinite().all()
        assert after[key].equal(before[key])
        if reduction == "none":
            assert (before[key][~mask.squeeze(-1)] == 0).all()
        else:
            assert not before[key].equal(loss(without)[key])
    sum(value.sum() for value in after.values()).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in filter.parameters())


def test_nothing_counts_gives_zero():
    filter = toy_denkf()
    frames, _ = problem(filter, batch=(2, 1))
    loss = DEnKFLoss(filter, **ONLY_STATE)(frames)["loss_state"]
    assert loss == 0


# -------------------------------------------------------------------------------------------------- gradients


@pytest.mark.parametrize("score", ["crps", "energy", "mse"])
@pytest.mark.parametrize("layer", ["dropout", "flipout"])
def test_gradient_by_finite_differences(float64, score, layer):
    filter = toy_denkf("sensor", layer)
    frames, _ = problem(filter)
    loss = DEnKFLoss(filter, score=score, **ONLY_STATE)
    loss(frames)["loss_state"].backward()
    generator, step, checked = torch.Generator().manual_seed(1), 1e-6, 0
    for name in ("transition", "sensor", "observation", "noise"):
        for parameter in filter[name].parameters():
            if parameter.grad is None or not parameter.grad.any():
                continue
            # The entry with the largest gradient and one at random.
            entries = {
                int(parameter.grad.abs().argmax()),
                int(torch.randint(parameter.numel(), (), generator=generator)),
            }
            for entry in entries:
                values = []
                for sign in (1, -1):
                    with torch.no_grad():
                        parameter.view(-1)[entry] += sign * step
                        values.append(loss(frames)["loss_state"])
                        parameter.view(-1)[entry] -= sign * step
                difference = (values[0] - values[1]) / (2 * step)
                # Central differences: 1e-12 of curvature, 1e-16 / 1e-6 = 1e-10 of rounding.
                torch.testing.assert_close(parameter.grad.view(-1)[entry], difference, rtol=1e-5, atol=1e-8)
                checked += 1
    assert checked > 15


def test_detach_every_reaches_the_filter(float64):
    filter = toy_denkf("etkf")
    frames, _ = problem(filter, resets=False, masks=0)

    def gradient(detach_every):
        loss = DEnKFLoss(filter, **ONLY_STATE, detach_every=detach_every)
        value = loss(frames)["loss_state"]
        return value, torch.autograd.grad(value, filter["transition"].module.layers[0].weight)[0]

    (full, full_grad), (cut, cut_grad) = gradient(None), gradient(2)
    assert full.equal(cut)
    assert not full_grad.allclose(cut_grad)


def test_training_lowers_the_loss(float64):
    filter = toy_denkf(sensor_layer="none")
    frames, _ = problem(filter, resets=False)
    frames["state"] = frames["measurement"][..., :S].cumsum(1)
    loss = DEnKFLoss(filter, **ONLY_STATE)
    optimiser = torch.optim.Adam(loss.parameters(), 1e-2)
    values = []
    for _ in range(60):
        value = loss(frames)["loss_state"]
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        values.append(value.item())
    assert values[-1] < 0.8 * values[0]


# ------------------------------------------------------------------------------------------- keys and interface


def test_paper_preset(float64):
    filter = toy_denkf()
    frames, out = problem(filter)
    losses = DEnKFLoss.paper(filter)(frames)
    assert set(losses.keys()) == {"loss_state", "loss_transition", "loss_sensor"}
    expected = (out["belief", "mean"] - frames["state"]).square().mean(-1)[stepped(frames)].mean()
    torch.testing.assert_close(losses["loss_state"], expected, **CLOSE)
    assert set(DEnKFLoss.paper(filter, sensor=0.0)(frames).keys()) == {"loss_state", "loss_transition"}


def test_known_observation_model_gives_the_target(float64):
    filter = toy_denkf()
    filter = type(filter)(
        filter["transition"], filter["sensor"], Select([2, 0]), filter["noise"], initial=filter.initial
    )
    frames, out = problem(filter)
    frames = frames.exclude("target_observation")
    expected = score_by_hand("crps", out["sensor", "ensemble"], frames["state"][..., [2, 0]])
    observed = frames["observed"].all(-1)
    torch.testing.assert_close(DEnKFLoss(filter)(frames)["loss_sensor"], expected[observed].mean(), **CLOSE)


def test_set_keys(float64):
    filter = toy_denkf()
    frames, _ = problem(filter)
    renamed = frames.copy()
    for old, new in (("state", ("truth", "x")), ("target_observation", "y"), ("observed", "seen")):
        renamed[new] = renamed[old]
    renamed = renamed.exclude("state", "target_observation")
    loss = DEnKFLoss(filter)
    expected = loss(frames)
    loss.set_keys(state=("truth", "x"), target_observation="y", observed="seen")
    out = loss(renamed)
    assert all(out[key].equal(expected[key]) for key in list(expected.keys()))
    assert ("truth", "x") in loss.in_keys
    with pytest.raises(ValueError, match="not an accepted"):
        loss.set_keys(reward="r")


def test_score_of_other_entries(float64):
    filter = toy_denkf()
    frames, out = problem(filter)
    loss = DEnKFLoss(filter, **ONLY_STATE)
    loss.set_keys(belief=("forecast", "ensemble"))
    expected = score_by_hand("crps", out["forecast", "ensemble"], frames["state"])[stepped(frames)].mean()
    torch.testing.assert_close(loss(frames)["loss_state"], expected, **CLOSE)


def test_arguments_by_keyword(float64):
    # tensordict takes the leading sizes that all entries share for the batch: [2, 6], because the last ones differ.
    filter = toy_denkf(sensor_layer="none", layer="none")
    filter.initial.std.zero_()  # nothing is random
    loss = DEnKFLoss(filter, **ONLY_STATE, score="mse")
    assert loss.in_keys == ["measurement", "action", "state"]
    entries = {"measurement": torch.randn(2, 6, M), "action": torch.randn(2, 6, A), "state": torch.randn(2, 6, S)}
    expected = loss(TensorDict(entries, [2, 6]))["loss_state"]
    torch.testing.assert_close(loss(**entries), expected, **CLOSE)


def test_the_tensordict_is_left_as_it_is():
    filter = toy_denkf()
    frames, _ = problem(filter)
    before = frames.clone()
    DEnKFLoss(filter)(frames)
    assert set(frames.keys(True, True)) == set(before.keys(True, True))
    assert (frames == before).all()


def test_parameters_and_state_are_the_filters():
    filter = toy_denkf()
    loss = DEnKFLoss(filter, state_scale=[1.0, 2.0, 3.0])
    assert {id(p) for p in loss.parameters()} == {id(p) for p in filter.parameters()}
    assert {name for name, _ in loss.named_parameters()} == {f"filter.{name}" for name, _ in filter.named_parameters()}
    assert "state_scale" in loss.state_dict()


def test_flat_slices(float64):
    # What a SliceSampler gives: [B * T], is_init at the start of every slice.
    filter = toy_denkf()
    frames, _ = problem(filter, batch=(3, 5))
    loss = DEnKFLoss(filter)
    expected, out = loss(frames), loss(frames.reshape(15))
    for key in list(expected.keys()):
        torch.testing.assert_close(out[key], expected[key], rtol=0, atol=1e-12)


def test_errors():
    filter = toy_denkf()
    frames, _ = problem(filter)
    with pytest.raises(ValueError, match="'nll'"):
        DEnKFLoss(filter, score="nll")
    with pytest.raises(KeyError, match=r"DEnKFLoss reads .*state.*set_keys"):
        DEnKFLoss(filter)(frames.exclude("state"))
    with pytest.raises(KeyError, match="'target_observation'"):
        DEnKFLoss(filter)(frames.exclude("target_observation"))
    with pytest.raises(KeyError, match="target_observation"):
        DEnKFLoss(filter, **only("observation"))(frames.exclude("target_observation"))
    td = TensorDict({"observation": torch.randn(4, 2), "state": torch.randn(4, 2)}, [4])
    lstm = LSTMFilter(None, state_dim=2, observation_dim=2, observation_key="observation")
    with pytest.raises(KeyError, match="no observation model"):
        DEnKFLoss(lstm, **only("sensor"))(td)
    with pytest.raises(KeyError, match=r"\('sensor', 'ensemble'\), which is missing"):
        DEnKFLoss(linear_kalman(), **only("sensor"))(td)
    with pytest.raises(KeyError, match="measurement"):
        DEnKFLoss(filter)(frames.exclude("measurement"))
    with pytest.raises(AttributeError, match="set_keys"):
        DEnKFLoss(filter).in_keys = ["state"]


def test_sizes_of_the_toy_problem():
    # The oracles above would be vacuous with one member, dimension or step.
    assert min(S, M, OBS, A, E) >= 2
