"""The loop: one step and a sequence are the same; resets, controls, gradients."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from tests.filters.factories import (
    OBS,
    E,
    FixedEnsemble,
    S,
    assert_equal,
    linear_denkf,
    linear_system,
    linear_with,
    make_dyadic,
    stepwise,
    toy_denkf,
    toy_frames,
)
from tests.filters.test_forecasts import Reversed
from torch_denkf.modules import FromSensor, LearnedObservation, StochasticMLP

SCHEMES = ["sensor", "perturbed", "etkf", "sakov"]
BELIEF = [("belief", "ensemble"), ("belief", "mean"), ("belief", "var")]


# ------------------------------------------------------------------------------------------ step equals sequence


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("layer", ["dropout", "flipout"])
@pytest.mark.parametrize("update_at_reset", [False, True])
@pytest.mark.parametrize(("batch", "masks"), [((3, 12), OBS), ((12,), 1)])
def test_step_equals_sequence(float64, scheme, layer, update_at_reset, batch, masks):
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
    # Products may sum in another order: by how their factors lie in memory, and with the weights of all times at once.
    assert_equal(steps, sequence, filter.out_keys, atol=1e-13)
    assert not sequence["belief", "mean"][..., 1, :].equal(sequence["belief", "mean"][..., 0, :])


def test_noise_that_is_given_is_kept_and_the_rest_drawn():
    filter = toy_denkf("perturbed")
    frames = toy_frames((3, 5))
    given = torch.ones(3, 5, E, 16, dtype=torch.bool)
    frames["noise", "transition"] = given
    filter.draw_noise(frames, generator=torch.Generator().manual_seed(3))
    assert frames["noise", "transition"] is given
    assert frames["noise", "analysis"].shape == (3, 5, E, OBS)
    again = filter.draw_noise(toy_frames((3, 5)), generator=torch.Generator().manual_seed(3))
    assert again["noise", "sensor"].equal(frames["noise", "sensor"])


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


def test_a_start_that_is_updated_needs_no_action(float64):
    """The first observation of an episode comes before any action."""
    plain = linear_denkf(update_at_reset=True)
    driven = Reversed(linear_system()[0], torch.tensor([[0.5], [-1.0]]))
    filter = linear_with({"transition": driven}, update_at_reset=True)
    td = TensorDict({"observation": torch.randn(3, 2)}, [3])
    start = filter.initialise(td.copy())
    assert start.get(("forecast", "speed"), None) is None
    torch.testing.assert_close(start[BELIEF[1]], plain.initialise(td.copy())[BELIEF[1]])


def test_a_start_from_the_sensors_reading_runs_the_sensor(float64):
    """Also where it is not updated with that frame: the initial belief reads what the frame modules write."""
    *_, R = linear_system()
    sensor = TensorDictModule(lambda raw: 2.0 * raw, ["raw"], ["observation"])
    initial = FromSensor([0, 1], [0.0, 0.0], [1.0, 1.0], ensemble_size=20_000, observation_key="observation")
    filter = linear_with({"sensor": sensor}, initial=initial)
    out = filter.initialise(TensorDict({"raw": torch.tensor([[1.0, -3.0]])}, [1]))
    # 5 standard errors of 20,000 members.
    assert ((out[BELIEF[1]] - torch.tensor([2.0, -6.0])).abs() < 5 * (R / 20_000).sqrt()).all()
    torch.testing.assert_close(out[BELIEF[2]][0], R, rtol=5 * (2 / 20_000) ** 0.5, atol=0)
    assert filter.initialise({"raw": torch.zeros(2)})[BELIEF[1]].shape == (2,)


# ------------------------------------------------------------------------------------------------- controls


def test_action_is_read_one_step_earlier(float64):
    """Members without spread learn nothing from readings: x_t = F x_{t-1} + a_{t-1}."""
    filter, F = linear_denkf(control=torch.eye(2), initial=FixedEnsemble(torch.zeros(3, 2))), linear_system()[0]
    td = TensorDict({"observation": torch.randn(2, 6, 2), "action": torch.randn(2, 6, 2)}, [2, 6])
    states = [torch.zeros(2, 2)]
    for t in range(5):
        states.append(states[-1] @ F.mT + td["action"][:, t])
    expected = torch.stack(states, 1)
    out = filter.sequence(td.copy())
    torch.testing.assert_close(out["belief", "mean"], expected, rtol=0, atol=1e-14)
    assert out["action"].equal(td["action"])
    # A step takes the action that is in its tensordict.
    row = filter.step(filter.initialise(td[:, 0].copy()))
    torch.testing.assert_close(row["belief", "mean"], td["action"][:, 0], rtol=0, atol=1e-14)


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


@pytest.mark.parametrize("layer", ["dropout", "flipout"])
def test_a_stochastic_observation_model_draws_its_own_noise(float64, layer):
    filter = toy_denkf()
    filter = filter.with_modules(observation=LearnedObservation(StochasticMLP(S, OBS, (8,), layer=layer, rate=0.5)))
    frames = filter.draw_noise(toy_frames((2, 5)))  # for whole chunks
    assert frames.get(("noise", "observation"), None) is not None
    first = filter.sequence(frames.copy())
    assert_equal(stepwise(filter, frames), first, BELIEF, atol=1e-12)
    fresh = filter.sequence(frames.exclude(("noise", "observation")))
    assert not fresh["belief", "mean"].equal(first["belief", "mean"])
