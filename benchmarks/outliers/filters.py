"""The compared filters: with the true model and different updates, and learned ones."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import nn

from benchmarks.outliers.task import SHARE, START, WRONG, ReadingNoise, SpeedNoise, moved
from torch_denkf import Filter, Gated
from torch_denkf.baselines import LSTMFilter
from torch_denkf.imperfect import Contaminated, Visible
from torch_denkf.modules import (
    DiagonalNoise,
    EKFAnalysis,
    EKFTransition,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedTransition,
    MomentPrior,
    NoisyTransition,
    Select,
    UKFAnalysis,
    UKFTransition,
)

__all__ = ["UPDATES", "known", "learned", "lstm"]

READING, DIVERGENCE = "reading", 0.01  # chosen on recordings(300, 1) among 0, 0.001, 0.01 and 0.03


def known(kind: str, members: int = 32) -> Filter:
    """Makes an extended or unscented Kalman filter, or an ensemble, with the true motion and noises."""
    motion = LearnedTransition(moved, residual=False, action_key="action")
    if kind == "DEnKF":
        modules = {
            "transition": NoisyTransition(motion, SpeedNoise()),
            "observation": Select([0]),
            "noise": ReadingNoise("ensemble"),
            "analysis": EnsembleAnalysis("etkf", observation_key=READING),
        }
        return Filter(modules, initial=GaussianPrior([0.0, 0.0], START, ensemble_size=members), update_at_reset=True)
    transition, analysis = {"EKF": (EKFTransition, EKFAnalysis), "UKF": (UKFTransition, UKFAnalysis)}[kind]
    modules = {
        "transition": transition(motion, SpeedNoise()),
        "noise": ReadingNoise("mean"),
        "analysis": analysis(Select([0]), observation_key=READING),
    }
    start = MomentPrior(torch.zeros(2), torch.tensor(START).square().diag())
    return Filter(modules, initial=start, update_at_reset=True)


def _around(make: Callable) -> Callable[[Filter], Filter]:
    return lambda filter: filter.with_modules(analysis=make(filter["analysis"]))


#: Wrappers of the update; ``Visible`` reads the share of good readings from the data.
UPDATES: dict[str, Callable[[Filter], Filter]] = {
    "plain": lambda filter: filter,
    'gate, "student"': lambda filter: Gated(filter, 1),
    "`Visible`, told the share": _around(lambda analysis: Visible(analysis, visible_key="sound")),
    "`Contaminated`, told share and width": _around(lambda analysis: Contaminated(analysis, SHARE, noise=[WRONG])),
    "`Contaminated`, `divergence=0.01`": _around(
        lambda analysis: Contaminated(analysis, SHARE, noise=[WRONG], divergence=DIVERGENCE)
    ),
}


def learned(members: int = 32) -> Filter:
    """Returns an ensemble whose motion, noises, share and width of outliers are learned."""
    network = nn.Sequential(nn.Linear(3, 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, 2))
    for parameter in network[-1].parameters():
        nn.init.zeros_(parameter)
    motion = LearnedTransition(network, action_key="action", action_scale=[2.0])
    noise = DiagonalNoise(2, r=[0.03, 0.2], in_key=("belief", "mean"), out_key=("forecast", "noise"))
    analysis = EnsembleAnalysis("etkf", observation_key=READING)
    modules = {
        "transition": NoisyTransition(motion, noise),
        "observation": Select([0]),
        "noise": DiagonalNoise(1, r=0.1, in_key=("forecast", "observation")),
        "analysis": Contaminated(analysis, 0.1, noise=[1.0], divergence=DIVERGENCE, trainable=True),
    }
    return Filter(modules, initial=GaussianPrior([0.0, 0.0], START, ensemble_size=members), update_at_reset=True)


def lstm(hidden: int = 64) -> Filter:
    """Returns a recurrent network of the same readings and drives."""
    return LSTMFilter(
        None,
        state_dim=2,
        observation_dim=1,
        observation_key=READING,
        extra_keys=["action"],
        extra_features=1,
        hidden_size=hidden,
        scale=[0.6, 1.0],
        update_at_reset=True,
    )
