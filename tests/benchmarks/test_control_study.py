"""Tests the parts of a run of the study, who may see what, and which runs the tables are of."""

import time

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.modules import IndependentNormal, ProbabilisticActor

from benchmarks.control import hike
from benchmarks.control.learning import Learner, Learning
from benchmarks.control.run import Budget, run
from benchmarks.control.tasks import TASKS, Task

BUDGET = Budget(tests=3, episodes=5, members=4)
STEPS, COUNT, BATCHES = 10, 2, 7


class Paid(hike.MountainHike):
    """A hike whose reward is the sum of the actions; it takes its time, and notes it."""

    made: list["Paid"]

    def __init__(self, count, noise, missing, seed):
        super().__init__(count, noise, missing, seed)
        self.made_of, self.seconds = (count, noise, missing, seed), 0.0
        self.made.append(self)

    def _step(self, tensordict):
        begun = time.process_time()
        while time.process_time() < begun + 1e-3:
            pass
        self.seconds += time.process_time() - begun
        return super()._step(tensordict).set("reward", tensordict["action"].sum(-1, keepdim=True))


class Agent:
    """Its actions are N(0.5, 4); it learns nothing, and keeps what it is given."""

    ON_POLICY = True
    last: "Agent"

    def __init__(self, arm, inputs, settings, batches):
        self.batches, self.given, self.refilters = batches, [], []
        Agent.last = self

        def head(observed):
            half = 0.5 * torch.ones(*observed.shape[:-1], 2)
            return half, 4 * half

        self.policy = ProbabilisticActor(
            TensorDictModule(head, ["observed"], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            out_keys=["action"],
            distribution_class=IndependentNormal,
        )

    def update(self, data):
        self.given.append(data)

    def refilter(self, filter):
        self.refilters.append(len(self.given))


@pytest.fixture
def tiny(monkeypatch):
    """Seven batches of two walks of ten steps; a filter makes no updates, and they are noted."""
    monkeypatch.setattr(hike, "STEPS", STEPS)
    monkeypatch.setattr(Paid, "made", [], raising=False)
    updates = []
    monkeypatch.setattr(Learner, "update", lambda self, count: updates.append((count, len(self.episodes))))

    def make(agent):
        monkeypatch.setitem(
            TASKS,
            "tiny",
            Task(
                Paid,
                hike.unlearned_filter,
                hike.exact_filter,
                STEPS,
                count=COUNT,
                limit=1.0,
                scale=(1.0, 1.0),
                prior=((0.0, 0.0), (1.0, 1.0)),
                settings=None,
                learning=Learning(window=5, windows=2, first=30, further=4),
                agent=agent,
                env_steps=BATCHES * COUNT * STEPS + 1,
            ),
        )
        return updates

    return make


def test_tests_are_of_the_mean_actions_and_evenly_spaced(tiny):
    """Ten steps of two actions of 0.5 return 10; single actions of N(0.5, 4) do not."""
    tiny(Agent)
    rows = run("tiny", (0.2, 0.0), "last reading", 3, BUDGET)
    assert [row["env_steps"] for row in rows] == [60, 100, 140]  # after 3, 5 and 7 batches of 20
    assert [row["return"] for row in rows] == pytest.approx([10.0] * 3)
    assert {(row["task"], row["cell"], row["arm"], row["seed"]) for row in rows} == {
        ("tiny", "noise 0.2", "last reading", 3)
    }
    assert Agent.last.batches == len(Agent.last.given) == BATCHES
    explored = torch.stack([data["action"] for data in Agent.last.given])
    assert explored.std().item() == pytest.approx(2, rel=0.2)  # 280 actions: 5 standard deviations


def test_no_world_is_both_trained_in_and_tested_in(tiny):
    tiny(Agent)
    for seed in range(5):
        run("tiny", (0.2, 0.3), "last reading", seed, Budget(env_steps=20, tests=1, episodes=5))
    assert [world.made_of[:3] for world in Paid.made] == [(2, 0.2, 0.3), (5, 0.2, 0.3)] * 5
    assert len({world.made_of[3] for world in Paid.made}) == 10


# ------------------------------------------------------------------------------------------------- cells and tables
