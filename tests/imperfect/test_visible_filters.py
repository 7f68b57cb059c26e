"""Filters that use whether a sensor sees: every way to run one is the same, and certain knowledge is a mask."""

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch.testing import assert_close

from tests.filters.factories import FixedEnsemble, linear_denkf, linear_kalman, linear_system
from tests.filters.gaussian_for_tests import linear_filter
from tests.filters.particle_for_tests import bootstrap
from torch_denkf import EKF, UKF, DEnKF, ParticleFilter
from torch_denkf.deployment import export_step, load_step
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.imperfect import Contaminated, Visibility, Visible
from torch_denkf.imperfect.mixture import mix_moments
from torch_denkf.modules import (
    DiagonalNoise,
    EKFAnalysis,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedTransition,
    LinearObservation,
    LinearTransition,
    MomentPrior,
    Select,
    UKFAnalysis,
    VectorSensor,
)
from torch_denkf.monitoring import Gated
from torch_denkf.objectives import DEnKFLoss, GaussianLoss, MixtureLoss, SensorLoss
from torch_denkf.smoothers import EnRTS, FixedLag, RTSSmoother
from torch_denkf.smoothers.past import LaggedAnalysis

MAKERS = {
    "etkf": linear_denkf,
    "perturbed": lambda: linear_denkf("perturbed", noisy=True),
    "Kalman": linear_kalman,
    "EKF": lambda: linear_filter("EKF"),
    "UKF": lambda: linear_filter("UKF"),
    "particles": lambda: bootstrap(50),
}
CERTAIN = [name for name in MAKERS if name != "particles"]  # these resample where there is a reading, seen or not


def heeds(filter):
    """Returns the filter, whose update uses p from the data."""
    return filter.with_modules(analysis=Visible(filter["analysis"], visible_key="visible"))


def contaminated(filter, share="visible", **options):
    """Returns the filter, whose readings are wrong in the share that an entry says."""
    return filter.with_modules(analysis=Contaminated(filter["analysis"], share, **options))


#: What a filter's analysis is wrapped in, by the share that it writes.
WRAPPED = {"visible": heeds, "outlier": contaminated}
BOTH = pytest.mark.parametrize("share", WRAPPED)


def frames(*batch):
    """Returns readings, masks, resets and p."""
    torch.manual_seed(0)
    td = TensorDict({"observation": torch.randn(*batch, 2), "visible": torch.rand(*batch, 1)}, batch)
    td["observed"] = torch.rand(*batch, 2) < 0.8
    td["observation"] = torch.where(td["observed"], td["observation"], torch.nan)
    td["is_init"] = torch.zeros(*batch, 1, dtype=torch.bool)
    td["is_init"][..., 0, :] = True
    return td


#: One of each. To trace a step takes seconds.
TRACED = [("etkf", "visible"), ("Kalman", "outlier")]


@BOTH
@pytest.mark.parametrize("name", MAKERS)
def test_steps_are_the_sequence_and_the_compiled_sequence(float64, name, share):
    options = {"width": 4.0, "divergence": 0.1 * (name != "particles")} if share == "outlier" else {}
    filter, td = WRAPPED[share](MAKERS[name](), **options), frames(2, 6)
    filter.draw_noise(td)
    whole, belief = filter.sequence(td.copy()), None
    assert ((whole["info", share] > 0) & (whole["info", share] < 1)).any()
    for t in range(6):
        row = td[:, t].copy()
        out = filter.initialise(row) if belief is None else filter.step(row.update(belief))
        belief = out.select(*filter.belief_keys)
        for key in filter.belief_keys:
            assert_close(belief[key], whole[key][:, t], rtol=0, atol=1e-12)
    if (name, share) not in TRACED:
        return
    compiled = filter.compile(chunk=2, backend="eager").sequence(td.copy())
    for key in filter.out_keys:
        assert_close(compiled[key], whole[key], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("share", "name"), [("visible", "EKF"), ("outlier", "etkf")])
def test_a_packaged_step_is_the_step(name, share, tmp_path):
    options = {"share": 0.3, "width": 4.0} if share == "outlier" else {}
    filter, td = WRAPPED[share](MAKERS[name](), **options), frames(4).exclude("is_init")
    td = td.exclude("visible") if options else td
    row = filter.initialise(td[0])
    step = load_step(export_step(filter, row, tmp_path / "step.pt2", compiled=False))
    row = filter.draw_noise(row.select(*filter.carry_keys).update(td[1]))
    with torch.no_grad():
        found = step({key: row[tuple(key.split("."))] for key in step.inputs})
        out = filter.step(row)
    for key, value in found.items():
        assert_close(value, out[tuple(key.split("."))], rtol=1e-5, atol=1e-5, equal_nan=True)


def certain(td, key="observed"):
    """Returns readings that are seen for certain, or for certain not; and the same by masks."""
    sees = torch.rand(*td.batch_size, 1) < 0.6
    return td.copy().set("visible", sees.to(torch.float64)), td.copy().set(key, td[key] & sees)


@BOTH
@pytest.mark.parametrize("name", CERTAIN)
@pytest.mark.parametrize("lag", [0, 3])
def test_certain_knowledge_is_a_mask(float64, name, lag, share):
    """A sensor that does not see, or reads an outlier, for certain: a missing observation, also for a lag's past."""
    told, masked = certain(frames(2, 9))
    if share == "outlier":
        told["visible"] = 1 - told["visible"]
    outs, options = [], {"width": 1e6} if share == "outlier" else {}
    for filter, td in ((WRAPPED[share](MAKERS[name](), **options), told), (MAKERS[name](), masked)):
        filter = FixedLag(filter, lag) if lag else filter
        torch.manual_seed(3)
        outs.append(filter.sequence(td.copy()))
    for key in [*filter.belief_keys, *([("smoothed", "mean"), ("smoothed", "var")] if lag else [])]:
        assert_close(outs[0][key], outs[1][key], rtol=0, atol=1e-5 if share == "outlier" else 1e-9)


KINDS = {"ensemble": partial(EnsembleAnalysis, "etkf"), "EKF": EKFAnalysis, "UKF": UKFAnalysis}


def late(kind, r=1.0, *, analysis=None, delay=2):
    """Returns a filter of a sensor that is late, and of one that is not."""
    F, Q, H, R = linear_system()
    sensors = {
        "late": FusedSensor(LinearObservation(H), r * R.sqrt(), delay=delay, analysis=analysis),
        "own": FusedSensor(LinearObservation(H), R.sqrt()),
    }
    if kind == "ensemble":
        moves = torch.nn.Linear(2, 2, bias=False)
        moves.weight.data = F
        members = torch.randn(7, 2, generator=torch.Generator().manual_seed(1))
        return FusedFilter(LearnedTransition(moves, residual=False), sensors, initial=FixedEnsemble(members))
    return FusedFilter(LinearTransition(F, Q), sensors, initial=MomentPrior(torch.zeros(2), torch.eye(2)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("delay", [0, 2])
def test_late_readings_with_certain_visibility(float64, kind, delay):
    td = frames(2, 9).rename_key_("observation", "late").rename_key_("observed", "late_observed")
    td["own"], td["own_observed"] = torch.randn(2, 9, 2), torch.rand(2, 9, 1) < 0.5
    told, masked = certain(td, "late_observed")
    heeding = lambda *args, **keys: Visible(KINDS[kind](*args, **keys), visible_key="visible")  # noqa: E731
    out = late(kind, analysis=heeding, delay=delay).sequence(told)
    expected = late(kind, analysis=KINDS[kind], delay=delay).sequence(masked)
    for key in (("belief", "mean"), ("belief", "var")):
        assert_close(out[key], expected[key], rtol=0, atol=1e-9)


def test_clones_and_present_share_one_mixture(float64):
    """The ensemble smoother's members of both, side by side; the present is the filter's own."""
    torch.manual_seed(0)
    members, analysis = torch.randn(12, 3), EnsembleAnalysis("etkf", observation_key="reading")
    td = TensorDict({"forecast": {"ensemble": members, "observation": members[:, :2], "past": torch.randn(12, 2, 3)}})
    td["reading"], td["sensor", "noise"] = torch.tensor([1.5, -1.0]), torch.tensor([0.4, 0.3])
    td["sensor", "visible"] = torch.tensor([0.3])
    lag = LaggedAnalysis(analysis)
    alone, mixed = lag(td.clone()), Visible(analysis).around(lag)(td.clone())
    both = [(td["forecast", "ensemble"], td["forecast", "past"])]
    both += [(out["belief", "ensemble"], out["forecast", "past"]) for out in (alone, mixed)]
    before, after, ours = (torch.cat([now, past.flatten(1)], -1) for now, past in both)
    q = mixed["info", "visible"]
    assert 0.05 < q < 0.95
    mean, cov = mix_moments(q, after.mean(0), after.T.cov(), before.mean(0), before.T.cov())
    assert_close(ours.mean(0), mean, rtol=0, atol=1e-10)
    assert_close(ours.T.cov(), cov, rtol=0, atol=1e-9)
    assert_close(mixed["belief", "ensemble"], Visible(analysis)(td.clone())["belief", "ensemble"], rtol=0, atol=1e-10)


@BOTH
@pytest.mark.parametrize(("make", "smoother"), [(linear_denkf, EnRTS), (linear_kalman, RTSSmoother)])
def test_smoothers_with_visibility(float64, make, smoother, share):
    out = smoother(WRAPPED[share](make()))(frames(2, 8))
    assert_close(out["smoothed", "mean"][:, -1], out["belief", "mean"][:, -1])


def test_gate_around_visibility_raises_for_particles():
    with pytest.raises(TypeError, match="no analysis that a gate goes around"):
        Gated(heeds(bootstrap(50)), 2)


# ------------------------------------------------------------------------------------------------- filters with a head


def learned(kind):
    """Returns a filter of two components; its sensor's reading tells half of what the head must know."""
    F, _, H, _ = linear_system()
    moves = torch.nn.Linear(2, 2, bias=False)
    moves.weight.data = F.clone()
    sensor = VectorSensor(4, 2, ensemble_size=8, num_cells=(16,), layer="none", in_key="measurement")
    head = Visibility(2, encoding_key=("sensor", "ensemble"))
    parts = LearnedTransition(moves, residual=False), sensor, LinearObservation(H)
    noise = DiagonalNoise(2, r=0.5)
    if kind in ("EKF", "UKF"):
        initial = MomentPrior(torch.zeros(2), torch.eye(2))
        make = {"EKF": EKF, "UKF": UKF}[kind]
        return make(*parts, noise, process_noise=0.3, initial=initial, visibility=head)
    initial = GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=8)
    options = {"process_noise": 0.3, "initial": initial, "visibility": head}
    if kind == "particles":
        return ParticleFilter(*parts, noise=noise, **options)
    return DEnKF(*parts, noise, **options)


LOSSES = {"DEnKF": DEnKFLoss, "EKF": GaussianLoss, "UKF": GaussianLoss, "particles": partial(MixtureLoss, score="crps")}


@pytest.mark.parametrize("kind", LOSSES)
def test_the_head_learns_from_labels_from_states_and_from_readings(kind):
    torch.manual_seed(0)
    filter = learned(kind)
    td = TensorDict({"measurement": torch.randn(3, 5, 4), "state": torch.randn(3, 5, 2)}, [3, 5])
    td["visible"] = torch.rand(3, 5, 1) < 0.5
    weights = {"visible": {"visible": 1.0}, "state": {"state": 1.0}, "nll": {"nll": 1.0}}
    for name, given in weights.items():
        others = dict.fromkeys(("state", "transition", "sensor"), 0.0)
        loss = LOSSES[kind](filter, **{**others, **given})
        values = loss(td)
        assert list(values.keys()) == [f"loss_{name}"]
        gradient = torch.autograd.grad(values[f"loss_{name}"], filter["visibility"].module.layers[-1].bias)[0]
        assert gradient.isfinite().all()
        assert gradient.abs() > 0


def test_labels_of_visibility_have_gaps():
    """Binary cross entropy, by hand; NaN and a mask of labels are gaps, and a sensor alone learns it, too."""
    torch.manual_seed(0)
    filter = learned("DEnKF")
    td = TensorDict({"measurement": torch.randn(3, 4), "state": torch.randn(3, 2)}, [3])
    p = filter[:2](td.clone())["sensor", "visible"].squeeze(-1)
    expected = -torch.stack([p[0].log(), (1 - p[1]).log()]).mean()
    numbers = td.clone().set("visible", torch.tensor([[1.0], [0.0], [torch.nan]]))
    marked = td.clone().set("visible", torch.tensor([[True], [False], [True]]))
    marked["visible_observed"] = torch.tensor([[True], [True], [False]])
    loss = SensorLoss(filter, sensor=0.0, visible=1.0)
    assert loss.in_keys == ["measurement", "visible"]
    for labelled in (numbers, marked):
        value = loss(labelled)["loss_visible"]
        assert_close(value, expected)
    none = loss(td.clone().set("visible", torch.full((3, 1), torch.nan)))["loss_visible"]
    assert none == 0
    assert all(
        gradient.isfinite().all() for gradient in torch.autograd.grad(value, list(filter["visibility"].parameters()))
    )
    assert "loss_visible" not in SensorLoss(filter)(td)


def test_a_fused_sensor_has_a_head_of_its_own(float64):
    torch.manual_seed(0)
    sensor = VectorSensor(4, 1, ensemble_size=7, layer="none", in_key="measurement")
    head = Visibility(1, encoding_key=("sensor", "ensemble"))

    def heeds_it(**keys):
        return Visible(EnsembleAnalysis("etkf", **keys), visible_key=("sensor", "camera", "visible"))

    sensors = {"gps": FusedSensor(Select([1]), [0.5])}
    sensors["camera"] = FusedSensor(Select([0]), [0.5], TensorDictSequential(sensor, head), analysis=heeds_it)
    moves = LearnedTransition(torch.nn.Linear(2, 2), residual=False)
    filter = FusedFilter(moves, sensors, initial=FixedEnsemble(torch.randn(7, 2)))
    out = filter.sequence(TensorDict({"measurement": torch.randn(2, 5, 4), "gps": torch.randn(2, 5, 1)}, [2, 5]))
    assert_close(out["sensor", "camera", "visible"], torch.full((2, 5, 1), 0.9))
    posterior = out["info", "camera", "visible"][:, 1:]
    assert ((posterior > 0) & (posterior != 0.9)).all()
