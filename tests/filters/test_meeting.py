"""Tests where two features meet: actions and noise, marks and stored beliefs, divergence and gradients, groups."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

from tests.filters.composed import ReplayedFrames
from tests.filters.factories import FixedEnsemble, NoisyLinear, linear_denkf, linear_kalman, random_walk, stepwise
from torch_denkf.filters import Filter
from torch_denkf.modules import EnsembleAnalysis, LinearObservation, SubModel
from torch_denkf.transforms import DEnKFTransform, LastAction

MEAN = ("belief", "mean")


# ------------------------------------------------------------------------------------------- noise that actions drive


class DrivenNoise(SubModel):
    """Variances that grow with the last action."""

    def __init__(self):
        super().__init__(nn.Identity(), ["action"], [("sensor", "noise")])

    def compute(self, action):
        return 1 + action.square()


def driven(place):
    parts = {
        "noise": DrivenNoise(),
        "transition": NoisyLinear(torch.eye(1)),
        "observation": LinearObservation(torch.eye(1)),
        "analysis": EnsembleAnalysis("etkf", observation_key="y"),
    }
    order = ["noise", "transition", "observation", "analysis"]
    order.insert(place, order.pop(0))
    members = torch.linspace(-1, 1, 8).unsqueeze(-1)
    return Filter({name: parts[name] for name in order}, initial=FixedEnsemble(members))


@pytest.mark.parametrize("place", [0, 1, 2])
def test_noise_that_depends_on_the_action_is_no_transition(float64, place):
    torch.manual_seed(0)
    filter = driven(place)
    assert filter.structure.transition[0] == "transition"
    frames = TensorDict({"y": torch.randn(2, 6, 1), "action": torch.randn(2, 6, 1)}, [2, 6])
    out = filter.sequence(frames.copy())
    p = float(filter.initial.members.var())
    for row in range(2):
        m, v, means = 0.0, p, [0.0]
        for t in range(1, 6):
            r = 1 + float(frames["action"][row, t - 1]) ** 2
            m, v = m + v / (v + r) * (float(frames["y"][row, t]) - m), v * r / (v + r)
            means.append(m)
        assert out[MEAN][row].flatten().tolist() == pytest.approx(means, abs=1e-12)
    frames["is_init"] = torch.zeros(2, 6, 1, dtype=torch.bool)
    frames["is_init"][:, 0] = True
    torch.testing.assert_close(stepwise(filter, frames)[MEAN], out[MEAN], rtol=0, atol=1e-12)


# -------------------------------------------------------------------------------------------- readings in policies


@pytest.mark.parametrize("make", [linear_kalman, linear_denkf])
@pytest.mark.parametrize("way", ["step", "sequence", "policy", "transform"])
def test_readings_of_several_robots_are_not_averaged(make, way):
    filter = make()
    frames = TensorDict({"observation": torch.randn(2, 5, 3, 2), "action": torch.zeros(2, 5, 1)}, [2, 5])
    frames["is_init"] = torch.zeros(2, 5, 1, dtype=torch.bool)
    row = filter.initialise(frames[:, 0].select("is_init").copy()).update(frames[:, 0])
    run = {
        "step": lambda: filter.step(row),
        "sequence": lambda: filter.sequence(frames),
        "policy": lambda: filter(row.set("previous", row.select("belief"))),
        "transform": lambda: TransformedEnv(ReplayedFrames(frames), DEnKFTransform(filter)).rollout(3),
    }
    with pytest.raises(
        ValueError,
        match=r"'observation' is .* 1 dimension\(s\) too many. Readings of sev|observation must be \[\*B, E, O\]",
    ):
        run[way]()


# ------------------------------------------------------------------------------------------- groups that end alone


class Groups(EnvBase):
    """Two robots in two environments; episodes end in the group of robots, and nowhere else."""

    def __init__(self, *, each):
        super().__init__(batch_size=[2])
        shape = (2, 2) if each else (2,)
        done = Composite(done=Binary(1, shape=(*shape, 1), dtype=torch.bool), shape=shape)
        self.observation_spec = Composite(observation=Unbounded((2, 1)), shape=(2,))
        self.full_done_spec = Composite(agents=done, shape=(2,))
        for name in ("action", "reward"):
            group = Composite({name: Unbounded((*shape, 1))}, shape=shape)
            setattr(self, f"full_{name}_spec", Composite(agents=group, shape=(2,)))

    def _reset(self, tensordict=None, **kwargs):
        return self.observation_spec.zero().update(self.full_done_spec.zero())

    def _step(self, tensordict):
        return self._reset().update(self.full_reward_spec.zero())

    def _set_seed(self, seed):
        return seed


@pytest.mark.parametrize("each", [True, False])
def test_a_belief_that_torchrl_would_not_reset_raises(each):
    filter = random_walk()
    for transform in (
        DEnKFTransform(filter),
        filter.make_tensordict_primer(),
        LastAction({("agents", "action"): "last"}),
    ):
        with pytest.raises(ValueError, match=r"end only in .*agents.*, and torchrl does not reset entries outside"):
            TransformedEnv(Groups(each=each), transform).rollout(2)
