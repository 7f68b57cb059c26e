"""Every pair of ten features, through every way to run a filter. Oracle: one filter in numpy, row by row."""

from functools import partial
from itertools import combinations

import numpy as np
import pytest
import torch
from scipy.stats import chi2
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.envs import TransformedEnv
from torchrl.modules import set_recurrent_mode
from torchrl.modules.utils import get_env_transforms_from_module

from tests.filters.composed import ReplayedFrames
from tests.filters.factories import assert_equal
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.imperfect import RejectReadings
from torch_denkf.modules import EKFAnalysis, LinearTransition, MomentPrior, Select, SubModel
from torch_denkf.monitoring import BlackIsMissing, Gated, InnovationMonitor, Monitored, MonitoredSensor
from torch_denkf.transforms import DEnKFTransform

FEATURES = (
    "gate",
    "monitor",
    "late reading",
    "joint past",
    "black picture",
    "learned weights",
    "inflation",
    "reject",
    "prefix",
    "stored belief",
)
#: Inflation would spread the past again with each reading.
APART = {("late reading", "inflation"), ("joint past", "inflation")}
PAIRS = [pair for pair in combinations(FEATURES, 2) if pair not in APART]
EAGER = ("loop", "sequence", "transform", "policy")
ALL = tuple(feature for feature in FEATURES if feature != "inflation")
ROWS, T, BEGIN = 2, 9, 4
F, Q = np.array([[1.0, 0.1], [0.0, 0.9]]), np.diag([0.01, 0.09])
STD = {"camera": 0.5, "wheel": 0.4}
WINDOW, RATE, FREEDOM, INFLATION = 2, 0.3, 4.0, 1.2


class OfPicture(SubModel):
    """The position, which is how bright a picture is."""

    def __init__(self):
        super().__init__(nn.Identity(), ["pixels"], [("sensor", "ensemble")])

    def compute(self, pixels):
        return pixels.flatten(-3).mean(-1, keepdim=True)


class Doubt(nn.Module):
    """A sensor counts the less, the further its reading and the other's are from what was expected."""

    def forward(self, innovations, observed, features):
        size = {name: value.square().mean(-1) for name, value in innovations.items()}
        total = sum(size.values())
        return torch.stack([1 / (1 + value + total / 4) for value in size.values()], -1)


def build(features):
    has = features.__contains__
    camera = TensorDictSequential(BlackIsMissing(), OfPicture()) if has("black picture") else OfPicture()
    late = {"delay": 2, "late_key": "wheel_late"} if has("late reading") else {}
    if has("inflation"):
        late["analysis"] = partial(EKFAnalysis, inflation=INFLATION)
    filter = FusedFilter(
        LinearTransition(torch.tensor(F), torch.tensor(Q)),
        {
            "camera": FusedSensor(Select([0]), [STD["camera"]], sensor=camera),
            "wheel": FusedSensor(Select([1]), [STD["wheel"]], **late),
        },
        initial=MomentPrior(torch.zeros(2), torch.eye(2)),
        lag=3 if has("joint past") else None,
        weights=Doubt() if has("learned weights") else None,
        prefix="robot" if has("prefix") else None,
    ).double()
    if has("gate"):
        filter = Gated(filter, 1, places=["wheel"], response="student", window=WINDOW, rate=RATE, freedom=FREEDOM)
    if has("monitor"):
        monitor = InnovationMonitor({"wheel": MonitoredSensor(("info", "wheel"), 1)}, window=WINDOW)
        filter = Monitored(filter, monitor.double())
    return filter


def frames_for(features):
    """Returns images and readings ``[ROWS, T]``, some of them black, late, missing or NaN."""
    generator = torch.Generator().manual_seed(0)
    pixels = 0.5 + 0.4 * torch.rand(ROWS, T, 1, 2, 2, generator=generator)
    wheel = torch.randn(ROWS, T, 1, generator=generator)
    wheel[0, 5] += 5.0  # which a gate, a monitor and weights answer to
    frames = TensorDict({"wheel": wheel, "wheel_observed": torch.ones(ROWS, T, 1, dtype=torch.bool)}, [ROWS, T])
    frames["wheel_observed"][1, 3] = False
    if "black picture" in features:
        pixels[0, 3], pixels[1, 6] = 0.0, 0.0
    if "reject" in features:
        pixels[1, 2, 0, 0, 0], wheel[0, 7] = torch.nan, torch.inf
    if "late reading" in features:
        frames["wheel_late"] = torch.tensor([[0, 0, 0, 2, 1, 0, 2, 0, 1], [0, 0, 1, 0, 2, 2, 0, 1, 0]]).unsqueeze(-1)
    frames["pixels"], frames["action"] = pixels, torch.zeros(ROWS, T, 1)
    frames["is_init"] = torch.zeros(ROWS, T, 1, dtype=torch.bool)
    return frames


# ---------------------------------------------------------------------------------------------------------- the oracle


def correct(mean, cov, h, reading, r):
    """Returns one scalar reading; also its innovation and how much it varies."""
    innovation, s = reading - h @ mean, h @ cov @ h + r
    gain = cov @ h / s
    keep = np.eye(len(mean)) - np.outer(gain, h)
    return mean + gain * innovation, keep @ cov @ keep.T + r * np.outer(gain, gain), innovation, s


def oracle(features, frames):
    """Returns mean, variance, smoothed mean of the oldest clone, and the monitor's p-value, ``[ROWS, T, ...]``."""
    has, lag = features.__contains__, 3 if "joint past" in features else 2 * ("late reading" in features)
    found = {name: np.zeros((ROWS, T, 2)) for name in ("mean", "var", "smoothed")} | {"p": np.ones((ROWS, T, 1))}
    for row in range(ROWS):
        mean, cov = np.zeros(2 * (lag + 1)), np.tile(np.eye(2), (lag + 1, lag + 1))
        gate, watched = [], []
        for t in range(T):
            if t:
                mean, cov = forecast(mean, cov)
                readings = read(features, frames, row, t, lag)
                noise = {name: STD[name] ** 2 for name in readings}
                if has("learned weights"):
                    noise = weighted(readings, noise, mean, cov)
                for name, (reading, h, seen) in readings.items():
                    r = noise[name]
                    if not seen:
                        continue
                    if has("gate") and name == "wheel":
                        _, _, innovation, s = correct(mean, cov, h, reading, r)
                        gate = [innovation**2 / s, *gate][:WINDOW]
                        limit = chi2.isf(RATE, len(gate))
                        r = r * (1 + max(sum(gate) - limit, 0.0) / (limit + FREEDOM))
                    mean, cov, innovation, s = correct(mean, cov, h, reading, r)
                    if has("inflation") and name == "wheel":
                        cov = cov * INFLATION**2
                    if name == "wheel":
                        watched = [innovation**2 / s, *watched][:WINDOW]
            found["mean"][row, t], found["var"][row, t] = mean[:2], cov.diagonal()[:2]
            found["smoothed"][row, t] = mean[-2:]
            found["p"][row, t] = chi2.sf(sum(watched), len(watched)) if watched else 1.0
    return found


def forecast(mean, cov):
    """Shifts the clones by one step, and drops the oldest."""
    move = np.eye(len(mean), k=-2)
    move[:2, :2] = F
    cov = move @ cov @ move.T
    cov[:2, :2] += Q
    return move @ mean, cov


def read(features, frames, row, t, lag):
    """Reading, what it says of which state, and whether it is there, by sensor."""
    pixels, wheel = frames["pixels"][row, t].numpy(), frames["wheel"][row, t].item()
    late = frames["wheel_late"][row, t].item() if "late reading" in features else 0
    h = {name: np.zeros(2 * (lag + 1)) for name in STD}
    h["camera"][0] = h["wheel"][2 * late + 1] = 1.0
    seen = bool(frames["wheel_observed"][row, t]) and np.isfinite(wheel)
    shown = np.isfinite(pixels).all() and not ("black picture" in features and pixels.max() <= 0.02)
    return {"camera": (pixels.mean(), h["camera"], shown), "wheel": (wheel, h["wheel"], seen)}


def weighted(readings, noise, mean, cov):
    """Returns the noise divided by what :class:`Doubt` says, in the forecast."""
    size = {}
    for name, (reading, h, seen) in readings.items():
        size[name] = (reading - h @ mean) ** 2 / (h @ cov @ h + noise[name]) if seen else 0.0
    return {name: noise[name] * (1 + size[name] + sum(size.values()) / 4) for name in readings}


# ------------------------------------------------------------------------------------------------------ ways to run it


def run(way, filter, frames, start=None):
    """Runs the filter on ``[ROWS, T]``; from a stored belief, if there is one: that of the first element."""
    if way in ("sequence", "compiled"):
        if way == "compiled":
            filter.compile(chunk=1, backend="eager")
        data = frames.copy()
        if start is not None:  # one is stored for each element, and the first is used
            for key in filter.belief_keys:
                data[key] = start[key].unsqueeze(1).expand(ROWS, frames.shape[1], *start[key].shape[1:]).clone()
        return filter.sequence(data)
    if way == "transform":
        env = TransformedEnv(ReplayedFrames(frames), DEnKFTransform(filter, diagnostics=further(filter)))
        reset = env.reset() if start is None else env.reset(start.select(*filter.carry_keys).clone())
        rollout = env.rollout(frames.shape[1], break_when_any_done=False, tensordict=reset, auto_reset=False)
        last = rollout["next"][:, -1:].exclude("done", "reward")
        return torch.cat([rollout.select(*last.keys(True, True), strict=False), last], 1)[:, : frames.shape[1]]
    if way == "policy":
        return by_policy(filter, frames, start)
    first = filter.initialise(frames[:, 0].copy()) if start is None else frames[:, 0].copy().update(start)
    rows = [first]
    for t in range(1, frames.shape[1]):
        rows.append(filter.step(rows[-1].copy().update(frames[:, t])))
    keys = [key for key in [*filter.belief_keys, *further(filter)] if key in rows[0].keys(True, True)]
    return torch.stack([row.select(*keys) for row in rows], 1)


def further(filter):
    return [key for key in filter.out_keys if key[-1] == "p_value" and key not in filter.belief_keys]


def by_policy(filter, frames, start):
    """From a belief that was known before the first frame, if there is one; and again in torchrl's recurrent mode."""
    policy = TensorDictSequential(filter, ReplayedFrames(frames).player())
    env = TransformedEnv(ReplayedFrames(frames), get_env_transforms_from_module(policy))
    row = env.reset()
    if start is not None:
        for key in filter.carry_keys:
            row[previous(filter, key)] = start[key]
        row[previous(filter, ("known",))] = torch.ones(ROWS, 1, dtype=torch.bool)
    steps = {"break_when_any_done": False, "tensordict": row, "auto_reset": False}
    out = env.rollout(frames.shape[1], policy, **steps)
    with set_recurrent_mode(True):  # from the beliefs that were stored before each step
        again = filter(out.exclude(*filter.belief_keys))
    assert_equal(again, out, filter.belief_keys, atol=1e-9)
    return out


def previous(filter, key):
    names = key[1:] if filter.prefix is not None and key[0] == filter.prefix else key
    return filter.outer(("previous", *names))


def check(features, way):
    filter, frames = build(features), frames_for(features)
    expected, start, begin = oracle(features, frames), None, 0
    if "reject" in features:
        frames = RejectReadings({"pixels": "camera_observed", "wheel": "wheel_observed"})(frames)
    if "stored belief" in features:
        begin = BEGIN
        start = filter.sequence(frames.copy())[:, begin].select(*filter.belief_keys).clone()
        begin += way == "policy"  # whose first step has a belief before it
        frames, expected = frames[:, begin:], {name: value[:, begin:] for name, value in expected.items()}
    with torch.no_grad():
        out = run(way, filter, frames, start)
    keys = {"mean": ("belief", "mean"), "var": ("belief", "var")}
    if "late reading" in features or "joint past" in features:
        keys["smoothed"] = ("smoothed", "mean")
    if "monitor" in features:
        keys["p"] = ("monitor", "wheel", "p_value")
    for name, key in keys.items():
        got = out[filter.outer(key)].numpy()
        # Eight steps of a system of two states, in double precision.
        np.testing.assert_allclose(got, expected[name], rtol=1e-9, atol=1e-9, err_msg=f"{key} by {way}")


@pytest.mark.parametrize("way", EAGER)
@pytest.mark.parametrize("pair", PAIRS, ids=" + ".join)
def test_pairs_are_the_filter_in_numpy(float64, pair, way):
    check(pair, way)


@pytest.mark.parametrize("pair", sorted(APART), ids=" + ".join)
def test_pairs_that_raise(float64, pair):
    with pytest.raises(ValueError, match="inflation"):
        build(pair)


@pytest.mark.parametrize("way", [*EAGER, "compiled"])
def test_all_features_at_once(float64, way):
    check(ALL, way)


def test_the_oracle_answers_to_each_feature():
    """Each feature except names and storage changes the belief, so that the other tests are not vacuous."""
    plain = oracle((), frames_for(()))
    for feature in ("gate", "late reading", "black picture", "learned weights", "inflation", "reject"):
        other = oracle((feature,), frames_for((feature,)))
        assert np.abs(other["mean"] - plain["mean"]).max() + np.abs(other["var"] - plain["var"]).max() > 1e-3, feature
