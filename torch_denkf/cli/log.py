"""``denkf log``: what is in a log, before anything is filtered.

::

    denkf log drive.csv                      # streams, rates, gaps, repeats, units, delays
    denkf log run.mcap --picture log.png
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from torch_denkf.cli.command import Command, say

__all__ = ["Log"]


@dataclass
class Log(Command):
    """Report on a log: streams, rates, gaps, repeats, bursts, units, and delays between streams."""

    log: Positional[tuple[Path, ...]]  # text, Parquet, or ROS bags, of one clock
    time: str | None = None  # name of the column of times; found by usual names by default
    unit: Literal["s", "ms", "us", "ns"] | None = None  # of the times; by name or size by default
    picture: Path | None = None  # a PNG file to write: time steps, and what several streams know

    name, example = "log", "denkf log drive.csv --picture drive.png"

    def run(self) -> int:
        """Reads all streams."""
        from torch_denkf.data.recordings.offsets import changes_of, delays_between, solved
        from torch_denkf.data.recordings.quantities import speed_unit
        from torch_denkf.data.recordings.streams import streams_of

        logs = " and ".join(map(str, self.log))
        options = {name: value for name, value in (("time", self.time), ("unit", self.unit)) if value is not None}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what they say stands below
            streams = streams_of(*self.log, **options)
        if not streams:
            raise ValueError(f"{logs} has no stream of numbers that change")
        begin = min(one.readings.times[0] for one in streams.values())
        say(f"{logs}: {max(one.readings.times[-1] for one in streams.values()) - begin:.1f} s from {begin:.15g} s")
        for name, one in streams.items():
            columns = list(one.readings.columns)
            shown = ", ".join(columns[:6]) + (f" and {len(columns) - 6} more" if len(columns) > 6 else "")
            say(f"{name}: {len(one.readings.times)} readings, {one.rate:.3g} Hz: {shown}")
            for text in one.oddities():
                say(f"  {text}")
        if others := [name for one in streams.values() for name in one.others]:
            say(f"not used, as they are constant or change at other times than the sensors: {', '.join(others)}")
        tables = {name: one.readings for name, one in streams.items()}
        delays = delays_between(tables)
        offsets = solved(delays, tables) if delays else {}
        for delay in delays:
            late, early = (delay.late, delay.early) if delay.seconds >= 0 else (delay.early, delay.late)
            say(
                f"{late} is {abs(delay.seconds):.2f} s behind {early} ({1.96 * delay.std:.2f} s either way, 95 %), by "
                f"its {delay.what} (correlation {delay.correlation:.2f})"
            )
            ratio = max(abs(delay.scale), 1 / abs(delay.scale))
            unit = speed_unit("", ratio) if delay.what == "way" else "degrees" if 49 < ratio < 66 else None
            if unit is not None:
                say(f"  their numbers differ by {ratio:.3g}: {unit} beside {'rad' if unit == 'degrees' else 'm/s'}?")
        for name, offset in offsets.items():
            if offset.sure:
                say(f"{name}: pass offset={offset.seconds:.2f} to its Table ({1.96 * offset.std:.2f} s either way)")
        if not delays:
            say("no two streams know the same turns or ways, so that delays cannot be found")
        if self.picture is not None:
            from torch_denkf.plots.log import draw_log

            draw_log(*changes_of(tables, {name: one.seconds for name, one in offsets.items()})).savefig(
                self.picture, dpi=120
            )
            say(f"picture in {self.picture}")
        return 0
