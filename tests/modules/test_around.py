"""A wrapper passes on all that the update inside declares, in any order of wrappers, and overrides what it changes."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import linear_denkf, linear_system
from torch_denkf.functional.manifolds import Circle, Euclidean
from torch_denkf.imperfect import Visible
from torch_denkf.modules import Around, EKFAnalysis, EnsembleAnalysis, KalmanAnalysis, LinearObservation, Update
from torch_denkf.monitoring import GatedAnalysis
from torch_denkf.running import random_parts
from torch_denkf.smoothers import FixedLag
from torch_denkf.smoothers.past import LaggedAnalysis, lagged
from torch_denkf.submodel import Call

E, S, WIDTH = 6, 2, 2
OWN = {"updates_ensemble", "aligned", "on_aligned"}  # of what goes around, a lag window and angles know nothing


class ScaledInnovation(Around):
    """Counts a share of each innovation of an ensemble."""

    def __init__(self, analysis, share):
        super().__init__(analysis)
        self.share = share

    def on_entries(self, entries, call):
        return self.run_inside({**entries, self.reading_keys[0]: self.scaled(entries, call)}, call)

    def scaled(self, entries, call):
        innovation = self.run_inside(entries, call)[self.info_prefix, "innovation"]
        return entries[self.reading_keys[0]] - (1 - self.share) * innovation


def frame():
    torch.manual_seed(0)
    forecast = {"ensemble": torch.randn(3, E, S), "past": torch.randn(3, E, 4, S)}
    forecast |= {"mean": torch.randn(3, S), "cov": torch.eye(S).expand(3, S, S)}
    forecast["observation"] = forecast["ensemble"] @ torch.tensor([[1.0, 0.5], [0.0, 1.0]])
    sensor = {
        "ensemble": torch.randn(3, WIDTH),
        "noise": torch.full((3, WIDTH), 0.5),
        "visible": torch.full((3, 1), 0.7),
    }
    return TensorDict({"forecast": forecast, "sensor": sensor, "observed": torch.rand(3, WIDTH) < 0.7}, [3])


def assert_equal(one, other):
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    for key in one.keys(True, True):
        torch.testing.assert_close(one[key], other[key], rtol=0, atol=0, equal_nan=True)


UPDATES = {
    "ensemble": lambda: EnsembleAnalysis("etkf"),
    "Kalman": lambda: KalmanAnalysis(torch.eye(S), torch.ones(WIDTH), observation_key=("sensor", "ensemble")),
    "EKF": lambda: EKFAnalysis(LinearObservation(torch.eye(S))),
    "perturbed, lagged": lambda: LaggedAnalysis(EnsembleAnalysis("perturbed")),
    "lagged": lambda: LaggedAnalysis(EnsembleAnalysis("etkf")),
    "visible, lagged": lambda: Visible(LaggedAnalysis(EnsembleAnalysis("etkf"))),
    "gate": lambda: GatedAnalysis(EnsembleAnalysis("etkf"), WIDTH, window=1),
    "gate, lagged": lambda: GatedAnalysis(LaggedAnalysis(EnsembleAnalysis("etkf")), WIDTH, window=1, by_component=True),
    "gate, Kalman": lambda: GatedAnalysis(UPDATES["Kalman"](), WIDTH),
}


@pytest.mark.parametrize("name", UPDATES)
def test_wrapper_passes_on_all_declarations(name):
    inside = UPDATES[name]()
    declared = {key for key in vars(Update) if not key.startswith("_")} - OWN
    assert {"reading_keys", "observed_key", "space", "reading_dims", "with_mask", "info_prefix"} <= declared
    around = Around(Around(inside))
    for key in [*declared, "in_keys", "out_keys", "optional_keys"]:
        assert getattr(around, key) == getattr(inside, key), key
    assert [*random_parts(around, "update")] == [*random_parts(inside, "update")]
    td = frame()
    if "gate" in name:
        td.update(dict(zip(inside.state_keys, inside.initial_state([3]), strict=True)))
    torch.manual_seed(1)
    expected = inside(td.copy())
    for other in (around, pickle.loads(pickle.dumps(around)), copy.deepcopy(around)):
        torch.manual_seed(1)
        assert_equal(other(td.copy()), expected)


def test_a_scaled_innovation_is_a_scaled_shift_of_the_mean():
    td = frame()
    analysis = EnsembleAnalysis("etkf")
    whole, half = analysis(td.copy()), ScaledInnovation(analysis, 0.5)(td.copy())
    before = td["forecast", "ensemble"].mean(-2)
    shift = whole["belief", "mean"] - before
    torch.testing.assert_close(half["belief", "mean"] - before, 0.5 * shift)


def test_entries_that_are_aligned_go_through_the_wrapper_all_the_same():
    """Aligns in front of a wrapper, hands on what it made, and gets what the wrapper makes, and not the inside."""
    around = ScaledInnovation(EnsembleAnalysis("etkf", reading_space=Euclidean(1) * Circle()), 0.5)
    td = frame()
    td["forecast", "observation"][..., 1] += torch.pi
    call, entries = Call(td.batch_size), dict(td.items(True, True))
    expected, found = around.on_entries(entries, call), around.on_aligned(around.aligned(entries), call)
    for key, value in expected.items():
        torch.testing.assert_close(found[key], value, equal_nan=True)
    assert not found["belief", "mean"].equal(around.run_inside(entries, call)["belief", "mean"])


@pytest.mark.parametrize("name", ["lagged", "visible, lagged"])
def test_lag_is_applied_inside_wrappers(name):
    """The lag window is corrected by what the wrapper makes of the reading."""
    plain = EnsembleAnalysis("etkf") if name == "lagged" else Visible(EnsembleAnalysis("etkf"))
    around = lagged(ScaledInnovation(plain, 0.5))
    assert isinstance(around, ScaledInnovation)
    assert set(around.in_keys) == set(UPDATES[name]().in_keys)
    td = frame()
    changed = td.copy().set(("sensor", "ensemble"), around.scaled(dict(td.items(True, True)), Call(td.batch_size)))
    expected = UPDATES[name]()(changed).set(("sensor", "ensemble"), td["sensor", "ensemble"])
    assert_equal(around(td), expected)
    with pytest.raises(TypeError, match="ScaledInnovation cannot correct earlier states"):
        LaggedAnalysis(ScaledInnovation(plain, 0.5))
    with pytest.raises(TypeError, match="ScaledInnovation does not say"):
        GatedAnalysis(ScaledInnovation(plain, 0.5), WIDTH)


def test_a_wrapper_in_a_filter_and_in_its_fixed_lag(float64):
    """A share of 1 changes nothing up to rounding, in a step, in a sequence and with a lag; noise keeps its place."""
    _, _, H, _ = linear_system()
    frames = TensorDict({"observation": torch.randn(3, 6, len(H)), "observed": torch.rand(3, 6, 1) < 0.8}, [3, 6])
    plain, around = linear_denkf("perturbed"), linear_denkf("perturbed")
    around = around.with_modules(analysis=ScaledInnovation(around["analysis"], 1.0))
    assert set(around.draw_noise(frames.copy())["noise"].keys()) == set(plain.draw_noise(frames.copy())["noise"].keys())
    for one, other in ((plain, around), (FixedLag(plain, 2), FixedLag(around, 2))):
        outs = []
        for filter in (one, other):
            torch.manual_seed(1)
            outs.append(filter.sequence(frames.copy()))
        for key in [("belief", "mean"), *([("smoothed", "mean")] if one is not plain else [])]:
            torch.testing.assert_close(outs[0][key], outs[1][key], rtol=1e-9, atol=1e-9)
        start = one.initialise(frames[:, 0].copy())
        moved = [filter.predict(start.copy())["belief", "mean"].shape for filter in (one, other)]
        assert moved[0] == moved[1]
