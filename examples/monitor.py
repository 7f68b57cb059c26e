"""Monitoring on one page: a cart whose GPS has an unannounced bias for a while.

    python examples/monitor.py              # writes runs/monitor.png
    python examples/monitor.py --out there.png

A filter weights its sensors by their noise covariance. The program monitors the innovations, raises an alarm, and lets
a gate reject readings: the error during the fault is then a fraction of that without a gate. It also prints the
largest bias that it cannot detect. It takes ten seconds; the documentation is in ``docs/how_to/monitor.md``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv

from torch_denkf import DEnKF, DEnKFTransform, Gated, LinearGaussianEnv, Monitored
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, GaussianPrior, LearnedTransition, Select
from torch_denkf.monitoring import InnovationMonitor, MonitoredSensor

DT, PUSH, NOISE = 0.1, 0.05, 0.3  # s, m/s a step, m
OFF, BACK, BIAS = 120, 160, 4.0  # first step of the GPS's bias, first step after it, and its size in m


def make_cart() -> DEnKF:
    """Returns an ensemble filter of [position m, speed m/s]."""
    walk = torch.nn.Linear(2, 2, bias=False)
    walk.weight.data = torch.tensor([[1.0, DT], [0.0, 0.99]])
    return DEnKF(
        transition=LearnedTransition(walk, residual=False),
        sensor=None,
        observation=Select([0]),
        noise=ConstantNoise([NOISE], in_key="observation"),
        analysis=EnsembleAnalysis("etkf", observation_key="observation"),
        process_noise=[0.0, PUSH],
        initial=GaussianPrior([0.0, 0.0], [0.3, 0.3], ensemble_size=64),
    )


def record(runs: int, steps: int, *, off: bool) -> TensorDict:
    """Returns carts with random pushes and their GPS, with a bias for a while if ``off``."""
    speed = [0.3 * torch.randn(runs)]
    for _ in range(steps - 1):
        speed.append(0.99 * speed[-1] + PUSH * torch.randn(runs))
    speed = torch.stack(speed, 1)
    position = 0.3 * torch.randn(runs, 1) + DT * speed.cumsum(1)
    gps = position + NOISE * torch.randn(runs, steps)
    if off:
        gps[:, OFF:BACK] += BIAS
    state = torch.stack([position, speed], -1)
    return TensorDict({"state": state, "observation": gps.unsqueeze(-1)}, [runs, steps])


def draw(path: str, plain: TensorDict, gated: TensorDict, limit: float) -> None:
    """Draws innovation statistic, alarm, and the errors with and without the gate, of the first cart."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    seconds = DT * torch.arange(plain.shape[1])
    figure, axes = plt.subplots(3, 1, sharex=True, figsize=(8, 6.5), layout="constrained")
    axes[0].semilogy(seconds, plain["info", "nis"][0, :, 0].clamp_min(1e-2), color="tab:gray", linewidth=0.8)
    axes[0].set_ylabel("normalised\ninnovation squared")
    axes[1].plot(seconds, plain["monitor", "gps", "cusum"][0, :, 0], label="cumulative sum")
    axes[1].axhline(limit, color="black", linestyle=":", label="its limit")
    alarm = plain["monitor", "alarm"][0, :, 0].float()
    axes[1].fill_between(seconds, 0, alarm * axes[1].get_ylim()[1], color="tab:red", alpha=0.25, label="alarm")
    axes[1].legend(loc="upper left", fontsize=8)
    axes[1].set_ylabel("monitor")
    for out, name, colour in ((plain, "without a gate", "tab:orange"), (gated, "with a gate", "tab:blue")):
        axes[2].plot(seconds, error_of(out)[0], color=colour, label=name)
    axes[2].legend(loc="upper left", fontsize=8)
    axes[2].set(ylabel="error of the\nposition, m", xlabel="time, s")
    for axis in axes:
        axis.axvspan(DT * OFF, DT * BACK, color="tab:gray", alpha=0.15)
    axes[0].set_title("The GPS is 4 m off where the background is grey")
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def error_of(out: TensorDict) -> Tensor:
    """Returns the error of the position, ``[runs, steps]`` in m."""
    return (out["belief", "mean"] - out["state"])[..., 0].abs()


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="runs/monitor.png", help="the picture")
    parser.add_argument("--smoke", action="store_true", help="a tiny run of everything; its errors mean nothing")
    options = parser.parse_args()
    runs, steps = (2, 180) if options.smoke else (20, 300)
    torch.manual_seed(0)
    torch.set_num_threads(1)

    # The monitored sensors, and the rate of false alarms. The distributions come from clean recordings.
    monitor = InnovationMonitor({"gps": MonitoredSensor("info", 1)}, window=10, false_alarm_rate=1e-3)
    watched = Monitored(make_cart(), monitor)
    clean = [record(4 * runs, steps, off=False)]
    watched.calibrate(clean)
    smallest = monitor.detectable_bias()["gps"]
    print(f"A bias of the innovations below {smallest:.1f} standard deviations passes unnoticed in a second.")

    # The same filter with a gate on the innovations of three steps.
    gated = Gated(make_cart(), 1, response="reject", window=3, rate=1e-4, patience=60).calibrate(clean)

    sound, broken = record(runs, steps, off=False), record(runs, steps, off=True)
    quiet, plain, answered = watched.sequence(sound.clone()), watched.sequence(broken.clone()), gated.sequence(broken)
    alarm = plain["monitor", "alarm"][..., 0]
    delay = alarm[:, OFF:BACK].float().argmax(1)
    print(f"False alarms on fault-free runs: in {1000 * quiet['monitor', 'alarm'].float().mean():.1f} of 1,000 steps.")
    print(f"The GPS goes off: alarm {delay.float().median():.0f} steps after (median of {runs} carts).")
    for name, out in (("without a gate", plain), ("with a gate", answered)):
        during, after = error_of(out)[:, OFF:BACK].mean(), error_of(out)[:, BACK + 10 :].mean()
        print(f"Error {name:15s} {during:.2f} m while it is off, {after:.2f} m from a second after.")
    draw(options.out, plain, answered, monitor.cusum_limit.item())
    print(f"Picture: {options.out}")

    # In an environment the alarm is stored next to the belief.
    motion = torch.tensor([[1.0, DT], [0.0, 0.99]])
    plant = LinearGaussianEnv(motion, torch.eye(1, 2), [0.0, PUSH], [NOISE], initial_std=[0.3, 0.3], seed=0)
    rollout = TransformedEnv(plant, DEnKFTransform(Monitored(make_cart(), monitor))).rollout(20)
    print("Alarms in an environment:", int(rollout["next", "monitor", "alarm"].sum()))


if __name__ == "__main__":
    main()
