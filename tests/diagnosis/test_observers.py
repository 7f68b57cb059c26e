"""Observers see each run of a filter before anything is written; they go with its copies."""

import warnings

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.modules import set_recurrent_mode

from tests.filters.factories import Perturbed, linear_denkf, linear_kalman, linear_system
from torch_denkf.envs import LinearGaussianEnv
from torch_denkf.filters.finish import Record
from torch_denkf.transforms import DEnKFTransform

MEAN = ("belief", "mean")
WAYS = ("step", "sequence", "policy", "environment")


class Seen:
    """An observer that counts, and raises if it is told to."""

    def __init__(self):
        self.ways, self.records, self.raises = WAYS, [], False

    def __call__(self, filter, record):
        self.records.append((record, [key for key in filter.out_keys if key in record.tensordict.keys(True, True)]))
        if self.raises:
            raise RuntimeError("stop")


def frames(*batch):
    return TensorDict({"observation": torch.randn(*batch, 2)}, batch)


def environment(*transforms):
    F, Q, H, R = linear_system()
    env = TransformedEnv(LinearGaussianEnv(F, H, Q.diag().sqrt(), R.sqrt(), batch_size=[2]))
    for transform in transforms:
        env.append_transform(transform)
    return env


def actor():
    return TensorDictModule(lambda mean: mean[..., :1], [MEAN], ["action"])


def run(filter, way):
    """Runs a filter in a way, and returns how often it must have been seen."""
    if way == "step":
        row = filter.initialise(frames(2))
        for _ in range(3):
            row = filter.step(row)
        return 3
    if way == "sequence":
        filter.sequence(frames(2, 5))
        with set_recurrent_mode(True):
            filter(frames(2, 4))
        return 2
    if way == "policy":
        environment(InitTracker(), filter.make_tensordict_primer()).rollout(6, TensorDictSequential(filter, actor()))
        return 6
    environment(DEnKFTransform(filter)).rollout(4, actor())
    return 4


@pytest.mark.parametrize(
    ("make", "chunk", "way"),
    [(make, 0, way) for make in (linear_kalman, linear_denkf) for way in WAYS] + [(linear_kalman, 2, "sequence")],
)
def test_a_run_is_seen_once(make, chunk, way):
    filter, seen = make().compile(chunk=chunk, backend="eager"), Seen()
    filter.observers.append(seen)
    count = run(filter, way)
    assert len(seen.records) == count
    for record, _ in seen.records:
        assert isinstance(record, Record)
        assert record.way == way
        assert record.entries["observation"].shape[0] == record.written[MEAN].shape[0] == 2
        assert record.written[MEAN].ndim == 2 + (way == "sequence")
        assert (record.env is not None) == (way == "environment")


@pytest.mark.parametrize("way", ["step", "sequence", "policy"])
def test_raising_observer_leaves_the_tensordict_unchanged(way):
    filter, seen = linear_kalman(), Seen()
    filter.observers, seen.raises = [seen], True
    td = frames(2, 5) if way == "sequence" else filter.initialise(frames(2))
    before = td.clone()
    names = {"step": filter.step, "sequence": filter.sequence, "policy": filter}
    with pytest.raises(RuntimeError, match="stop"):
        names[way](td)
    assert set(td.keys(True, True)) == set(before.keys(True, True))
    assert all(td[key].equal(value) for key, value in before.items(True, True))


# -------------------------------------------------------------------------------------------- the default observers


def masked(filter):
    """Runs that warn of a mask that is not read."""
    hidden = frames(2, 3).set("observed", torch.zeros(2, 3, 1, dtype=torch.bool))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        filter.sequence(hidden.copy())
        filter.step(filter.initialise(hidden[:, 0].copy()))
    return [str(one.message) for one in said]


def blind():
    return linear_denkf("perturbed", noisy=True).with_modules(analysis=Perturbed())


def test_clearing_the_observers_silences_all():
    filter = blind()
    filter.observers.clear()
    assert masked(filter) == []
    several = frames(2, 3, 4).select("observation")  # not of one robot: an observer would raise
    row = linear_kalman().initialise(frames(2)).set("observation", several["observation"][:, 0])
    with pytest.raises(ValueError, match="too many"):
        linear_kalman().step(row.copy())
    quiet = linear_kalman(variance_ceiling=1.0)
    quiet.observers.clear()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        quiet.step(row)
        environment(DEnKFTransform(quiet)).rollout(3, TensorDictSequential(quiet, actor()))


def test_a_filter_of_other_modules_or_options_has_the_observers():
    filter, seen = linear_kalman(), Seen()
    filter.observers = [seen]
    for other in (filter.with_options(update_at_reset=True), filter.with_modules(initial=filter.initial)):
        other.step(other.initialise(frames(2)))
        other.observers.clear()
    assert len(seen.records) == 2
    assert filter.observers == [seen]


# ------------------------------------------------------------------------------------------------------------- hooks


@pytest.mark.parametrize("make", [linear_kalman, lambda: linear_denkf("perturbed", noisy=True)])
@pytest.mark.parametrize("way", ["step", "sequence"])
def test_a_hook_is_called_once_a_step(make, way):
    """The trial step that finds the sizes of noise calls none."""
    filter, calls = make(), {}
    for place in ("transition", "analysis"):
        calls[place] = []
        filter[place].register_forward_hook(lambda module, read, out, place=place: calls[place].append(out.batch_size))
        filter[place].register_forward_pre_hook(lambda module, read, place=place: calls[place].append("before"))
    start = []
    filter.initial.register_forward_hook(lambda module, read, out: start.append(out.batch_size))
    if way == "sequence":
        filter.sequence(frames(2, 5))
        filter.sequence(frames(2, 5))
        assert calls == dict.fromkeys(calls, ["before", torch.Size([2])] * 10)
        assert start == [torch.Size([2, 1])] * 2
        return
    row = filter.initialise(frames(2))
    for _ in range(3):
        filter.step(row)
    filter.draw_noise(frames(2, 3))
    assert calls == dict.fromkeys(calls, ["before", torch.Size([2])] * 3)
    assert start == [torch.Size([2])]
