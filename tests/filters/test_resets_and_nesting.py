"""Resets that update, policies' data, analyses inside sequences, marks in data: what a stranger composed first."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer

from tests.filters.beliefs_for_tests import ENSEMBLE, MEAN, VAR, close
from tests.filters.factories import FixedEnsemble, NoisyLinear, linear_denkf, linear_with, parts_of_reading
from torch_denkf.applications.car import UnicycleMotion, UnicycleTransition
from torch_denkf.applications.car.modules.pairs import PairObservation, with_history
from torch_denkf.filters import Filter
from torch_denkf.modules import AroundState, ConstantNoise, EnsembleAnalysis, Select
from torch_denkf.transforms import DEnKFTransform

# ------------------------------------------------------------------------------------------------ resets that update


@pytest.mark.parametrize("history", [False, True])
def test_an_update_at_a_reset_sees_nothing_of_the_episode_before(float64, history):
    """An update that reads the belief of t-1 itself, as UnicycleMotion does."""
    keys = {"history_key": ("belief", "history")} if history else {}
    start = AroundState([0.1] * 5, ensemble_size=6)
    analysis = {"observation_key": "y", "belief_prefix": "analysis"}
    if history:
        analysis |= {"forecast_key": ("forecast", "clone"), "observed_key": ("forecast", "observed")}
    filter = Filter(
        {
            "noise": ConstantNoise([0.3, 0.05], in_key="y"),
            "transition": UnicycleTransition(torch.zeros_like, dt=0.1),
            "observation": PairObservation() if history else Select([3, 4]),
            "analysis": EnsembleAnalysis("etkf", **analysis),
            "motion": UnicycleMotion(0.1, **keys),
        },
        initial=with_history(start, lags=2) if history else start,
        update_at_reset=True,
    )
    frames = TensorDict({"y": torch.randn(2, 8, 2), "state": 3 * torch.randn(2, 8, 5)}, [2, 8])
    frames["is_init"] = torch.zeros(2, 8, 1, dtype=torch.bool)
    frames["is_init"][:, [0, 4]] = True
    filter.draw_noise(frames)
    whole = filter.sequence(frames.copy())
    halves = torch.cat([filter.sequence(frames[:, :4].copy()), filter.sequence(frames[:, 4:].copy())], 1)
    close(whole, halves, filter.belief_keys)


# ------------------------------------------------------------------------------------------------ nested sequences


def blocks(**info):
    plain, prefixes = linear_denkf(), ["forecast", "mid", "belief"]
    noises, blocks = {}, {}
    for i, name in enumerate(["first", "second"]):
        keys = {"info_prefix": f"info{i}"} if info else {}
        parts = parts_of_reading(i, prefixes[i], prefixes[i + 1], **keys)
        noises[f"r{i}"], blocks[name] = parts[f"r{i}"], TensorDictSequential(parts[f"h{i}"], parts[f"a{i}"])
    return Filter({**noises, "transition": plain["transition"], **blocks}, initial=plain.initial)


def test_analyses_inside_sequences_count_all_or_raise(float64):
    with pytest.raises(ValueError, match="each its own info_prefix"):
        blocks()
    filter, both = blocks(named=True), linear_denkf()
    frames = TensorDict({"observation": torch.randn(3, 6, 2)}, [3, 6])
    frames.update({"y0": frames["observation"][..., :1], "y1": frames["observation"][..., 1:]})
    out, exact = filter.sequence(frames.copy()), both.sequence(frames.copy())
    close(out, exact, [MEAN, VAR])
    likelihood = sum(out[key] for key in filter.structure.likelihoods)
    torch.testing.assert_close(likelihood[:, 1:], exact["info", "log_likelihood"][:, 1:])


def test_a_belief_that_no_module_passes_on_raises():

    class WithBias(FixedEnsemble):
        def __init__(self, members):
            super().__init__(members)
            self.out_keys = [*self.out_keys, ("belief", "bias")]

        def compute(self, *, batch_size):
            return *super().compute(batch_size=batch_size), torch.zeros(*batch_size, 2)

    class Biased(NoisyLinear):
        def __init__(self):
            super().__init__(torch.eye(2))
            self.in_keys = [*self.in_keys, ("belief", "bias")]

        def compute(self, state, bias, *, noise):
            return state + bias.unsqueeze(-2)

    with pytest.raises(ValueError, match=r"'bias'.* no module writes"):
        linear_with({"transition": Biased()}, initial=WithBias(linear_denkf().initial.members))


def test_a_buffer_that_filters_before_its_slices_are_marked_raises():
    frames = TensorDict({"observation": torch.randn(80, 2), "episode": torch.arange(80) // 20}, [80])
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(80),
        sampler=SliceSampler(slice_len=5, traj_key="episode", cache_values=True),
        batch_size=20,
        transform=DEnKFTransform(linear_denkf()),
    )
    torch.manual_seed(0)
    buffer.extend(frames)
    with pytest.raises(ValueError, match="several sequences"):
        buffer.sample()


# ---------------------------------------------------------------------------------------------------- marks in data

ENDS = [("next", "done"), ("next", "truncated"), "done", ("next", "agents", "done"), ("next", "agents", "truncated")]


@pytest.mark.parametrize("mark", [*ENDS, ("agents", "is_init")])
def test_done_starts_the_next_episode_unless_is_init_is_given(float64, mark):
    """SliceSampler sets both; an environment's time limit alone ends nothing where is_init says so."""
    filter, frames = linear_denkf(), TensorDict({"observation": torch.randn(2, 9, 2)}, [2, 9])
    begins = torch.zeros(2, 9, 1, dtype=torch.bool)
    begins[:, 0] = begins[1, 4] = True
    marked = torch.zeros(2, 9, *[3] * ("agents" in mark), 1, dtype=torch.bool)
    marked[1, 4 if "is_init" in mark else 3].view(-1)[-1] = True  # of one agent
    data = frames.copy().set(mark, marked)
    close(filter.sequence(data.copy()), filter.sequence(frames.copy().set("is_init", begins)), [ENSEMBLE, MEAN])
    if mark[0] == "next":
        only = torch.zeros_like(begins)
        only[:, 0] = True
        close(filter.sequence(data.set("is_init", only)), filter.sequence(frames.copy()), [ENSEMBLE, MEAN])


def test_other_modules_make_a_new_filter():
    """The filter itself stays as it is, and the modules of both are the same except for the new one."""
    filter = blocks(named=True)
    frames = TensorDict({"y0": torch.randn(5, 1), "y1": torch.randn(5, 1)}, [5])
    before = filter.structure
    for place in ("third", "second.7", "second.1.network", "initial.mean", "nowhere.second", "second.nowhere.1"):
        with pytest.raises(KeyError, match=f"no module at '{place}'"):
            filter.with_modules({place: filter["second"]})
    with pytest.raises(ValueError, match="no module writes"):
        filter.with_modules(second=Select([0], out_key="elsewhere"))
    assert filter.structure.modules == before.modules
    masked = parts_of_reading(1, "mid", "belief", info_prefix="info1", observed_key="seen")["a1"]
    other = filter.with_modules({"second.1": masked})
    assert other["second"].module[1] is masked
    assert other["second"].module[0] is filter["second"].module[0]
    expected = filter.sequence(frames.copy())
    close(other.sequence(frames.copy()), expected, [MEAN])
    hidden = other.sequence(frames.set("seen", torch.zeros(5, 1, dtype=torch.bool)))  # its mask is read
    assert not hidden[MEAN].equal(expected[MEAN])


@pytest.mark.parametrize("left_out", [["y0"], ["y1"], ["y0", "y1"]])
def test_leaving_out_a_reading_equals_masking_it(float64, left_out):
    first, second = (
        parts_of_reading(i, *between, info_prefix=f"info{i}", observed_key=f"o{i}")[f"a{i}"]
        for i, between in enumerate([("forecast", "mid"), ("mid", "belief")])
    )
    filter = blocks(named=True).with_modules({"first.1": first, "second.1": second})
    frame = filter.initialise(TensorDict({"y0": torch.randn(3, 1), "y1": torch.randn(3, 1)}, [3]))
    hidden = {f"o{key[1]}": torch.zeros(3, 1, dtype=torch.bool) for key in left_out}
    masked = filter.step(frame.copy().update(hidden))
    close(filter.step(frame.exclude(*left_out), without=left_out), masked, [MEAN, VAR])
