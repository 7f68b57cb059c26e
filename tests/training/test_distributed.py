"""Two real processes, as ``torchrun`` starts them, against one process on the batches of both."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.training.problem import make_trainer
from torch_denkf.training.update import seed_update

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def ranks(tmp_path_factory):
    out = tmp_path_factory.mktemp("two")
    command = [sys.executable, "-m", "tests.training.two_processes", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return [torch.load(out / f"rank_{rank}.pt", weights_only=False) for rank in (0, 1)]


def test_gradient_is_that_of_the_joined_batch(ranks, float64, tmp_path):
    assert ranks[0]["result"] == ranks[1]["result"]
    trainer = make_trainer(tmp_path, noise_in_batch=True, stages=("end_to_end",))
    stage = trainer.stages[0]
    batches = [stage.sample(seed_update(0, 0, 0, rank), stage.length(0)) for rank in (0, 1)]
    assert not torch.equal(batches[0]["state"], batches[1]["state"])
    terms = stage.loss(torch.cat(batches))
    sum(terms.values()).backward()
    compared = 0
    gradients = [[g for g in rank["gradient"] if g is not None] for rank in ranks]
    for parameter, one, other in zip(trainer.model.parameters(), *gradients, strict=True):
        assert torch.equal(one, other)
        # Sums of some hundred terms in another order: 1e-16 each, so 1e-13 of the largest entry leaves a margin.
        torch.testing.assert_close(one, parameter.grad, rtol=0, atol=1e-13 * float(parameter.grad.abs().max()))
        compared += int(one.abs().sum() > 0)
    assert compared > 10


def test_parameters_without_a_gradient(ranks):
    for rank in ranks:
        assert rank["gradient"].count(None) == 1
        assert rank["model"]["unused"].item() == 1.0  # not decayed either
        assert rank["lonely"].tolist() == [1.5, -0.5]
        assert rank["mean"].item() == 0.5
