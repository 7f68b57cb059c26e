"""Smoothing on one page: a pendulum whose encoder reads every fifth step, filtered, and then smoothed.

    python examples/smoothing.py

A filter uses past readings; a smoother also uses later ones. The program compares both on recordings, runs a fixed-lag
smoother in an environment, and trains with a loss on the smoothed belief for a few steps. It needs no data set, and
takes ten seconds. The documentation is in ``docs/how_to/smoothing.md``; the measured errors of all
smoothers are in ``docs/results/smoothing.md``.
"""

from __future__ import annotations

import argparse
from functools import partial

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.envs import TransformedEnv

from torch_denkf import (
    UKF,
    DEnKF,
    DEnKFLoss,
    DEnKFTransform,
    EnKS,
    EnRTS,
    FixedLag,
    KalmanFilter,
    LinearGaussianEnv,
    RTSSmoother,
)
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, GaussianPrior, LearnedTransition, MomentPrior, Select

DT, PUSH, NOISE, EVERY = 0.05, 0.15, 0.1, 5  # s; rad/s per step; rad; steps between readings
START = torch.tensor([0.5, 0.0]), torch.tensor([0.5, 0.5])  # mean and standard deviation of [angle rad, rate rad/s]


class Swing(nn.Module):
    """Maps a pendulum's [angle, rate] one step ahead; its length in metres is a parameter."""

    def __init__(self, length: float = 1.0):
        super().__init__()
        self.length = nn.Parameter(torch.tensor(length))

    def forward(self, state: Tensor) -> Tensor:
        angle, rate = state.unbind(-1)
        faster = rate + DT * (-9.81 / self.length * angle.sin() - 0.1 * rate)
        return torch.stack([angle + DT * faster, faster], -1)


def record(runs: int, steps: int) -> TensorDict:
    """Returns true states, and the encoder's readings of the angle."""
    swing, state, states = Swing(), START[0] + START[1] * torch.randn(runs, 2), []
    for _ in range(steps):
        states.append(state)
        state = swing(state).detach() + torch.tensor([0.0, PUSH]) * torch.randn(runs, 2)
    truth = torch.stack(states, 1)
    observed = (torch.arange(steps) % EVERY == 0).expand(runs, steps).unsqueeze(-1)
    reading = truth[..., :1] + NOISE * torch.randn(runs, steps, 1)
    return TensorDict({"state": truth, "encoder": reading, "observed": observed}, [runs, steps])


def make_denkf(swing: Swing | None = None, members: int = 100) -> DEnKF:
    """Returns an ensemble filter of the pendulum."""
    return DEnKF(
        transition=LearnedTransition(swing or Swing(), residual=False),
        sensor=None,
        observation=Select([0]),
        noise=ConstantNoise([NOISE], in_key="encoder"),
        analysis=EnsembleAnalysis("etkf", observation_key="encoder"),
        process_noise=[0.0, PUSH],
        initial=GaussianPrior(*START, ensemble_size=members),
    )


def make_ukf() -> UKF:
    """Returns an unscented Kalman filter of the pendulum."""
    return UKF(
        LearnedTransition(Swing(), residual=False),
        None,
        Select([0]),
        ConstantNoise([NOISE], in_key="encoder"),
        process_noise=[0.0, PUSH],
        initial=MomentPrior(START[0], START[1].square().diag()),
        observation_key="encoder",
    )


def show(name: str, mean: Tensor, var: Tensor, truth: Tensor) -> None:
    """Prints errors of angle and rate, and the coverage of the 90 % intervals."""
    error = mean - truth
    angle, rate = error.square().flatten(0, 1).mean(0).sqrt().tolist()
    inside = 100 * (error.abs() < 1.645 * var.sqrt()).float().mean().item()
    print(f"{name:34s} {angle:.3f} rad   {rate:.3f} rad/s   {inside:.0f} %")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true", help="a tiny run of everything")
    runs, steps = (3, 20) if parser.parse_args().smoke else (20, 200)
    torch.manual_seed(0)
    torch.set_num_threads(1)
    recordings = record(runs, steps)
    truth = recordings["state"]

    print(f"{'RMSE over recordings':34s} angle       rate          90 % coverage")
    smoothers = {
        "DEnKF, EnKS, 5 steps ahead": EnKS(make_denkf(), lag=5),
        "DEnKF, EnRTS, 5 steps ahead": EnRTS(make_denkf(), lag=5),
        "DEnKF, EnRTS, all that came later": EnRTS(make_denkf()),
        "UKF, RTS, all that came later": RTSSmoother(make_ukf()),
    }
    for name, smoother in smoothers.items():
        with torch.no_grad():
            out = smoother(recordings.copy())
        if name.startswith(("DEnKF, EnKS", "UKF")):
            show(name.split(",")[0] + ", the filter alone", out["belief", "mean"], out["belief", "var"], truth)
        show(name, out["smoothed", "mean"], out["smoothed", "var"], truth)

    # Online: the belief at present, and a smoothed one 10 steps earlier. Small swings are a linear system.
    swing, angle = torch.tensor([[1.0, DT], [-9.81 * DT, 1.0 - 0.1 * DT]]), torch.tensor([[1.0, 0.0]])
    plain = LinearGaussianEnv(swing, angle, [0.0, PUSH], [NOISE], missing=0.5, batch_size=[runs], seed=0)
    noises = {"process_noise": [0.0, PUSH], "noise": [NOISE]}
    kalman = KalmanFilter(swing, angle, **noises, mean=torch.zeros(2), cov=torch.eye(2))
    later = TransformedEnv(plain, DEnKFTransform(FixedLag(kalman, 10))).rollout(steps)["next"]
    now = later["belief", "mean"][:, 10:] - later["state"][:, 10:]
    then = later["smoothed", "mean"][:, 10:] - later["state"][:, :-10]
    print("\nIn an environment:")
    print(f"  the rate now is known to {now[..., 1].square().mean().sqrt():.3f} rad/s,")
    print(f"  that of 10 steps ago to  {then[..., 1].square().mean().sqrt():.3f} rad/s")

    # A loss may score the smoothed belief: here it finds the length, which starts twice too large.
    swing = Swing(length=2.0)
    denkf = make_denkf(swing, members=30)
    loss = DEnKFLoss(denkf, state=0.0, transition=0.0, smoothed=1.0, smoother=partial(EnRTS, lag=10))
    optimiser = torch.optim.Adam(denkf.parameters(), 0.1)
    for _ in range(2 if parser.parse_args().smoke else 20):
        value = loss(recordings[:, :50])["loss_smoothed"]
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
    print(f"\nLength, learned from the smoothed belief: {swing.length.item():.2f} m (true 1.00 m)")


if __name__ == "__main__":
    main()
