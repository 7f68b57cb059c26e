"""Scores of the monitoring study, against closed forms and counts by hand."""

import pytest
import torch
from tensordict import TensorDict

from benchmarks.monitor.drives import believed_spans
from benchmarks.monitor.scores import Run, afterwards, auroc, detection, false_alarms


def test_auroc_is_the_share_of_ordered_pairs():
    score, positive = torch.tensor([3.0, 1.0, 2.0, 2.0]), torch.tensor([True, False, True, False])
    assert auroc(score, positive) == pytest.approx((1 + 1 + 1 + 0.5) / 4)
    torch.manual_seed(0)
    normal = torch.randn(4000) + torch.tensor([0.0, 1.0]).repeat(2000)
    expected = torch.special.ndtr(torch.tensor(0.5**0.5)).item()  # two unit normal variables with means 0 and 1
    assert auroc(normal, torch.tensor([False, True]).repeat(2000)) == pytest.approx(expected, abs=0.02)


def test_detection_scores_exclude_the_steps_after_a_fault():
    fault = torch.zeros(40, dtype=torch.bool)
    fault[10:20] = True
    alarm = torch.zeros(40, dtype=torch.bool)
    alarm[12:25] = True
    found = detection([Run(alarm.float(), alarm, fault)])
    assert found == {"auroc": pytest.approx(0.9), "delay_steps": 2.0, "found": 1.0}
    assert false_alarms([Run(alarm.float(), alarm, fault)]) == {
        "false_alarms_per_1000": pytest.approx(1000 / 39),
        "false_steps_per_1000": pytest.approx(13000 / 39),
    }
    silent = detection([Run(torch.rand(40), torch.zeros(40, dtype=torch.bool), fault)])
    assert silent["delay_steps"] == float("inf")
    assert afterwards(torch.arange(40.0).unsqueeze(0), fault, 5).tolist() == [[30, 31, 32, 33, 34]]


def test_shortest_accepted_frame_pair_is_chosen():
    def reading(steps):
        entries = {"ensemble": torch.full((4, 2, 2), float(steps)), "encoding": torch.zeros(4, 3)}
        seen = torch.ones(4, 1, dtype=torch.bool)
        return TensorDict({"state": torch.zeros(4, 5), "observed": seen, "sensor": TensorDict(entries, [4])}, [4])

    doubts = {1: [False, True, True, True], 2: [False, False, True, True], 3: [False, False, False, True]}
    spans = [reading(steps) for steps in doubts]

    def seen(each):
        return ~torch.tensor(doubts[int(each["sensor", "ensemble"][0, 0, 0])]).unsqueeze(-1)

    chosen = believed_spans(spans, seen)
    assert chosen["steps"].flatten().tolist() == [1, 2, 3, 0]
    assert chosen["observed"].flatten().tolist() == [True, True, True, False]
    assert chosen["sensor", "ensemble"][:3, 0, 0].tolist() == [1, 2, 3]
