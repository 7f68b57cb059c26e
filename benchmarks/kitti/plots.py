"""Pictures of one drive: path, velocities, errors by length, spread against error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDict

from benchmarks.common.plots import draw_band, plt, save
from benchmarks.kitti.folds import VELOCITIES


def draw_drive(belief: TensorDict, rows: Sequence[dict], title: str, dt: float, file: Path) -> None:
    """Draws what a filter believed on one drive in one condition.

    Args:
        belief: the filter's sequence ``[N]``.
        rows: the drive's rows of the table in this condition, of all filters.
        title: headline.
        dt: s.
        file: PNG.
    """
    truth, mean = belief["state"], belief["belief", "mean"][..., :5]
    deviation = belief["belief", "var"][..., :5].sqrt()
    layout = "pvv;pww;lss"
    figure, axes = plt.subplot_mosaic(layout, figsize=(14, 10), width_ratios=[1.2, 1, 1], layout="constrained")
    path = axes["p"]
    if "ensemble" in belief["belief"]:
        members = belief["belief", "ensemble"][:, :32]
        path.plot(-members[..., 1], members[..., 0], color="tab:blue", alpha=0.06, linewidth=1)
    path.plot(-truth[:, 1], truth[:, 0], "k-", linewidth=1.5, label="truth")
    path.plot(-mean[:, 1], mean[:, 0], "b-", linewidth=1.5, label="filter, never set back")
    path.plot([], [], color="tab:blue", alpha=0.4, label="ensemble members")
    path.set(xlabel="right, m", ylabel="forward, m", title="path on the ground plane")
    path.axis("equal")
    path.legend()
    seconds, seen = torch.arange(len(truth)) * dt, belief["observed"].squeeze(-1)
    for name, dim, unit, factor in (("v", 3, "v, m/s", 1.0), ("w", 4, "theta_dot, deg/s", 57.2958)):
        axis, std = axes[name], deviation[:, dim] * factor
        reading = belief["sensor", "ensemble"][..., dim - 3].mean(1) / belief["steps"].clamp_min(1).squeeze(-1) * factor
        axis.plot(seconds[seen], reading[seen], ".", color="tab:red", markersize=2, label="sensor readings")
        low, high = draw_band(axis, seconds, mean[:, dim] * factor, std, truth[:, dim] * factor)
        axis.set(xlabel="s", ylabel=unit)
        shown = torch.cat([truth[:, dim] * factor, low, high])
        axis.set_ylim(float(shown.min()) - 0.5, float(shown.max()) + 0.5)
    axes["v"].legend(ncols=4, loc="upper center", bbox_to_anchor=(0.5, 1.2))
    for name in dict.fromkeys(row["filter"] for row in rows):
        own = sorted((row["window"], row["translation_m_per_m"]) for row in rows if row["filter"] == name)
        axes["l"].plot(*zip(*own, strict=True), "o-", label=name.replace("_", " "))
    axes["l"].set(xlabel="steps", ylabel="end point error, m/m", xscale="log", ylim=(0, None))
    axes["l"].legend()
    _spread_against_error(axes["s"], deviation[1:, VELOCITIES], (mean - truth)[1:, VELOCITIES].abs())
    figure.suptitle(title)
    save(figure, file, dpi=90)


def _spread_against_error(axis, spread: torch.Tensor, error: torch.Tensor, bins: int = 8) -> None:
    """Root mean squares of both, over rows sorted by spread: on the diagonal the filter knows how wrong it is."""
    for dim, (label, factor) in enumerate((("v, m/s", 1.0), ("theta_dot, deg/s", 57.2958))):
        order = spread[:, dim].argsort()
        pairs = [
            (float(spread[part, dim].square().mean().sqrt()), float(error[part, dim].square().mean().sqrt()))
            for part in order.chunk(bins)
        ]
        axis.plot(*zip(*[(x * factor, y * factor) for x, y in pairs], strict=True), "o-", label=label)
    limit = max(axis.get_xlim()[1], axis.get_ylim()[1])
    axis.plot([0, limit], [0, limit], "k:", label="calibrated")
    axis.set(xlabel="ensemble spread", ylabel="RMS error", xlim=(0, limit), ylim=(0, limit))
    axis.legend()
