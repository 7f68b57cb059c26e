"""The pictures of the front page's cards: ``python docs/cards/draw.py``, half a minute.

The first two run the programs of ``docs/start/three_ways.md``; the others draw tables of ``benchmarks/``.
"""

import csv
import re
from pathlib import Path
from statistics import median

import torch
from matplotlib.figure import Figure

from torch_denkf.plots import plot_bands

ROOT = Path(__file__).parents[2]
BLUE, ORANGE, GREEN = "#0072B2", "#E69F00", "#009E73"


def program(index: int) -> dict:
    """Runs a program of the page; returns the names that it defines."""
    page = (ROOT / "docs" / "start" / "three_ways.md").read_text()
    names: dict = {}
    exec(re.findall(r"^```python\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)[index], names)
    return names


def table(path: str) -> list[dict]:
    """The rows of a CSV file."""
    with (ROOT / path).open() as file:
        return list(csv.DictReader(file))


def append(ax):
    """Speed of a cart that no sensor reads."""
    cart = program(0)["rollout"]["next"][0]
    plot_bands(cart, dims=[1], names=["speed, m/s"], time=0.1, ax=[ax])
    ax.set_xlabel("s")


def compose(ax):
    """Error of a robot's place y over time, by two sensors and by one."""
    names = program(1)
    fused, runs = names["fused"], names["unseen"]
    seconds = [0.1 * step for step in range(runs.shape[1])]
    for seen, label, colour in ((False, "wheel alone", ORANGE), (True, "beacons and wheel", BLUE)):
        runs["beacons_observed"].fill_(seen)
        with torch.no_grad():
            error = fused.sequence(runs.clone())["belief", "mean"] - runs["state"]
        ax.plot(seconds, error[..., 1].square().mean(0).sqrt(), color=colour, label=label)
    ax.set(xlabel="s", ylabel="error of y, m", ylim=(0, None))
    ax.legend()


def policy(ax):
    """Return of a policy while it learns: the median of five seeds."""
    rows = [row for row in table("benchmarks/control/results/control.csv") if row["cell"] == "noise 0.2, 30% missing"]
    for arm, label, colour in (("belief mean", "belief", BLUE), ("LSTM", "LSTM", ORANGE)):
        curves: dict[int, list[float]] = {}
        for row in rows:
            if row["arm"] == arm:
                curves.setdefault(int(row["env_steps"]), []).append(float(row["return"]))
        ax.plot([step / 1000 for step in curves], [median(returns) for returns in curves.values()], colour, label=label)
        lowest, highest = zip(*((min(returns), max(returns)) for returns in curves.values()), strict=True)
        ax.fill_between([step / 1000 for step in curves], lowest, highest, color=colour, alpha=0.2, linewidth=0)
    ax.set(xlabel="thousand steps of the pendulum", ylabel="return")
    ax.legend()


def results(ax):
    """Error of an arm's joints against time of a step."""
    rows = table("benchmarks/ur5/results/frontier.csv")
    shown = {"DEnKF, sensor": ("DEnKF", BLUE), "dekf": ("extended KF", ORANGE), "bkf": ("Backprop KF", GREEN)}
    for name, (label, colour) in shown.items():
        points = [(float(row["ms_per_step"]), float(row["joint_mae_deg"])) for row in rows if row["filter"] == name]
        ax.plot(*zip(*points, strict=True), "o-", color=colour, label=label)
    ax.set(xlabel="ms a step", ylabel="error of UR5's joints, degrees")
    ax.legend()


for draw in (append, compose, policy, results):
    figure = Figure(figsize=(4.8, 3.0), layout="constrained")
    draw(figure.add_subplot())
    figure.savefig(Path(__file__).with_name(f"{draw.__name__}.png"), dpi=120)
