"""``denkf fuse``: from a log to a path, with the settings of robot_localization.

::

    denkf fuse drive.csv --out runs/drive                      # settings by the log's columns
    denkf fuse run.mcap --config ekf.yaml --out runs/run --gaps 3
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from torch_denkf.cli.command import Command, alone_in, say

__all__ = ["Fuse"]


@dataclass
class Fuse(Command):
    """Filter and smooth a log; report the accepted share of each sensor; learn the noises; write path and settings."""

    log: tyro.conf.Positional[tuple[Path, ...]]  # text, Parquet, or ROS bags, of one clock
    out: Path  # folder for path.csv, path.tum, path.geojson, path.png, bands.png, report.md and ekf.yaml
    also: tuple[Path, ...] = ()  # further logs of the same robot to learn from
    config: Path | None = None  # YAML of robot_localization, whose topics are topics or streams; by default by the log
    kind: Literal["ekf", "ukf"] = "ekf"  # the extended Kalman filter, or the unscented one
    steps: int = 6  # of each of three stages of learning; 0 leaves the noises as they are
    gaps: int = 0  # hide the poses in so many stretches, and say how far off the path is there
    gap_seconds: float = 15.0  # of a stretch, and of those that are hidden to learn

    name, example = "fuse", "denkf fuse drive.csv --out runs/drive"

    def run(self) -> int:
        """Reads, learns, smooths, writes."""
        import numpy as np
        import torch

        from torch_denkf._checks import check_count, check_number
        from torch_denkf.applications.robot import robot_model
        from torch_denkf.applications.robot.learning import learn_noises
        from torch_denkf.applications.robot.log import (
            default_settings,
            drift_settings,
            log_streams,
            not_used,
            read_log,
            rows_of_log,
            start_of,
        )
        from torch_denkf.applications.robot.report import draw, gap_errors, sensor_lines, write_path
        from torch_denkf.smoothers import RTSSmoother

        check_count("--steps", self.steps, least=0)
        check_count("--gaps", self.gaps, least=0)
        check_number("--gap-seconds", self.gap_seconds, above=0)
        streams = log_streams(*self.log)
        model = robot_model(default_settings(streams) if self.config is None else self.config, kind=self.kind)
        unused = [*(f"not honoured: {text}" for text in model.unheeded), *not_used(streams, model.config)]
        for text in unused:
            say(text)
        log = read_log(" and ".join(map(str, self.log)), model.config, streams)
        if self.steps:
            model = robot_model(drift_settings(log, model), kind=self.kind)
        model = start_of(log, model)
        full = rows_of_log(log, model)
        begin, end = float(full["stamp"][0]), float(full["stamp"][-1])
        middles = begin + (end - begin) * (np.arange(self.gaps) + 1) / (self.gaps + 1)
        hidden = np.stack([middles, middles], 1) + np.array([-0.5, 0.5]) * self.gap_seconds
        rows = rows_of_log(log, model, hidden)
        self.out.mkdir(parents=True, exist_ok=True)
        with alone_in(self.out):
            lines = [f"# {', '.join(each.name for each in self.log)}", "", f"`{self.command_line}`", ""]
            if self.steps:
                others = []
                for file in self.also:
                    other = read_log(file, model.config, log_streams(file))
                    others.append((start_of(other, model), rows_of_log(other, model)))
                learned = learn_noises(model, rows, others=others, steps=self.steps, window=self.gap_seconds)
                lines.append(
                    f"Log-likelihood of what was held out: {learned.before:.3f} with the noises at first, "
                    f"{learned.after:.3f} with those learned" + (", interrupted." if learned.interrupted else ".")
                )
            with torch.no_grad():
                out = RTSSmoother(model.filter)(rows.clone())
            if self.gaps:
                error, held, count = gap_errors(out, full, model)
                lines.append(
                    f"In {self.gaps} gaps of {self.gap_seconds:g} s, {count} fixes that were hidden: {error:.2f} m off "
                    f"(root mean square), {held:.0%} within the 95 % intervals of a fix."
                )
            lines += ["", *sensor_lines(model, log, out), "", *(f"{text[0].upper()}{text[1:]}" for text in unused)]
            names = write_path(self.out, model, log, out)
            (self.out / "report.md").write_text("\n".join(lines) + "\n", "utf-8")
            say("\n".join(lines[4:]))
            try:
                draw(self.out / "path.png", model, out)
                names.append("path.png")
            except ImportError as error_:
                say(str(error_))
            say(f"{', '.join(names)} in {self.out}")
        return 0
