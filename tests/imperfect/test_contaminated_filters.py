"""Filters of readings of which a share is wrong: every way to run one is the same, and so are late readings."""

from functools import partial

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch.testing import assert_close

from tests.filters import test_spaces as spaces
from tests.imperfect.test_visible_filters import KINDS, MAKERS, contaminated, frames, late
from torch_denkf.functional.manifolds import SO3
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.imperfect import Contaminated
from torch_denkf.imperfect.mixture import log_mixture, mix_moments
from torch_denkf.modules import AroundState, GaussianAround
from torch_denkf.objectives import DEnKFLoss, GaussianLoss, MixtureLoss


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("delay", [0, 2])
def test_late_readings_have_the_moments_of_both_histories(float64, kind, delay):
    """One late reading at the end: the mixture of the filters of narrow and of wide noise; others stay as they are."""

    def analysis(*args, **keys):
        return Contaminated(KINDS[kind](*args, **keys), 0.3, width=5.0)

    td = frames(2, 7).rename_key_("observation", "late").exclude("visible", "observed")
    td["own"] = torch.randn(2, 7, 2)
    td["late_observed"] = torch.zeros(2, 7, 1, dtype=torch.bool)
    td["late_observed"][:, -1] = True
    td["late"] = torch.full((2, 7, 2), torch.nan)
    td["late"][:, -1] = torch.tensor([[1.5, -1.0], [0.3, 0.2]])
    td["own_observed"] = ~td["late_observed"]  # the last reading alone is the late one
    mixed, sound, wide = (
        late(kind, r, analysis=a, delay=delay).sequence(td.copy())[:, -1]
        for r, a in ((1.0, analysis), (1.0, None), (5.0, None))
    )
    scores = [out["info", "late", "log_likelihood"] for out in (sound, wide)]
    odds = 0.3 / 0.7 * (scores[1] - scores[0]).exp()
    q = mixed["info", "late", "outlier"]
    assert_close(q, odds / (1 + odds), rtol=1e-6, atol=0)
    assert_close(mixed["info", "log_likelihood"], log_mixture(torch.tensor(0.7), *scores), rtol=1e-6, atol=0)
    beliefs = [("belief", "mean"), ("belief", "cov")]
    covs = [
        out["belief", "cov"] if kind != "ensemble" else torch.stack([one.T.cov() for one in out["belief", "ensemble"]])
        for out in (mixed, sound, wide)
    ]
    means = [out[beliefs[0]] for out in (mixed, sound, wide)]
    mean, cov = mix_moments(1 - q, means[1], covs[1], means[2], covs[2])
    assert_close(means[0], mean, rtol=0, atol=1e-7)
    assert_close(covs[0], cov, rtol=0, atol=1e-7)
    if delay and kind != "ensemble":
        ends = [out["smoothed", "mean"] for out in (mixed, sound, wide)]
        assert_close(ends[0], ends[2] + (1 - q) * (ends[1] - ends[2]), rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", MAKERS)
def test_a_step_without_the_reading_is_the_forecast(float64, name):
    filter = contaminated(MAKERS[name](), width="width")
    td = filter.initialise(frames(2, 3)[:, 0])
    td["width"] = torch.full((2, 1), 3.0)
    torch.manual_seed(1)
    hidden = filter.step(td.copy().set("observed", torch.zeros(2, 1, dtype=torch.bool)))
    torch.manual_seed(1)
    left = ["observation", "visible", "width"]
    td = td.exclude(*left, "observed")
    out = filter.step(td, without=left) if name == "Kalman" else filter.predict(td)
    for key in filter.belief_keys:
        assert_close(out[key], hidden[key])


LOSSES = {"etkf": DEnKFLoss, "Kalman": GaussianLoss, "UKF": GaussianLoss}
LOSSES["particles"] = partial(MixtureLoss, score="crps")


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize("term", ["state", "nll"])
def test_losses_train_share_width_and_head(float64, name, term):
    head = torch.nn.Linear(1, 1)
    share = TensorDictModule(torch.nn.Sequential(head, torch.nn.Sigmoid()), [("info", "nis")], ["share"])
    td = frames(3, 5).set("state", torch.randn(3, 5, 2)).exclude("visible")
    for options in ({"share": 0.2, "trainable": True}, {"share": share, "trainable": True}):
        filter = contaminated(MAKERS[name](), **options)
        loss = LOSSES[name](filter, **{**dict.fromkeys(("state", "transition", "sensor"), 0.0), term: 1.0})
        parameters = list(filter["analysis"].quantities.parameters())
        assert len(parameters) == (3 if options["share"] is share else 2)
        for gradient in torch.autograd.grad(loss(td)[f"loss_{term}"], parameters):
            assert gradient.isfinite().all()
            assert gradient.abs().max() > 0


def late_on_space(kind):
    """Orientations whose readings come two steps late."""

    def analysis(*args, **keys):
        return Contaminated(
            KINDS["ensemble" if kind == "etkf" else kind](*args, **keys), 0.3, width=5.0, divergence=0.1
        )

    space = {"state_key": "start", "space": spaces.SPACE}
    start = (
        AroundState(spaces.STD, ensemble_size=24, **space) if kind == "etkf" else GaussianAround(spaces.STD, **space)
    )
    options = {"reading_space": SO3(), "observed_key": "observed", "delay": 2, "analysis": analysis}
    sensor = FusedSensor(spaces.Orientation(), spaces.R, **options)
    return FusedFilter(spaces.Turning(), {"pose": sensor}, initial=start, process_noise=spaces.Q)


@pytest.mark.parametrize("kind", ["EKF", "UKF", "etkf", "particles", "late EKF", "late etkf"])
def test_orientations_turn_with_the_world_and_steps_are_the_sequence(float64, kind):
    """Readings of which a share is wrong: a world that is turned changes nothing else, a lag window included."""
    divergence = 0.0 if kind == "particles" else 0.1
    filter = (
        late_on_space(kind.split()[-1])
        if "late" in kind
        else contaminated(spaces.make(kind), 0.3, width=5.0, divergence=divergence)
    )
    data = spaces.log()
    wrong = torch.rand(*data.shape, 1) < 0.3
    data["pose"] = torch.where(wrong, SO3().plus(data["pose"], 0.5 * torch.randn(*data.shape, 3)), data["pose"])
    data = spaces.with_noise(filter, data)
    turn = SO3().exp(torch.randn(3))
    here, there = spaces.turned_beliefs(filter, turn, data)
    outlier = here["info", "outlier"]
    assert ((outlier > 0.1) & (outlier < 0.9)).sum() > 3
    tolerance = 1e-6 if kind == "particles" else 1e-7
    moved = spaces.turned(turn, here["belief", "mean"])
    assert spaces.SPACE.minus(there["belief", "mean"], moved).abs().max() < tolerance
    assert_close(there["belief", "var"], here["belief", "var"], rtol=0, atol=tolerance)
    assert_close(there["info", "log_likelihood"], here["info", "log_likelihood"], rtol=0, atol=1e-5)
    belief = None
    for t in range(5):
        row = data[:, t].copy().set("action", data["action"][:, max(t - 1, 0)])  # that led here
        out = filter.initialise(row) if belief is None else filter.step(row.update(belief))
        belief = out.select(*filter.belief_keys)
        assert_close(out["belief", "mean"], here["belief", "mean"][:, t], rtol=0, atol=1e-10)
