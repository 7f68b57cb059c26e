"""Several sensors on one page: a cart with a laser, a wheel and a GPS, each with its own rate, noise and delay.

    python examples/fusion.py

The wheel reads the speed at 50 Hz, the laser the position at 10 Hz, and the GPS the position at 1 Hz with a latency of
0.3 s. The program compares every set of sensors, uses and ignores the delay, filters steps of irregular
length, and learns when to ignore the laser. No data set. It takes a minute. The page behind this one is
``docs/how_to/several_sensors.md``; measured errors on a robot's arm and on a car are in ``docs/results/fusion.md``.
"""

from __future__ import annotations

import argparse
from itertools import combinations

import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf import FusedFilter, FusedSensor, GaussianLoss
from torch_denkf.fusion import SensorAttention
from torch_denkf.modules import LinearTransition, MomentPrior, Select
from torch_denkf.motions import ContinuousMotion, ContinuousNoise

DT, LATE = 0.02, 15  # s; steps by which the GPS is late
PUSH = 1.0  # m/s per root second: random walk of the speed
NOISE = {"wheel": 0.3, "laser": 0.05, "gps": 0.5}  # m/s, m, m
EVERY = {"wheel": 1, "laser": 5, "gps": 50}  # steps between readings
WHAT = {"wheel": 1, "laser": 0, "gps": 0}  # of [position m, speed m/s]
MOVE, RATE = torch.tensor([[1.0, DT], [0.0, 1.0]]), torch.tensor([[0.0, 1.0], [0.0, 0.0]])
WANDER = torch.diag(torch.tensor([0.0, PUSH**2]))


def record(carts: int, steps: int, *, failing: bool = False) -> TensorDict:
    """Returns true states, readings at their arrival, and masks; ``failing`` adds people in the laser's beam."""
    speed = (PUSH * DT**0.5 * torch.randn(carts, steps)).cumsum(1)
    state = torch.stack([DT * speed.cumsum(1), speed], -1)
    data = TensorDict({"state": state}, [carts, steps])
    time = torch.arange(steps)
    for name, noise in NOISE.items():
        data[name] = state[..., WHAT[name] :][..., :1] + noise * torch.randn(carts, steps, 1)
        data[f"{name}_observed"] = (time % EVERY[name] == 0).reshape(1, -1, 1).expand(carts, steps, 1).clone()
    begin = torch.randint(steps // 4, steps // 2, (carts, 1))
    data["blocked"] = failing & (time >= begin) & (time < begin + steps // 4)
    data["laser"] = torch.where(data["blocked"].unsqueeze(-1), data["laser"] - 2.0, data["laser"])
    for key in ("gps", "gps_observed"):  # a reading that arrives now was taken LATE steps ago
        data[key] = data[key].roll(LATE, 1)
        data[key][:, :LATE] = False
    return data


def make(*, delay: int = LATE, joint: bool = False, weights: nn.Module | None = None) -> FusedFilter:
    """Returns the filter: a Kalman filter, because motion and readings are linear."""
    delays = {"wheel": 0, "laser": 0, "gps": delay}
    return FusedFilter(
        LinearTransition(MOVE, DT * WANDER),
        {name: FusedSensor(Select([WHAT[name]]), [NOISE[name]], delay=delays[name]) for name in NOISE},
        initial=MomentPrior(torch.zeros(2), 0.1 * torch.eye(2)),
        joint=joint,
        weights=weights,
    )


def error(out: TensorDict, rows=...) -> float:
    """Returns the root mean square error of the position in m."""
    return (out["belief", "mean"] - out["state"])[..., 0][rows].square().mean().sqrt().item()


@torch.no_grad()
def run(filter: FusedFilter, data: TensorDict, *lacking: str) -> TensorDict:
    """Filters the recordings without some sensors, whose observed masks are set to False."""
    data = data.copy()
    for name in lacking:
        data[f"{name}_observed"] = torch.zeros_like(data[f"{name}_observed"])
    return filter.sequence(data)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="a tiny run of everything; its errors mean nothing")
    smoke = parser.parse_args().smoke
    carts, steps, updates = (2, 100, 1) if smoke else (30, 400, 60)
    torch.manual_seed(0)
    torch.set_num_threads(1)
    data = record(carts, steps)

    print("Error of the position, m:")
    fused = make()
    for count in (1, 2, 3):
        for some in combinations(NOISE, count):
            print(f"  {' + '.join(some):20s} {error(run(fused, data, *(set(NOISE) - set(some)))):.3f}")
    one, both = run(fused, data), run(make(joint=True), data)
    print(f"  one after the other and joint differ by {(one['belief'] - both['belief'])['mean'].abs().max():.0e} m")

    print("\nWheel and GPS, whose readings have a latency of 0.3 s:")
    print(f"  latency ignored      {error(run(make(delay=0), data, 'laser')):.3f}")
    print(f"  latency modelled     {error(run(fused, data, 'laser')):.3f}")

    # Steps of irregular length: the motion and its noise follow from the seconds since the last step.
    motion = ContinuousMotion(RATE)
    irregular = FusedFilter(
        motion,
        {name: FusedSensor(Select([WHAT[name]]), [NOISE[name]]) for name in ("wheel", "laser")},
        initial=MomentPrior(torch.zeros(2), 0.1 * torch.eye(2)),
        process_noise=ContinuousNoise(motion, WANDER),
    )
    kept = torch.rand(steps) < 0.3
    kept[0] = True
    times = kept.nonzero().flatten()
    some = data[:, times].copy()
    seconds = DT * torch.diff(times, prepend=times[:1])
    some["dt"] = seconds.reshape(1, -1, 1).expand(carts, -1, 1)
    print(f"\nIrregular steps, {seconds[1:].min():.2f} to {seconds.max():.2f} s apart:")
    print(f"  {error(run(irregular, some)):.3f}")

    # The laser reads two metres too little while a person is in its beam, without a mask. The weights are trained by
    # the score of the belief; their inputs are the innovations.
    weights = SensorAttention(dict.fromkeys(NOISE, 1))
    learning = make(delay=0, weights=weights)
    loss = GaussianLoss(learning, transition=0.0, sensor=0.0)
    optimiser = torch.optim.Adam(weights.parameters(), 1e-2)
    for _ in range(updates):
        value = loss(
            record(32, 80, failing=True).exclude("gps_observed").set("gps_observed", torch.zeros(32, 80, 1) > 0)
        )
        optimiser.zero_grad()
        value["loss_state"].backward()
        optimiser.step()
    failing = record(carts, steps, failing=True)
    blocked = failing["blocked"]
    print("\nThe laser fails for a while; error of the position then, m:")
    weighted = run(make(weights=weights), failing)
    print(f"  no weights           {error(run(fused, failing), blocked):.3f}")
    print(f"  learned weights      {error(weighted, blocked):.3f}")
    print(f"  never had a laser    {error(run(fused, failing, 'laser'), blocked):.3f}")
    seen = failing["laser_observed"].squeeze(-1)
    inside, outside = (weighted["weight", "laser"][seen & where].median() for where in (blocked, ~blocked))
    print(f"  weight of the laser  {inside:.3f} in these times, {outside:.3f} else")


if __name__ == "__main__":
    main()
