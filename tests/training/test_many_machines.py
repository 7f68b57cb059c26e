"""The example of many machines: what raises, what SAC gets, and workers under ray, where that is installed."""

import importlib.util
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

FILE = Path(__file__).parents[2] / "examples" / "many_machines.py"


@pytest.fixture(scope="module")
def page():
    spec = importlib.util.spec_from_file_location("many_machines", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def batch(page, numbers):
    rows = page.WINDOW * len(numbers)
    count = torch.arange(rows).unsqueeze(-1)
    data = TensorDict({name: count.float() for name in ("encoder", "action", "state")}, [rows])
    data["belief", "mean"], data["next", "reward"] = 1.0 * count, 10.0 * count
    data["is_init"] = count % 10 == 0
    data["weights_number"] = torch.tensor(numbers).repeat_interleave(page.WINDOW).unsqueeze(-1)
    return data


def test_rows_of_old_weights_are_told_from_the_others(page):
    fresh, old = page.windows(batch(page, [7, 4, 5, 3]), newest=7, oldest=2)
    assert fresh["weights_number"][:, 0, 0].tolist() == [7, 5]
    assert old["weights_number"][:, 0, 0].tolist() == [4, 3]
    with pytest.raises(RuntimeError, match="1 versions ahead"):
        page.windows(batch(page, [8]), newest=7, oldest=2)


def test_the_number_travels_with_the_weights(page):
    policy, _, _ = page.make_policy(page.make_filter())
    other, _, _ = page.make_policy(page.make_filter())
    policy[-1].number += 3
    TensorDict.from_module(policy).data.to_module(other)
    row = other[-1](TensorDict({"belief": {"mean": torch.zeros(2, 5)}}, [2]))
    assert row["weights_number"].tolist() == [[3], [3]]


def test_transitions_end_with_their_episode(page):
    fresh, _ = page.windows(batch(page, [0, 0]), newest=0, oldest=0)
    rows = page.transitions(fresh)
    first = rows["belief", "mean"].squeeze(-1)
    assert torch.equal(rows["next", "belief", "mean"].squeeze(-1), first + 1)
    assert torch.equal(rows["next", "reward"].squeeze(-1), 10 * first)
    missing = set(range(50)) - set(first.int().tolist())
    assert missing == {9, 19, 24, 29, 39, 49}  # before a reset, and the last of a window
