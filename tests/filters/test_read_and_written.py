"""An entry that a module both reads and writes is carried or raises; an unread mask raises."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

from tests.filters.factories import FixedEnsemble, NoisyLinear
from tests.filters.test_contract import FILTERS, every_filter
from torch_denkf.filters import Filter
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, LinearObservation, SubModel, VectorSensor
from torch_denkf.monitoring import BlackIsMissing
from torch_denkf.running import reads_of, writes


@every_filter
def test_entries_read_and_written_are_carried(name):
    filter = FILTERS[name]()
    modules = [module for _, module in filter.structure.modules]
    needed, optional = reads_of(modules)
    both = {*needed, *optional}.intersection(key for module in modules for key in writes(module))
    assert both <= set(filter.structure.carry)


def camera(*front, observed_key="observed", initial=None):
    """Returns a filter whose reading is the mean of a picture, with modules in front."""
    return Filter(
        {
            **dict(front),
            "sensor": VectorSensor(4, 1, ensemble_size=6, layer="none", in_key="flat"),
            "noise": ConstantNoise([0.5]),
            "transition": NoisyLinear(torch.eye(1)),
            "observation": LinearObservation(torch.eye(1)),
            "analysis": EnsembleAnalysis("etkf", observed_key=observed_key),
        },
        initial=FixedEnsemble(torch.linspace(-1, 1, 6).unsqueeze(-1)) if initial is None else initial,
    )


class Count(SubModel):
    """Counts frames in an entry of its own."""

    def __init__(self):
        super().__init__(nn.Identity(), ["flat", "count"], ["count"])

    def compute(self, flat, count):
        return count + 1


def test_custom_module_that_reads_and_writes_an_entry_raises():
    with pytest.raises(ValueError, match=r"'count' \(Count\) writes 'count', which the filter also reads from outside"):
        camera(("count", Count()))
    tally = TensorDictModule(lambda count: count + 1, ["count"], ["count"])
    with pytest.raises(ValueError, match=r"'tally' .*writes 'count'"):
        camera(("tally", TensorDictSequential(tally)))


@pytest.mark.parametrize("way", ["loop", "dictionary", "policy", "sequence"])
def test_one_black_picture_hides_one_reading(float64, way):
    """The oracle: the same pictures, and a mask written by hand."""
    torch.manual_seed(0)
    flat = torch.rand(2, 7, 4)
    flat[0, 2], flat[1, 4] = 0.0, 0.0
    frames = TensorDict({"flat": flat, "pixels": flat.reshape(2, 7, 1, 2, 2)}, [2, 7])
    torch.manual_seed(1)
    expected = camera().sequence(frames.copy().set("observed", flat.amax(-1, keepdim=True) > 0))
    torch.manual_seed(1)
    filter = camera(("black", BlackIsMissing()), observed_key="seen")
    assert (expected["belief", "mean"][0, 2] - expected["belief", "mean"][0, 1]).abs() < 1e-12, "it was hidden"
    assert (expected["belief", "mean"][0, 3:] - expected["belief", "mean"][0, 2:-1]).abs().min() > 1e-6
    if way == "sequence":
        out = filter.sequence(frames)["belief", "mean"]
    else:
        row, rows = filter.initialise(frames[:, 0].copy()), []
        rows.append(row["belief", "mean"])
        for t in range(1, 7):
            if way == "policy":
                now = row.copy().update(frames[:, t])  # what a step wrote stays there, as in torchrl's rollouts
                for key in filter.carry_keys:
                    now["previous", *key] = row[key]
                row = filter(now)
            else:
                row = filter.step(row.update(frames[:, t]))
            rows.append(row["belief", "mean"].clone())
        out = torch.stack(rows, 1)
    torch.testing.assert_close(out, expected["belief", "mean"], rtol=0, atol=1e-12)
