"""Steps recorded in graphs; on a processor a stand-in reruns the function on the same memory."""

import pickle
from copy import deepcopy

import pytest
import torch

from tests.filters.factories import toy_denkf, toy_frames
from tests.filters.gaussian_for_tests import linear_filter, linear_frames
from tests.filters.test_contract import every_filter, with_noise
from torch_denkf.compilation import CapturedSteps


class Rerun:
    """Stands for a CUDA graph: a replay runs the function again on the same memory."""

    waiting = ()
    recorded = 0

    def __init__(self, device):
        self.device = device

    def waits(self, run):
        run()
        return list(self.waiting)

    def record(self, run):
        type(self).recorded += 1
        return run


@pytest.fixture
def reruns(monkeypatch):
    monkeypatch.setattr(CapturedSteps, "recorder", Rerun)
    monkeypatch.setattr(Rerun, "recorded", 0)
    return Rerun


def gradients(filter, frames, **kwargs):
    out = filter.sequence(frames.copy(), **kwargs)
    trained = [value for value in filter.parameters() if value.requires_grad]
    values = torch.autograd.grad(out["belief", "mean"].square().sum(), trained, allow_unused=True)
    return out, [value for value in values if value is not None]


def assert_same(ours, theirs, atol=1e-12):
    for value, expected in zip(ours, theirs, strict=True):
        torch.testing.assert_close(value, expected, rtol=0, atol=atol)


def pair(**kwargs):
    """Returns an eager filter, and the same recorded."""
    eager = toy_denkf("perturbed", **kwargs).double()
    return eager, pickle.loads(pickle.dumps(eager)).compile(mode="graph")


def noisy_frames(filter, *batch):
    frames = toy_frames(batch, masks=2).apply(lambda value: value.double() if value.is_floating_point() else value)
    return filter.draw_noise(frames)


@pytest.mark.parametrize("chunk", [None, 3])
def test_recorded_is_eager_forward_and_backward(float64, reruns, chunk):
    eager, graph = pair()
    graph.compile(mode="graph", chunk=chunk)
    frames = noisy_frames(eager, 2, 7)
    (expected, theirs), (out, ours) = gradients(eager, frames), gradients(graph, frames)
    assert reruns.recorded > 0
    assert_same([out[key] for key in graph.out_keys], [expected[key] for key in graph.out_keys])
    assert_same(ours, theirs)
    row = expected[:, 2].detach()
    with torch.no_grad():
        assert_same(graph.step(row.copy())["belief"].values(), eager.step(row.copy())["belief"].values())


def test_one_compiled_step_is_recorded_as_often_as_the_sequence_is_long(float64, reruns):
    torch._dynamo.reset()
    torch._dynamo.utils.counters.clear()
    eager = linear_filter("BackpropKF", trainable=True)
    graph, frames = deepcopy(eager).compile(mode="graph", backend="aot_eager"), linear_frames(2, 5)
    frames["is_init"] = torch.zeros(2, 5, 1, dtype=torch.bool)
    frames["is_init"][1, 3] = True
    (expected, theirs), (out, ours) = gradients(eager, frames), gradients(graph, frames)
    assert_same([out[key] for key in graph.out_keys], [expected[key] for key in graph.out_keys])
    assert_same(ours, theirs)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == 1
    ours, theirs = (model.sequence(frames.copy(), detach_every=2)["belief", "mean"] for model in (graph, eager))
    assert_same(
        *(torch.autograd.grad(mean.sum(), list(m.parameters())) for mean, m in ((ours, graph), (theirs, eager)))
    )
    row = expected[:, 2].detach()
    with torch.no_grad():
        assert_same(graph.step(row.copy())["belief"].values(), eager.step(row.copy())["belief"].values())


@every_filter
def test_every_filter_recorded_is_eager(float64, reruns, name):
    filter, frames = with_noise(name, 3, 5, width=2)
    frames["observation"].requires_grad_()
    outs = []
    for chunk in (0, None):
        out = filter.compile(mode="graph", chunk=chunk).sequence(frames.copy())
        torch.manual_seed(0)
        step = filter.step(out[:, 3].select(*filter.carry_keys, *frames.keys()).exclude("noise"))
        found = torch.autograd.grad(out["belief", "mean"].square().sum(), frames["observation"])
        outs.append([*(out[key] for key in filter.belief_keys), *(step[key] for key in filter.belief_keys), *found])
    assert reruns.recorded > 2
    assert_same(*outs, atol=1e-11)


def test_changed_and_moved_weights_are_read_again(float64, reruns):
    eager, graph = pair()
    frames = noisy_frames(eager, 2, 4)
    for change in (
        lambda model: None,
        lambda model: [p.data.mul_(1.1) for p in model.parameters()],
        lambda model: model.load_state_dict({key: 0.9 * value for key, value in model.state_dict().items()}),
        lambda model: [setattr(p, "data", p.data.clone()) for p in model.parameters()],
        lambda model: next(model.parameters()).requires_grad_(False),
    ):
        change(eager), change(graph)
        (expected, theirs), (out, ours) = gradients(eager, frames), gradients(graph, frames)
        assert_same([out["belief", "mean"]], [expected["belief", "mean"]])
        assert_same(ours, theirs)


def test_two_sequences_before_one_backward_pass_keep_their_own(float64, reruns):
    eager, graph = pair()
    both = [noisy_frames(eager, 2, 4) for _ in range(2)]
    outs = []
    for model in (eager, graph):
        loss = sum(model.sequence(frames.copy())["belief", "mean"].square().sum() for frames in both)
        outs.append(torch.autograd.grad(loss, list(model.parameters())))
    assert_same(*outs)


def test_training_records_once_though_the_last_loss_is_kept(float64, reruns):
    _, graph = pair()
    frames, optimiser = noisy_frames(graph, 2, 4), torch.optim.SGD(graph.parameters(), lr=1e-3)
    recorded = []
    for _ in range(4):
        optimiser.zero_grad()
        loss = graph.sequence(frames.copy())["belief", "mean"].square().sum()  # the last one goes only now
        loss.backward()
        optimiser.step()
        recorded.append(reruns.recorded)
    assert recorded[1] == recorded[-1]
    retained = graph.sequence(frames.copy())["belief", "mean"].square().sum()
    first = torch.autograd.grad(retained, list(graph.parameters()), retain_graph=True)
    graph.sequence(noisy_frames(graph, 2, 4))
    assert_same(torch.autograd.grad(retained, list(graph.parameters())), first)


def test_running_means_count_each_sequence_once(float64, reruns):
    def normalise(network, args):
        network.norm(args[0][..., :3].flatten(0, -2))

    found, frames = [], None
    for model in pair():
        network = model["transition"].module
        network.register_module("norm", torch.nn.BatchNorm1d(3, dtype=torch.float64))
        network.register_forward_pre_hook(normalise)
        frames = noisy_frames(model, 2, 4) if frames is None else frames
        for _ in range(2):
            model.sequence(frames.copy())
        found.append([network.norm.running_mean, network.norm.num_batches_tracked])
    assert found[0][1] == 8
    assert_same(*found)


def test_device_synchronisation_runs_eagerly_with_a_warning(float64, reruns, monkeypatch):
    monkeypatch.setattr(reruns, "waiting", ("somewhere.py:7",))
    eager, graph = pair()
    frames = noisy_frames(eager, 2, 3)
    with pytest.warns(UserWarning, match=r"run eagerly.*somewhere\.py:7"):
        out, ours = gradients(graph, frames)
    expected, theirs = gradients(eager, frames)
    assert_same([out["belief", "mean"]], [expected["belief", "mean"]])
    assert_same(ours, theirs)
    assert not reruns.recorded
