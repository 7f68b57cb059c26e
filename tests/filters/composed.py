"""Filters out of features that nobody combined before, and an environment that replays frames to them."""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

from tests.filters.factories import FixedEnsemble
from torch_denkf.filters import Filter
from torch_denkf.modules import (
    ConstantNoise,
    EnsembleAnalysis,
    LearnedObservation,
    LearnedTransition,
    StochasticMLP,
    VectorSensor,
)

E, S, A, B, T = 5, 3, 2, 3, 9
FEATURES = (
    "two sensors",
    "two analyses",
    "mask on one",
    "flipout",
    "dropout",
    "actions",
    "extra outputs",
    "foreign module",
    "stored carry",
    "resets",
)


class TransitionWithSpeed(LearnedTransition):
    """Writes one entry more than the forecast."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.out_keys = [("forecast", "speed"), *self.out_keys]

    def compute(self, state, *args, noise):
        forecast = super().compute(state, *args, noise=noise)
        return (forecast - state).norm(dim=-1), forecast


def compose(features, *, frozen_start=True):
    """Returns a filter with some of ``FEATURES``, float64, free of randomness but that of its sub-models."""
    torch.manual_seed(0)
    layer = "flipout" if "flipout" in features else "dropout" if "dropout" in features else "none"
    kind = TransitionWithSpeed if "extra outputs" in features else LearnedTransition
    width = S + A * ("actions" in features)
    network = StochasticMLP(width, S, (8,), layer=layer, rate=0.3, output_gain=0.5)
    modules = {
        "transition": kind(network, action_key="action" if "actions" in features else None),
        "sensor": VectorSensor(4, 2, ensemble_size=E, num_cells=(8,), layer=layer, rate=0.3, in_key="a"),
        "noise": ConstantNoise([0.4, 0.6]),
        "observation": LearnedObservation(StochasticMLP(S, 2, (8,), layer="none")),
    }
    if "foreign module" in features:
        pull = nn.Linear(S, S)
        key = ("forecast", "ensemble")
        modules["pull"] = TensorDictSequential(TensorDictModule(pull, [key], [key]))
        modules["observation"] = TensorDictModule(nn.Linear(S, 2), [key], [("forecast", "observation")])
        order = ["transition", "pull", "sensor", "noise", "observation"]
        modules = {name: modules[name] for name in order}
    names = ["belief"] + ["first"] * ("two sensors" in features) + ["second"] * ("two analyses" in features)
    observed = "seen" if "mask on one" in features else "observed"
    modules["analysis"] = EnsembleAnalysis("perturbed", observed_key=observed, belief_prefix=names[-1])

    def take_in(name, dim, reading):
        """Noise, observation and analysis of a further reading, which starts where the analysis before it ended."""
        before = names.pop()
        noise, predicted = f"{name}_noise", f"{name}_predicted"
        modules[f"noise_{name}"] = ConstantNoise([0.4] * dim, in_key=reading, out_key=noise)
        members = {"in_key": (before, "ensemble"), "out_key": predicted}
        modules[f"observation_{name}"] = LearnedObservation(nn.Linear(S, dim), **members)
        keys = {"observation_key": reading, "predicted_key": predicted, "noise_variance_key": noise}
        keys |= {"forecast_key": (before, "ensemble"), "belief_prefix": names[-1]}
        modules[f"analysis_{name}"] = EnsembleAnalysis("perturbed", **keys)

    if "two sensors" in features:
        options = {"ensemble_size": E, "num_cells": (8,), "layer": layer, "rate": 0.3}
        modules["sensor_b"] = VectorSensor(4, 3, in_key="b", out_key=("other", "ensemble"), **options)
        take_in("b", 3, ("other", "ensemble"))
    if "two analyses" in features:
        take_in("c", 2, "c")
    assert names == ["belief"]
    return Filter(modules, initial=FixedEnsemble(torch.randn(E, S)))


def frames_for(features):
    """Returns readings for every sensor, masks, actions and resets, ``[B, T]``."""
    torch.manual_seed(1)
    frames = TensorDict({"a": torch.randn(B, T, 4), "b": torch.randn(B, T, 4), "c": torch.randn(B, T, 2)}, [B, T])
    frames["action"] = torch.randn(B, T, A)
    if "mask on one" in features:
        frames["seen"] = torch.rand(B, T, 2) < 0.6
    frames["is_init"] = torch.zeros(B, T, 1, dtype=torch.bool)
    frames["is_init"][:, 0] = True
    if "resets" in features:
        frames["is_init"][0, 4] = frames["is_init"][2, 6] = True
    return frames


class ReplayedFrames(EnvBase):
    """Emits frames ``[B, T]`` one after the other; an episode ends where the next frame starts one."""

    def __init__(self, frames):
        super().__init__(batch_size=frames.batch_size[:-1])
        self.frames, self.keys = frames, sorted(set(frames.keys()) - {"is_init", "action", "noise"})
        keys = {key: frames[key][:, 0] for key in self.keys}
        specs = {
            key: (Binary if v.dtype == torch.bool else Unbounded)(shape=v.shape, dtype=v.dtype)
            for key, v in keys.items()
        }
        specs["index"] = Unbounded(shape=(*self.batch_size, 1), dtype=torch.int64)
        self.observation_spec = Composite(specs, shape=self.batch_size)
        self.state_spec = Composite(shape=self.batch_size)
        self.action_spec = Unbounded(shape=frames["action"][:, 0].shape, dtype=frames["action"].dtype)
        self.reward_spec = Unbounded(shape=(*self.batch_size, 1))
        self.now = 0

    def _emit(self):
        out = self.frames[:, self.now].select(*self.keys).copy()
        return out.set("index", torch.full((*self.batch_size, 1), self.now))

    def _reset(self, tensordict, **kwargs):
        reset = None if tensordict is None else tensordict.get("_reset", None)
        if reset is None or reset.all():
            self.now = 0
        out = self._emit()
        return out.set("done", torch.zeros(*self.batch_size, 1, dtype=torch.bool))

    def _step(self, tensordict):
        self.now = min(self.now + 1, self.frames.shape[-1] - 1)
        done = self.frames["is_init"][:, self.now].clone()
        return self._emit().update({"done": done, "reward": torch.zeros(*self.batch_size, 1)})

    def _set_seed(self, seed):
        return seed

    def player(self):
        """Returns a policy that plays the recorded actions."""
        actions = self.frames["action"]
        return TensorDictModule(lambda index: actions[:, index.flatten()[0]], ["index"], ["action"])
