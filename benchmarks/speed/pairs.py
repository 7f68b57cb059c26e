"""Times candidates in short interleaved rounds in one process, and returns the median of the rounds' ratios.

A round times every candidate once, so that a slowdown of the machine affects all of them; the order changes from round
to round. Times are processor time over all threads of the process: other jobs on the same cores do not count, and a
peer with two threads pays for both.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from statistics import median

Call = Callable[[], object]
MET = {True: "yes", False: "**no**", None: ""}


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        name: the compared work, with its size.
        ratio: ours over theirs; below 1 ours is faster.
        target: upper limit of the ratio; ``None`` for none.
        least: lower limit, for values that are no ratios of times.
        aim: a ratio to aim for.
        ours_us: microseconds of our processor time, per step unless the name says otherwise.
        theirs_us: the same of the other side.
        note: differences between the two sides, in a line.
    """

    name: str
    ratio: float | None
    target: float | None = None
    aim: float | None = None
    ours_us: float | None = None
    theirs_us: float | None = None
    note: str = ""
    least: float = 0.0

    @property
    def met(self) -> bool | None:
        """Returns whether the target is met; ``None`` without a target or a measurement."""
        return None if self.target is None or self.ratio is None else self.least <= self.ratio <= self.target

    @property
    def met_text(self) -> str:
        """Returns :attr:`met` as text for a table."""
        return MET[self.met]

    def as_dict(self) -> dict:
        """Returns the entries for JSON."""
        return {name: value for name, value in asdict(self).items() if name != "least"} | {"met": self.met}


@dataclass(frozen=True)
class Timings:
    """Seconds of processor time per call, for each candidate and round."""

    rounds: dict[str, list[float]]

    def micro(self, name: str, per: int = 1) -> float:
        """Returns the median microseconds of a candidate; ``per`` is the number of steps in a call."""
        return 1e6 * median(self.rounds[name]) / per

    def ratio(self, ours: str, theirs: str) -> float:
        """Returns the median over the rounds of ours over theirs."""
        pairs = zip(self.rounds[ours], self.rounds[theirs], strict=True)
        return median(ours_time / theirs_time for ours_time, theirs_time in pairs)

    def row(self, name: str, ours: str, theirs: str, *, per: int = 1, **fields) -> Row:
        """Returns the table's line for two of the candidates."""
        times = {"ours_us": self.micro(ours, per), "theirs_us": self.micro(theirs, per)}
        return Row(name, self.ratio(ours, theirs), **times, **fields)


def interleave(
    candidates: Mapping[str, Callable[[], object]], *, seconds: float = 8.0, shortest: float = 2e-3, rounds: int = 15
) -> Timings:
    """Times ``candidates`` in turn.

    Args:
        candidates: functions without arguments, by name; each is called a few times beforehand.
        seconds: wall-clock time to spend, if more than ``rounds`` rounds fit into it.
        shortest: least duration of a measurement in s, which repeats its call accordingly.
        rounds: least number of rounds.
    """
    numbers = {}
    for name, call in candidates.items():
        for _ in range(3):
            call()
        begun = time.process_time()
        call()
        numbers[name] = max(1, int(shortest / max(time.process_time() - begun, 1e-7)))
    settle()
    times: dict[str, list[float]] = {name: [] for name in candidates}
    names, end, done = list(candidates), time.perf_counter() + seconds, 0
    gc.collect()
    gc.disable()
    try:
        while done < rounds or time.perf_counter() < end:
            for name in names[done % len(names) :] + names[: done % len(names)]:
                call = candidates[name]
                begun = time.process_time()
                for _ in range(numbers[name]):
                    call()
                times[name].append((time.process_time() - begun) / numbers[name])
            done += 1
            if done % 20 == 0:  # autograd makes reference cycles
                gc.collect()
    finally:
        gc.enable()
    return Timings(times)


def against(ours: Mapping[str, Call], name: str, theirs: Call, title: str, *, how: dict, **fields) -> list[Row]:
    """Returns a row for each of our calls against another package's.

    Args:
        ours: our calls by kind.
        name: of the other package.
        theirs: its call.
        title: of the rows, after the kind.
        how: options of :func:`interleave`.
        **fields: of the rows.
    """
    timings = interleave({**ours, name: theirs}, **how)
    return [timings.row(f"{kind} {title}", kind, name, **fields) for kind in ours]


def in_turn(calls: Mapping[str, Callable[[], object]], rounds: int, repeats: int = 1) -> Timings:
    """Times slow calls: ``rounds`` rounds of all after a warm-up, with ``repeats`` calls of each in a round."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for turn in range(rounds + 1):
        for name, call in calls.items():
            began = time.process_time()
            for _ in range(repeats):
                call()
            if turn:
                seconds[name].append((time.process_time() - began) / repeats)
    return Timings(seconds)


def settle(limit: float = 30.0) -> None:
    """Waits until this process is idle, at most ``limit`` seconds: inductor's threads run on after compiling."""
    end = time.perf_counter() + limit
    while time.perf_counter() < end:
        begun = time.process_time()
        time.sleep(0.5)
        if time.process_time() - begun < 0.005:
            return
