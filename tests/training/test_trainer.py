"""Oracles: a training loop written out by hand, the maximum of a closed-form likelihood, scripted validations."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.record.loggers import CSVLogger
from torchrl.trainers import ClearCudaCache, CountFramesLog, EarlyStopping, LogScalar

from tests.training.problem import make_trainer
from torch_denkf.training import FilterTrainer, Stage
from torch_denkf.training.checkpoint import read_checkpoint
from torch_denkf.training.update import seed_update


def rows(out, name):
    lines = (out / "logs" / "csv" / "scalars" / f"{name}.csv").read_text().split()
    return [(int(step), float(value)) for step, value in (line.split(",") for line in lines)]


def line_stage(net, name="fit", updates=6, spoil=(), **kwargs):
    """Least squares on random points; the batches of the updates in ``spoil`` hold a NaN."""
    drawn = iter(range(10**6))

    def sample(generator, length):
        x = torch.randn(8, 2, generator=generator)
        if next(drawn) in spoil:
            x[0, 0] = torch.nan
        return TensorDict({"x": x, "y": x.sum(-1, keepdim=True) + torch.rand(8, 1)}, [8])

    def loss(batch):
        error = net(batch["x"]) - batch["y"]
        return {"loss_square": error.square().mean(), "loss_bias": net.bias.square().sum(), "largest": error.max()}

    return Stage(name, loss, sample, updates, **kwargs)


def by_hand(stage, net, seed, number=0, spoil=()):
    """Returns the loop of examples/quickstart.py; returns the terms of every update."""
    optimiser = torch.optim.AdamW(net.parameters(), lr=stage.lr, weight_decay=stage.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, stage.lr, total_steps=stage.updates)
    seen = []
    for update in range(stage.updates):
        batch = stage.sample(seed_update(seed, number, update), None)
        if update in spoil:
            continue
        terms = stage.loss(batch)
        optimiser.zero_grad()
        (terms["loss_square"] + terms["loss_bias"]).backward()
        norm = nn.utils.clip_grad_norm_(net.parameters(), stage.clip)
        seen.append({**{k: v.item() for k, v in terms.items()}, "grad_norm": norm.item()})
        seen[-1]["lr"] = optimiser.param_groups[0]["lr"]
        optimiser.step()
        schedule.step()
    return seen


@pytest.mark.parametrize("spoil", [(), (0,), (2, 3)])
def test_trainer_equals_a_plain_loop(tmp_path, spoil, caplog):
    net, twin = nn.Linear(2, 1), nn.Linear(2, 1)
    twin.load_state_dict(net.state_dict())
    options = {"lr": 0.1, "weight_decay": 0.2, "clip": 0.5}
    trainer = FilterTrainer(
        net, [line_stage(net, spoil=spoil, **options)], out=tmp_path, seed=3, log_every=3, device="cpu", save_every=4
    )
    with caplog.at_level("WARNING", "torch_denkf"):
        result = trainer.fit()["fit"]
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == bool(spoil), "it is said once"
    assert all(
        f"'fit', update {spoil[0] + 1} is left out" in text and "['x', 'y'] of its batch" in text for text in messages
    )
    seen = by_hand(line_stage(twin, spoil=spoil, **options), twin, 3, spoil=spoil)
    for one, other in zip(net.parameters(), twin.parameters(), strict=True):
        # clip_grad_norm_ and its two halves multiply in the same order
        torch.testing.assert_close(one, other, rtol=0, atol=0)
    assert result == {
        "value": None, "update": 6, "metrics": {}, "path": tmp_path / "best_fit.pt", "skipped": len(spoil)
    }  # fmt: skip
    assert all(step["grad_norm"] > 0.5 for step in seen[:2])  # so that clipping is at work
    made = [update for update in range(6) if update not in spoil]
    for name in ("loss_square", "loss_bias", "largest", "grad_norm"):
        for (step, value), window in zip(rows(tmp_path, f"fit/{name}"), ((0, 1, 2), (3, 4, 5)), strict=True):
            values = [terms[name] for update, terms in zip(made, seen, strict=True) if update in window]
            assert step == window[-1] + 1
            assert value == pytest.approx(sum(values) / len(values), rel=1e-6)  # single precision
    assert rows(tmp_path, "fit/lr")[-1] == (6, pytest.approx(seen[-1]["lr"], rel=1e-12))
    assert rows(tmp_path, "fit/skipped") == [(3, sum(u < 3 for u in spoil)), (6, len(spoil))]
    square, bias, total = (rows(tmp_path, f"fit/{name}") for name in ("loss_square", "loss_bias", "loss"))
    assert [v for _, v in total] == pytest.approx([a + b for (_, a), (_, b) in zip(square, bias, strict=True)])


def test_too_many_that_are_not_finite(tmp_path):
    net = nn.Linear(2, 1)
    stage = line_stage(net, "spoilt", updates=20, spoil=range(5, 20))
    trainer = FilterTrainer(net, [stage], out=tmp_path, device="cpu", save_every=1, max_skipped=3)
    with pytest.raises(FloatingPointError, match=r"Stage 'spoilt', update 9: .* in 4 updates in a row"):
        trainer.fit()
    state = read_checkpoint(tmp_path / "last.pt")
    assert (state["update"], state["updates"]["in_a_row"]) == (8, 3)
    twin = nn.Linear(2, 1)
    twin.load_state_dict(state["model"])
    assert all(torch.equal(one, other) for one, other in zip(net.parameters(), twin.parameters(), strict=True))
    assert all(torch.isfinite(p).all() and p.requires_grad for p in net.parameters())


def test_stages_freeze_and_hand_on(tmp_path):
    trainer = make_trainer(tmp_path, updates=3, keep="last")
    denkf = trainer.model
    start = {name: value.clone() for name, value in denkf.state_dict().items()}
    trainer.fit()
    after = {
        name: read_checkpoint(tmp_path / f"best_{name}.pt")["model"] for name in ("sensor", "filter", "end_to_end")
    }
    own = {id(parameter) for parameter in denkf["sensor"].parameters()}
    sensor = {name for name, parameter in denkf.named_parameters() if id(parameter) in own}
    rest = {name for name, _ in denkf.named_parameters()} - sensor
    assert sensor
    assert rest
    moved = lambda a, b: {name for name, _ in denkf.named_parameters() if not torch.equal(a[name], b[name])}  # noqa: E731
    assert moved(start, after["sensor"]) == sensor
    assert moved(after["sensor"], after["filter"]) == rest
    assert moved(after["filter"], after["end_to_end"]) == sensor | rest
    assert all(p.requires_grad and p.grad is None for p in denkf.parameters())
    assert rows(tmp_path, "end_to_end/length") == [(2, 2.0), (3, 4.0)]


@pytest.mark.parametrize(("keep", "best", "handed_on"), [("best", 4, 4), ("last", 6, 6)])
def test_the_best_is_kept(tmp_path, keep, best, handed_on):
    net, weights, errors = nn.Linear(2, 1), [], iter([5.0, 3.0, 1.0, float("nan"), 0.5, 0.7])

    def validate():
        assert not net.training
        assert not torch.is_grad_enabled()
        weights.append(net.weight.clone())
        return {"error": next(errors), "other": torch.tensor(-7.0)}

    own = {"validate": lambda: {"own": net.weight.sum()}, "monitor": "own"}
    stages = [line_stage(net, "first"), line_stage(net, "second", updates=2, **own)]
    trainer = FilterTrainer(
        net, stages, out=tmp_path, device="cpu", validate=validate, validate_every=2, monitor="error", keep=keep
    )
    results = trainer.fit()
    assert net.training
    assert len(weights) == 4
    assert results["first"]["update"] == best
    assert results["first"]["metrics"]["other"] == -7.0
    if keep == "best":
        assert results["first"]["value"] == 1.0
    assert torch.equal(read_checkpoint(results["first"]["path"])["model"]["weight"], weights[handed_on // 2])
    assert rows(tmp_path, "second/validation/own")[0] == (0, pytest.approx(weights[handed_on // 2].sum().item()))
    assert [step for step, _ in rows(tmp_path, "first/validation/error")] == [0, 2, 4, 6]
    last = read_checkpoint(results["second"]["path"])
    assert torch.equal(last["model"]["weight"], net.weight)
    assert results["second"]["value"] == pytest.approx(net.weight.sum().item())


@pytest.mark.parametrize(
    ("errors", "keep", "said"),
    [
        (
            [5.0, 6.0, 7.0, 8.0],
            "best",
            "gained nothing: the error is 5 as before it. Likely: lr=0.002 is too high",
        ),
        ([5.0, 4.99, 7.0, 8.0], "best", "the error is 4.99, and 5 before it. Likely: lr=0.002 is too low"),
        (
            [5.0, 4.0, 3.0, 6.0],
            "last",
            "made the error worse, 5 to 6. Likely: lr=0.002 is too high; windows of 4",
        ),
        ([5.0, 4.0, 3.0, 6.0], "best", ""),
    ],
)
def test_a_stage_that_gained_nothing_is_said_and_why_that_is_likely(tmp_path, caplog, errors, keep, said):
    net, errors = nn.Linear(2, 1), iter(errors)
    stage = line_stage(net, lengths={0: 2, 2: 4})
    options = {"validate": lambda: {"error": next(errors)}, "validate_every": 2, "keep": keep}
    with caplog.at_level("WARNING", "torch_denkf"):
        FilterTrainer(net, [stage], out=tmp_path, device="cpu", **options).fit()
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == bool(said)
    assert said in "".join(messages)


def test_validation_leaves_the_training_alone(tmp_path):
    finals, first = [], nn.Linear(2, 1)
    for draws in (0, 5):
        net, seen = copy.deepcopy(first), []

        def validate(draws=draws, seen=seen):
            seen.append(torch.rand(draws + 1).sum().item())
            return {"error": 1.0}

        out = tmp_path / str(draws)
        FilterTrainer(
            net, [line_stage(net)], out=out, device="cpu", validate=validate, validate_every=1 + draws, keep="last"
        ).fit()
        assert len(seen) > 1
        assert len(set(seen)) == 1  # the same numbers each time
        finals.append(net.weight.detach())
    assert torch.equal(*finals)


def test_hooks_of_torchrl(tmp_path, capfd):
    net, calls = nn.Linear(2, 1), []
    own = CSVLogger("own", log_dir=str(tmp_path))
    trainer = FilterTrainer(net, [line_stage(net)], out=tmp_path, device="cpu", log_every=3, loggers=("csv", own))
    counter = CountFramesLog(frame_skip=1)
    counter.register(trainer, "counter")
    LogScalar("y", "mean_y").register(trainer)
    ClearCudaCache(interval=2).register(trainer)
    trainer.register_op("process_optim_batch", lambda batch: batch[:5])
    trainer.register_op("post_optim", lambda: calls.append(net.weight.grad.norm().item()))
    with pytest.raises(ValueError, match="no place 'post_steps_log' for a hook; it has 'pre_optim_steps'"):
        EarlyStopping(monitor="loss").register(trainer)
    trainer.fit()
    assert len(calls) == 6
    assert rows(tmp_path, "fit/n_frames") == [(3, 5.0), (6, 10.0)]
    stage = line_stage(net)
    expected = [stage.sample(seed_update(0, 0, update), None)["y"][:5].mean().item() for update in (2, 5)]
    assert [value for _, value in rows(tmp_path, "fit/mean_y")] == pytest.approx(expected)
    state = read_checkpoint(trainer.last_checkpoint)["hooks"]
    assert state["counter"] == counter.state_dict()
    assert (tmp_path / "own/scalars/fit/loss.csv").read_text() == (
        tmp_path / "logs/csv/scalars/fit/loss.csv"
    ).read_text()
    assert capfd.readouterr() == ("", "")  # no bar where no terminal is


LOSSES = {
    "no loss": (lambda net, x: {"error": net(x).mean()}, 'starts with "loss"'),
    "a loss of rows": (lambda net, x: {"loss": net(x)}, r"'loss' is \[8, 1\]"),
    "a loss of no parameter": (lambda net, x: {"loss": x.sum()}, "does not depend on the parameters"),
}


@pytest.mark.parametrize("what", LOSSES)
def test_losses_that_are_none(what, tmp_path):
    net, (loss, match) = nn.Linear(2, 1), LOSSES[what]
    stage = Stage("fit", lambda batch: loss(net, batch["x"]), line_stage(net).sample, 1)
    with pytest.raises(ValueError, match=match):
        FilterTrainer(net, [stage], out=tmp_path, device="cpu").fit()


def test_two_stages_of_a_name(tmp_path):
    net = nn.Linear(2, 1)
    with pytest.raises(ValueError, match="name of its own"):
        FilterTrainer(net, [line_stage(net)] * 2, out=tmp_path, device="cpu")


def test_a_monitor_that_is_not_validated(tmp_path):
    net = nn.Linear(2, 1)
    options = {"validate": lambda: {"error": 0.0}, "monitor": "mse", "out": tmp_path, "device": "cpu"}
    with pytest.raises(KeyError, match=r"monitor='mse' is none of \['error'\]"):
        FilterTrainer(net, [line_stage(net)], **options).fit()
