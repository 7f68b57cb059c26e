"""Steps and sequences on rows of tensors: the oracle is the same filter on tensordicts, bit for bit."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential

from tests.filters.factories import E, S, toy_denkf, toy_frames
from torch_denkf.filters import DEnKF
from torch_denkf.modules import (
    AroundState,
    ConstantNoise,
    EnsembleAnalysis,
    LearnedObservation,
    Select,
    StochasticMLP,
    UnicycleMotion,
    UnicycleTransition,
    WithHistory,
)
from torch_denkf.modules._row import Row, on_rows


class OnTensorDicts(LearnedObservation):
    """A sub-model with a forward of its own, which may use all of a TensorDict."""

    def forward(self, tensordict):
        tensordict["forecast", "observation"] = self.observe(tensordict["forecast", "ensemble"])
        return tensordict


def twin(filter, observation):
    """The same filter with another observation model of the same networks."""
    return DEnKF(
        filter["transition"],
        filter["sensor"],
        observation,
        filter["noise"],
        filter["analysis"],
        initial=filter.initial,
        update_at_reset=filter.update_at_reset,
    )


@pytest.mark.parametrize("layer", ["dropout", "flipout"])
@pytest.mark.parametrize("update_at_reset", [False, True])
@pytest.mark.parametrize("kind", ["sub-class", "plain module"])
def test_rows_are_tensordicts_bit_for_bit(layer, update_at_reset, kind):
    filter = toy_denkf("perturbed", layer, update_at_reset=update_at_reset)
    network = filter["observation"].module
    if kind == "sub-class":
        other = twin(filter, OnTensorDicts(network))
    else:
        other = twin(filter, TensorDictModule(network, [("forecast", "ensemble")], [("forecast", "observation")]))
    assert filter._make_recursion(False).on_rows
    assert not other._make_recursion(False).on_rows
    frames = filter.draw_noise(toy_frames((2, 7), masks=2))
    ours, theirs = filter.sequence(frames.copy()), other.sequence(frames.copy())
    ours_step, theirs_step = filter.step(ours[:, 3].copy()), other.step(ours[:, 3].copy())
    for key in filter.out_keys:
        assert ours.get(key).equal(theirs.get(key)), key
        assert ours_step.get(key).equal(theirs_step.get(key)), key


def test_only_opened_sequences_of_willing_modules_run_on_rows():
    filter = toy_denkf()
    parts = [filter["transition"], TensorDictSequential(filter["observation"], filter["analysis"])]
    plan = on_rows(parts)
    assert plan.modules == (filter["transition"], filter["observation"], filter["analysis"])
    assert ("belief", "ensemble") in plan.reads
    assert ("forecast", "ensemble") not in plan.reads, "the transition writes it before anybody reads it"
    assert on_rows([OnTensorDicts(filter["observation"].module)]) is None


def test_a_hook_sees_a_tensordict():
    filter, seen = toy_denkf(), []
    td = filter.initialise(toy_frames((2,), masks=0, resets=False))
    handle = filter["observation"].register_forward_hook(lambda module, args, out: seen.append(type(out)))
    filter.step(td.copy())
    filter.sequence(toy_frames((2, 3)))
    assert set(seen) == {TensorDict}
    handle.remove()
    filter.step(td.copy())
    assert filter._plan is not None


def test_a_replaced_module_is_used():
    filter = toy_denkf()
    td = filter.initialise(toy_frames((2,), masks=0, resets=False))
    filter.step(td.copy())
    filter.module["observation"] = Select([0, 1])
    out = filter.step(td.copy())
    assert out["forecast", "observation"].equal(out["forecast", "ensemble"][..., :2])


def test_a_missing_entry_names_itself_and_what_is_there():
    filter = toy_denkf(action=True)
    td = filter.initialise(toy_frames((2,), masks=0, resets=False)).set("elsewhere", torch.zeros(2, 1))
    with pytest.raises(KeyError, match=r"'action', which the tensordict lacks.*elsewhere"):
        filter.step(td.exclude("action"))
    with pytest.raises(KeyError, match="carries its belief"):
        filter.step(td.exclude("belief"))


def test_what_does_not_fit_the_batch_is_refused():
    row = Row({"a": torch.zeros(3, 1)}, torch.Size([2]))
    with pytest.raises(RuntimeError, match="batch dimension mismatch"):
        row.write(TensorDict({}, [2]), ["a"])
    locked = TensorDict({}, [3]).lock_()
    with pytest.raises(RuntimeError, match="locked"):
        Row({"a": torch.zeros(3, 1)}, torch.Size([3])).write(locked, ["a"])


def test_a_filter_that_has_run_is_copied_and_pickled():
    filter = toy_denkf()
    frames = filter.draw_noise(toy_frames((2, 4)))
    td = filter.initialise(frames[:, 0].copy())
    expected = filter.step(td.copy())["belief", "mean"]
    for other in (copy.deepcopy(filter), pickle.loads(pickle.dumps(filter))):
        assert other.step(td.copy())["belief", "mean"].equal(expected)
        with torch.no_grad():
            other["observation"].module.layers[-1].bias += 1.0
        assert not other.step(td.copy())["belief", "mean"].equal(expected), "it runs its own modules"
    assert filter.step(td.copy())["belief", "mean"].equal(expected)
    assert expected.shape == (2, S)
    assert td["belief", "ensemble"].shape == (2, E, S)


def test_a_vehicle_with_history_is_the_same_on_rows():
    filter = DEnKF(
        transition=UnicycleTransition(StochasticMLP(2, 2, (8,)), dt=0.1, history_key=("belief", "history")),
        sensor=None,
        observation=Select([3, 4]),
        noise=ConstantNoise([0.3, 0.1], in_key="reading"),
        analysis=TensorDictSequential(
            EnsembleAnalysis("sakov", sensor_key="reading", belief_key="analysis"), UnicycleMotion(0.1)
        ),
        initial=WithHistory(AroundState([0.1, 0.1, 0.1, 1.0, 0.2], ensemble_size=6), lags=2),
    )
    frames = TensorDict({"reading": torch.randn(2, 6, 2), "state": torch.randn(2, 6, 5)}, [2, 6])
    filter.draw_noise(frames)
    assert filter._make_recursion(False).on_rows
    ours = filter.sequence(frames.copy())
    handle = filter["observation"].register_forward_hook(lambda *_: None)
    assert not filter._make_recursion(False).on_rows
    theirs = filter.sequence(frames.copy())
    handle.remove()
    for key in filter.out_keys:
        assert ours.get(key).equal(theirs.get(key)), key
