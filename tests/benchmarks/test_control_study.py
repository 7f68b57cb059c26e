"""What a run of the study is made of, who may see what, and which runs the tables are of."""

import json
import time
from dataclasses import replace

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.modules import IndependentNormal, ProbabilisticActor

import benchmarks.control.run as protocol
from benchmarks.control import hike, study
from benchmarks.control.arms import ARMS, Inputs
from benchmarks.control.learning import Learner, Learning
from benchmarks.control.page import draw, noises, page
from benchmarks.control.run import Budget, cell_name, make_env, run
from benchmarks.control.sac import Settings
from benchmarks.control.shift import LEFT, SHIFTED
from benchmarks.control.study import CELLS, Study, arms_of, complete, jobs, part
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


class OffPolicy(Agent):
    ON_POLICY = False


class Keeper(OffPolicy):
    def __init__(self, arm, inputs, settings, batches):
        super().__init__(arm, inputs, settings, batches)
        self.settings = settings


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


def test_seconds_are_of_training_and_not_of_tests(tiny):
    tiny(Agent)
    begun = time.process_time()
    seconds = [row["wall_s"] for row in run("tiny", (0.2, 0.0), "last reading", 0, BUDGET)]
    whole = time.process_time() - begun
    training, tests = (world.seconds for world in Paid.made)
    assert tests > 0.03
    assert training <= seconds[-1] <= whole - tests
    assert 0 < seconds[0] < seconds[1] < seconds[2]


def test_no_world_is_both_trained_in_and_tested_in(tiny):
    tiny(Agent)
    for seed in range(5):
        run("tiny", (0.2, 0.3), "last reading", seed, Budget(env_steps=20, tests=1, episodes=5))
    assert [world.made_of[:3] for world in Paid.made] == [(2, 0.2, 0.3), (5, 0.2, 0.3)] * 5
    assert len({world.made_of[3] for world in Paid.made}) == 10


@pytest.mark.parametrize("agent", [Agent, OffPolicy])
@pytest.mark.parametrize("arm", ["belief mean", "last reading"])
def test_who_learns_from_random_actions(agent, arm, tiny, monkeypatch):
    """Random actions stay within one; a policy's do not. What was collected is filtered anew with what is kept."""
    updates = tiny(agent)
    monkeypatch.setattr(protocol, "refiltered", lambda filter, data: data.set("anew", data["step"]))
    torch.manual_seed(0)
    run("tiny", (0.2, 0.0), arm, 0, BUDGET)
    learns = arm == "belief mean"
    within = [bool((data["action"].abs() <= 1).all()) for data in agent.last.given]
    skipped = learns and agent.ON_POLICY
    assert within == [False] * (BATCHES - skipped) if agent.ON_POLICY else [True] + [False] * (BATCHES - 1)
    counts = [30] + [4] * (BATCHES - 1)
    assert updates == ([(count, COUNT * (number + 1)) for number, count in enumerate(counts)] if learns else [])
    anew = [0, 1, 2, 4] if learns and not agent.ON_POLICY else []
    assert agent.last.refilters == anew
    assert [number for number, data in enumerate(agent.last.given) if data.get("anew", None) is not None] == anew


@pytest.mark.parametrize(("given", "every"), [(None, 5), (200, 200)])
def test_a_budget_says_how_often_sac_updates(given, every, tiny, monkeypatch):
    """It comes with the call, and so reaches processes of their own."""
    tiny(Keeper)
    monkeypatch.setitem(TASKS, "tiny", replace(TASKS["tiny"], settings=Settings()))
    run("tiny", (0.2, 0.0), "last reading", 0, replace(BUDGET, every=given))
    assert Agent.last.settings == Settings(every=every)


@pytest.mark.parametrize("arm", ["belief mean", "belief mean, taught"])
def test_who_is_taught(arm, tiny, monkeypatch):
    tiny(Agent)
    taught = []
    monkeypatch.setattr(protocol, "Learner", lambda *given: taught.append(given[-1]) or Learner(*given))
    run("tiny", (0.2, 0.0), arm, 0, BUDGET)
    assert taught == [arm == "belief mean, taught"]


@pytest.mark.parametrize(
    ("task", "arm"),
    [
        (task, arm)
        for task in TASKS
        for arm in ((*study.READERS[task], "truth") if task == "cartpole" else ARMS)
        if ARMS[arm].filter != "exact" or TASKS[task].exact is not None
    ],
)
def test_only_one_arm_reads_the_truth(task, arm):
    world, reader = TASKS[task], ARMS[arm]
    filter = world.exact(0.2) if reader.filter == "exact" else world.unlearned(4) if reader.filter else None
    env = make_env(world, reader, 2, (0.2, 0.0), 0, filter)
    seen = env.observation_spec["seen"].shape[-1] if "seen" in reader.keys else 0
    inputs = Inputs(seen, env.full_action_spec["action"].shape[-1], torch.tensor(world.scale), world.limit)
    agent = world.agent(reader, inputs, world.settings, 1)
    read = {*agent.policy.in_keys, *agent.critic.in_keys}
    assert ("state" in read) == (arm == "truth")
    assert set(reader.keys) - {"seen"} <= read
    if filter is not None:
        assert "state" not in filter.in_keys


def test_a_filter_that_is_not_taught_never_sees_the_state():
    """With other states it learns the same, bit for bit; a taught one does not."""
    data = hike.MountainHike(4, 0.2).rollout(hike.STEPS)
    other = data.clone()
    other["state"].add_(1.0), other["next", "state"].add_(1.0)

    def learned(data, taught):
        torch.manual_seed(0)
        filter = hike.unlearned_filter(4)
        learner = Learner(filter, TASKS["hike"].prior, 4, Learning(windows=4), taught)
        learner.add(data)
        learner.update(3)
        return torch.nn.utils.parameters_to_vector(filter.parameters())

    assert learned(other, False).equal(learned(data, False))
    assert not learned(other, True).equal(learned(data, True))


def test_windows_begin_anywhere_and_noises_have_a_least():
    """All of the 60 places where 16 of 75 steps fit; what would make the noises vanish leaves them at 0.01."""
    torch.manual_seed(0)
    filter, starts = hike.unlearned_filter(4), []
    learner = Learner(filter, TASKS["hike"].prior, 4, Learning(windows=4))
    data = hike.MountainHike(4, 0.2).rollout(hike.STEPS)
    learner.add(data.set("observation", data["step"].expand(-1, -1, 2).float()))

    def loss(windows):
        steps = windows["observation"][..., 0]
        assert steps.shape == (4, 16)
        assert steps.diff(dim=1).eq(1).all()
        starts.append(int(steps[0, 0]))
        return {"loss": sum(parameter.sum() for parameter in filter.parameters())}

    learner.loss = loss
    learner.update(600)
    assert set(starts) == set(range(60))  # one is missing with a probability of 0.3 %; the seed is fixed
    noises = torch.cat([noise.exp().sqrt() for noise in learner.noises])
    torch.testing.assert_close(noises, torch.full((4,), 0.01))


# ------------------------------------------------------------------------------------------------- cells and tables


def fill(folder, wanted):
    """Leaves a run's rows for each task, number of a cell, arm and seed that is ``wanted``."""
    found = Study(out=folder)
    for task in CELLS:
        for number, cell in enumerate(CELLS[task]):
            for seed in range(4):
                for order, arm in enumerate(arms_of(task, cell)):
                    if wanted(task, number, arm, seed):
                        entries = {"arm": arm, "seed": seed, "env_steps": 1000, "return": 100.0 + order, "wall_s": 1.0}
                        file = part(found, task, cell, arm, seed)
                        file.parent.mkdir(parents=True, exist_ok=True)
                        file.write_text(json.dumps([{"task": task, "cell": cell_name(cell), **entries}]))
    return found


def test_no_two_runs_share_a_file_and_each_is_planned_once(tmp_path):
    files = [job.args[0] for job in jobs(Study(out=tmp_path), 0, Budget())]
    assert len(files) == len(set(files)) == sum(len(arms_of(task, cell)) for task in CELLS for cell in CELLS[task])
    for job in jobs(Study(out=tmp_path), 2, BUDGET):
        file, (task, cell, arm, seed, budget) = job.args[0], job.args[1].args
        assert file == part(Study(out=tmp_path), task, cell, arm, seed)
        assert (job.func, job.args[1].func, seed, budget) == (study.once, run, 2, BUDGET)
    first = [job.args[1].args[:2] for job in jobs(Study(tasks=("pendulum",), cells=1), 0, BUDGET)]
    assert set(first) == {("pendulum", (0.2, 0.3))}


def test_a_seed_counts_where_all_arms_have_run(tmp_path):
    """Seeds 0 to 2 of the first hike, of which seed 1 lacks an arm; nothing of the second, which lacks that arm."""
    found = fill(
        tmp_path,
        lambda task, number, arm, seed: (
            task == "hike"
            and seed < 3
            and ((number == 0 and (seed, arm) != (1, "GRU")) or (number == 1 and arm != "GRU"))
        ),
    )
    rows = complete(found)
    assert {(row["cell"], row["seed"]) for row in rows} == {("noise 0.4", 0), ("noise 0.4", 2)}
    assert len(rows) == 2 * len(arms_of("hike", (0.4, 0.0)))


def test_no_tables_of_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["control", "--seeds", "0", "--out", str(tmp_path)])
    with pytest.raises(SystemExit, match="no cell of which all arms have run"):
        study.main()


def test_the_truth_of_another_cell_brings_no_seeds(tmp_path):
    """Two seeds with noise 0.4 are two, although what reads the truth has four in the cell without noise."""
    found = fill(
        tmp_path, lambda task, number, arm, seed: task == "hike" and (number == 1 or (number == 0 and seed < 2))
    )
    lines = page(complete(found)).splitlines()
    columns = next(line.strip("| ").split(" | ") for line in lines if line.startswith("| cell | seeds"))
    line = next(line.strip("| ").split(" | ") for line in lines if line.startswith("| noise 0.4 | "))
    assert line[1] == "2"
    assert line[columns.index("truth")] == "108.0"  # the ninth arm without noise
    assert noises(complete(found), "hike") == {"noise 0": 0.0, "noise 0.4": 0.4}
    draw(complete(found), tmp_path / "picture.png")
    assert protocol.cell_name((0.2, 0.3)) == "noise 0.2, 30% missing"


def test_what_reads_the_truth_is_not_there_where_a_filter_keeps_its_r():
    """The truth has rows of both noises, but none of "R as learned": it has no R."""
    cells = {"noise 0.1": 800.0, SHIFTED.format("noise 0.3"): 700.0, LEFT.format("noise 0.3"): 600.0}
    rows = [
        {"task": "cartpole", "cell": cell, "arm": arm, "seed": seed, "env_steps": 9, "return": value, "wall_s": 1.0}
        for cell, value in cells.items()
        for arm in ("belief mean", "LSTM", "truth")
        for seed in range(2)
        if arm == "belief mean" or cell != LEFT.format("noise 0.3")
    ]
    lines = page(rows).splitlines()
    (left,) = [line for line in lines if line.startswith(f"| {LEFT.format('noise 0.3')} |") and "25.0" in line]
    assert [part.split()[:1] for part in left.split("|")[2:-1]] == [[], ["25.0"], []]
