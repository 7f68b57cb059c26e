"""Compose a custom filter: a motion model in ten lines, two sensors, one analysis after the other.

    python examples/custom_filter.py

A boat drifts on a lake. A GPS gives its position (1 m noise, but only one step in ten); three beacons give strongly
distorted ranges at every step, which a learned sensor maps to a position. The motion model is defined here: constant
velocity, with gusts whose strength is learned. The first analysis reads the beacons, the second the GPS; each has
its own mask. Any ``TensorDictModule`` with the right keys can replace any part.
"""

from __future__ import annotations

import argparse

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.data import Composite, Unbounded
from torchrl.envs import Compose, RenameTransform, TransformedEnv
from torchrl.envs.transforms import Transform
from tqdm import tqdm

from torch_denkf import DEnKFLoss, DEnKFTransform, Filter, LinearGaussianEnv
from torch_denkf.modules import (
    ConstantNoise,
    DiagonalNoise,
    EnsembleAnalysis,
    GaussianPrior,
    Select,
    Transition,
    VectorSensor,
)

DT, ENSEMBLE = 0.5, 32
BEACONS = torch.tensor([[30.0, 0.0], [-20.0, 25.0], [-20.0, -25.0]])  # m


class GustyDrift(Transition):
    """The motion model: position moves with the velocity, gusts N(0, gust^2) change the velocity."""

    def __init__(self):
        super().__init__(nn.Identity(), [("belief", "ensemble")], [("forecast", "ensemble")])
        self.log_gust = nn.Parameter(torch.tensor(-1.0))

    def compute(self, ensemble: torch.Tensor) -> torch.Tensor:
        position, velocity = ensemble.split(2, -1)
        velocity = velocity + self.log_gust.exp() * torch.randn_like(velocity)
        return torch.cat([position + DT * velocity, velocity], -1)


class Beacons(Transform):
    """Simulates the beacons: saturating, noisy ranges ``"ranges"`` [*B, 3] of the true state."""

    def __init__(self):
        super().__init__(in_keys=["state"], out_keys=["ranges"])

    def _apply_transform(self, state: torch.Tensor) -> torch.Tensor:
        distance = (state[..., None, :2] - BEACONS).norm(dim=-1)
        return (distance / 25).tanh() + 0.02 * torch.randn_like(distance)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec["ranges"] = Unbounded((*observation_spec.shape, 3))
        return observation_spec


def make_env(boats: int, seed: int) -> TransformedEnv:
    """Returns boats on the lake: constant velocity with a little drag and gusts of 0.3 m/s."""
    drift = torch.eye(4) + DT * torch.tensor([[0, 0, 1, 0], [0, 0, 0, 1], [-0.01, 0, -0.1, 0], [0, -0.01, 0, -0.1]])
    env = LinearGaussianEnv(
        drift, torch.eye(2, 4), [0.0, 0.0, 0.3, 0.3], [1.0, 1.0], initial_std=[5.0, 5.0, 1.0, 1.0],
        missing=0.9, batch_size=[boats], seed=seed,
    )  # fmt: skip
    gps = RenameTransform(in_keys=["observation", "observed"], out_keys=["gps", "gps_observed"])
    return TransformedEnv(env, Compose(Beacons(), gps))


def make_filter(use_beacons: bool) -> Filter:
    """Returns a filter of the motion, the analysis of the beacons, and the analysis of the GPS on its result."""
    beacons = [
        VectorSensor(3, 2, ensemble_size=ENSEMBLE, scale=[10.0, 10.0], in_key="ranges"),
        DiagonalNoise(2, r=3.0, scale=[10.0, 10.0]),
        Select([0, 1]),
        EnsembleAnalysis("sensor"),
    ]
    before_gps = ("belief", "ensemble") if use_beacons else ("forecast", "ensemble")
    gps = [
        ConstantNoise([1.0, 1.0], in_key="gps", out_key=("gps_reading", "noise")),
        Select([0, 1], in_key=before_gps, out_key=("gps_reading", "predicted")),
        EnsembleAnalysis(
            "etkf",
            forecast_key=before_gps,
            predicted_key=("gps_reading", "predicted"),
            observation_key="gps",
            noise_variance_key=("gps_reading", "noise"),
            observed_key="gps_observed",
        ),
    ]
    prior = GaussianPrior([0.0] * 4, [5.0, 5.0, 1.0, 1.0], ensemble_size=ENSEMBLE)
    return Filter(GustyDrift(), *(beacons if use_beacons else []), *gps, initial=prior)


def train(model: Filter, data: TensorDict, updates: int, length: int, sensor: float) -> None:
    """Fits all parameters of the filter, through ``length`` steps from the start of a run."""
    loss = DEnKFLoss(model, sensor=sensor, transition=0.0, state_scale=[5.0, 5.0, 1.0, 1.0])
    optimiser = torch.optim.Adam(model.parameters(), lr=5e-3)
    for _ in (bar := tqdm(range(updates), desc="training", disable=None)):
        batch = data[torch.randint(data.shape[0], (64,)), :length]
        total = sum(loss(batch).values())
        optimiser.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        bar.set_postfix(crps=f"{total.item():.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--updates", type=int, default=200, help="training steps of each filter")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs")
    args = parser.parse_args()
    updates = 3 if args.smoke else args.updates
    torch.manual_seed(args.seed)

    data = make_env(boats=256, seed=args.seed).rollout(50).select("state", "ranges", "gps", "gps_observed")
    lines = ["| | position, RMSE m | velocity, RMSE m/s |", "|---|---|---|"]
    for name, use_beacons in (("GPS alone, filtered", False), ("beacons and GPS, filtered", True)):
        model = make_filter(use_beacons)
        train(model, data, updates, length=25, sensor=float(use_beacons))
        env = make_env(boats=64, seed=args.seed + 1)
        env.append_transform(DEnKFTransform(model, diagnostics=[("sensor", "ensemble")] if use_beacons else ()))
        unseen = env.rollout(50)["next"]
        if use_beacons:
            error = unseen["sensor", "ensemble"].mean(-2) - unseen["state"][..., :2]
            lines.append(f"| beacons alone, the learned sensor | {error.square().mean().sqrt():.2f} | |")
        error = (unseen["belief", "mean"] - unseen["state"]).square()
        lines.append(f"| {name} | {error[..., :2].mean().sqrt():.2f} | {error[..., 2:].mean().sqrt():.2f} |")
    table = "\n".join(lines)
    print(
        f"\n64 unseen boats, 50 steps:\n\n{table}\n\n"
        f"Learned gusts: {model[0].log_gust.exp().item():.2f} m/s a step (true: 0.30)"
    )


if __name__ == "__main__":
    main()
