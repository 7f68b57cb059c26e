"""Several analyses in one filter: their diagnostics, and readings of which one is missing."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

from tests.filters.beliefs_for_tests import ENSEMBLE, MEAN, VAR, close
from tests.filters.factories import linear_denkf, linear_system, linear_with, parts_of_reading, stepwise
from torch_denkf.filters import Filter
from torch_denkf.modules import SubModel

TOTALS = [("info", "nis"), ("info", "log_likelihood")]


pytestmark = pytest.mark.usefixtures("float64")


def readings(*batch):
    frames = TensorDict({"observation": torch.randn(*batch, 2)}, batch)
    return frames.update({f"y{i}": frames["observation"][..., i : i + 1] for i in (0, 1)})


def reads(parts):
    """Returns motion and initial belief of the linear system, and the sensors."""
    plain = linear_denkf()
    return Filter({"transition": plain["transition"], **parts}, initial=plain.initial)


@pytest.mark.parametrize("way", ["step", "sequence"])
def test_their_diagnostics_add_up_to_those_of_all_readings(way):
    """The chain rule: a density of two readings is that of one times that of the other, given the first."""
    both, seen = linear_denkf(), torch.rand(3, 8, 2) < 0.7
    masked = [{"observed_key": f"seen{i}"} for i in (0, 1)]
    parts = {**parts_of_reading(0, "forecast", "mid", **masked[0]), **parts_of_reading(1, "mid", "belief", **masked[1])}
    filter, frames = reads(parts), readings(3, 8)
    frames["is_init"] = torch.zeros(3, 8, 1, dtype=torch.bool)
    frames["is_init"][:, 0] = frames["is_init"][1, 4] = True
    expected = both.sequence(frames.copy().set("observed", seen))
    frames.update({f"seen{i}": seen[..., i : i + 1] for i in (0, 1)})
    out = stepwise(filter, frames) if way == "step" else filter.sequence(frames.copy())
    close(out, expected, [MEAN, VAR, *TOTALS], atol=1e-10)
    for name in ("nis", "log_likelihood"):
        own = [out["info", place, name] for place in ("a0", "a1")]
        close({name: sum(own)}, out["info"], [name])
        for i, value in enumerate(own):
            assert value.squeeze(-1).bool().equal(seen[..., i] & ~frames["is_init"].squeeze(-1))


def test_analyses_side_by_side_may_be_put_together():
    """Two analyses of one forecast, of whose beliefs a third module takes the middle: nothing is written over."""

    class Middle(SubModel):
        def __init__(self):
            super().__init__(nn.Identity(), [("one", "ensemble"), ("two", "ensemble")], [ENSEMBLE])

        def compute(self, one, two):
            return (one + two) / 2

    parts = {**parts_of_reading(0, "forecast", "one"), **parts_of_reading(1, "forecast", "two")}
    filter = reads({**parts, "middle": Middle()})
    td = filter.initialise(readings())
    single = [reads(parts_of_reading(i, "forecast", "belief")).step(td.copy()) for i in (0, 1)]
    close(filter.step(td), {ENSEMBLE: (single[0][ENSEMBLE] + single[1][ENSEMBLE]) / 2}, [ENSEMBLE])


def test_a_reading_goes_through_several_sensors():
    """The raw entry is the reading, however many modules are between it and the analysis; all of them are left out."""
    plain, (F, _, _, _) = linear_denkf(), linear_system()
    code = TensorDictModule(nn.Linear(2, 2), ["raw"], ["code"])
    sensor = TensorDictModule(nn.Tanh(), ["code"], ["observation"])
    filter = linear_with({"code": code, "sensor": sensor})
    assert filter.structure.readings == ("raw",)
    td = filter.initialise(TensorDict({}))
    close(filter.predict(td.copy()), {ENSEMBLE: td[ENSEMBLE] @ F.mT}, [ENSEMBLE])
    out = filter.step(td.copy().set("raw", torch.randn(2)))
    close(out, plain.step(td.copy().set("observation", out["observation"])), [ENSEMBLE])
