"""A part that is trained alone: its file, what a second call does, and which parameters a stage leaves out."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf.training import Stage
from torch_denkf.training.checkpoint import read_checkpoint
from torch_denkf.training.parts import train_part


def line_stage(net, updates=150):
    def loss(batch):
        return {"loss": (net(batch["x"]) - (3 * batch["x"] + 1)).square().mean()}

    def sample(generator, _):
        return TensorDict({"x": torch.rand(32, 1, generator=generator)}, [32])

    return Stage("line", loss, sample, updates, lr=0.2)


def test_a_part_is_trained_once_and_then_read(tmp_path):
    first = nn.Linear(1, 1)
    assert train_part(first, line_stage(first), out=tmp_path, device="cpu") is first
    assert first.weight.item() == pytest.approx(3.0, abs=0.05)
    assert first.bias.item() == pytest.approx(1.0, abs=0.05)
    saved = read_checkpoint(tmp_path / "line.pt")["line"]
    assert torch.equal(saved["weight"], first.weight)

    def never(generator, _):
        raise AssertionError("the part was trained already")

    again = nn.Linear(1, 1)
    train_part(again, Stage("line", lambda batch: {}, never, 150), out=tmp_path, device="cpu")
    assert torch.equal(again.weight, first.weight)
    assert torch.equal(again.bias, first.bias)
