"""The analysis for S = O = 10 to a million: time, memory and digits; 32 members, diagonal R, one thread.

    python -m benchmarks.speed.scaling --out benchmarks/speed/results/scaling.md

Time: processor time of a call, median of rounds that go through all sizes in turn. Memory: what torch's allocator
holds at most during a call (torch.profiler, every allocation and release), plus the call's arguments; for the largest
size also the resident peak (VmHWM) of a child process. Digits: the increment in single against double precision.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import torch
from torch import Tensor

from benchmarks.common.arguments import command, parse
from benchmarks.common.tables import head, line, write_page
from benchmarks.speed.machine import resident_peak
from benchmarks.speed.pairs import Row
from torch_denkf.functional import analyse

MEMBERS = 32
SIZES = (10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000, 300_000, 1_000_000)
LINEAR_FROM = 10_000
SCHEMES = ("sensor", "etkf")
NOISES = (0.5, 1e-5, 1e-7)  # variances R; the members' own is 1
COPIES = 6  # the most that may be held, arguments included


def problem(size: int, scheme: str, noise: float, dtype: torch.dtype = torch.float32) -> dict[str, Tensor | str]:
    """Arguments of analyse: every component is observed, the truth lies a standard deviation off."""
    generator = torch.Generator().manual_seed(size)
    forecast = torch.randn(MEMBERS, size, generator=generator)
    truth = torch.randn(size, generator=generator)
    observation = truth + noise**0.5 * torch.randn(MEMBERS, size, generator=generator)
    return {
        "forecast": forecast.to(dtype),
        "predicted": forecast.to(dtype, copy=True),
        "observation": (observation if scheme == "sensor" else observation[0]).to(dtype, copy=True),
        "noise": torch.full((size,), noise, dtype=dtype),
        "scheme": scheme,
    }


def increment_error(size: int, scheme: str, noise: float) -> float:
    """Relative error of single precision's increment, in the Euclidean norm over all members and components."""
    single = problem(size, scheme, noise)
    found = analyse(**single).ensemble
    double = {name: value.double() if torch.is_tensor(value) else value for name, value in single.items()}
    expected = analyse(**double).ensemble.sub_(double["forecast"])
    return float((found.double().sub_(double["forecast"]) - expected).norm() / expected.norm())


def allocated_peak(call) -> int:
    """The most bytes that torch's allocator held during a call beyond what it held before."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
        result = call()
    del result
    changes, stack = [], list(profile.profiler.kineto_results.experimental_event_tree())
    while stack:
        event = stack.pop()
        stack += event.children
        if event.tag == torch._C._profiler._EventType.Allocation:
            changes.append((event.start_time_ns, event.extra_fields.alloc_size))
    now = peak = 0
    for _, change in sorted(changes, key=lambda item: item[0]):
        now += change
        peak = max(peak, now)
    return peak


def copies(size: int, scheme: str) -> float:
    """Peak memory of a call, arguments and result included, in ensembles ``[E, S]``."""
    arguments = problem(size, scheme, NOISES[0])
    held = sum(value.nbytes for value in arguments.values() if torch.is_tensor(value))
    return (held + allocated_peak(lambda: analyse(**arguments))) / arguments["forecast"].nbytes


def resident_copies(size: int, scheme: str) -> float:
    """The same from the resident peak of a child process; its libraries and what they keep do not count."""
    warm, inputs = (f"scaling.problem({count}, {scheme!r}, {NOISES[0]})" for count in (100_000, size))
    prepare = f"from benchmarks.speed import scaling\nscaling.analyse(**{warm})"
    taken = resident_peak(prepare, "scaling.analyse(**arguments)", f"arguments = {inputs}")
    return taken / (4 * MEMBERS * size)


def times(scheme: str, rounds: int, sizes: tuple[int, ...]) -> list[float]:
    """Seconds of processor time a call, one for each size."""
    spent: list[list[float]] = [[] for _ in sizes]
    for turn in range(rounds + 1):  # the first one warms up
        for size, seconds in zip(sizes, spent, strict=True):
            arguments, calls = problem(size, scheme, NOISES[0]), max(1, 3000 // size)
            analyse(**arguments)
            began = time.process_time()
            for _ in range(calls):
                analyse(**arguments)
            if turn:
                seconds.append((time.process_time() - began) / calls)
    return [median(seconds) for seconds in spent]


def slope(sizes: list[int], values: list[float]) -> float:
    """Of the line through log values over log sizes, by least squares, from LINEAR_FROM on."""
    x = torch.tensor([size for size in sizes if size >= LINEAR_FROM], dtype=torch.float64).log()
    y = torch.tensor(values[-len(x) :], dtype=torch.float64).log()
    x, y = x - x.mean(), y - y.mean()
    return float((x * y).sum() / x.square().sum())


def measure(rounds: int = 9, sizes: tuple[int, ...] = SIZES) -> dict[str, dict]:
    """Everything, by scheme."""
    torch.set_num_threads(1)
    out = {}
    for scheme in SCHEMES:
        held = [copies(size, scheme) for size in sizes]
        out[scheme] = {
            "sizes": list(sizes),
            "seconds": times(scheme, rounds, sizes),
            "copies": held,
            "bytes": [4 * MEMBERS * size * count for size, count in zip(sizes, held, strict=True)],
            "errors": {noise: [increment_error(size, scheme, noise) for size in sizes] for noise in NOISES},
            "resident_copies": resident_copies(sizes[-1], scheme),
        }
    return out


def rows_of(found: dict[str, dict]) -> list[Row]:
    """Slopes, which must also be at least 0.9, and copies of the ensemble."""
    rows = []
    for scheme, values in found.items():
        for what in ("seconds", "bytes"):
            value = slope(values["sizes"], values[what])
            name = f"analysis ({scheme}), S = O: slope of {'time' if what == 'seconds' else 'memory'} from 10^4 to 10^6"
            rows.append(Row(name, value, 1.1, note="0.9 to 1.1", least=0.9))
        large = [held for size, held in zip(values["sizes"], values["copies"], strict=True) if size >= LINEAR_FROM]
        most = max(*large, values["resident_copies"])
        name = f"analysis ({scheme}), S = O: ensembles in memory, at most, from 10^4 to 10^6"
        rows.append(Row(name, most, COPIES, note="arguments and result included"))
    return rows


def rows(seconds: float) -> list[Row]:
    """The same for ``make bench``, which takes as long as it takes."""
    return rows_of(measure())


def table(found: dict[str, dict], command: str, seconds: float) -> str:
    """The Markdown page."""
    lines = [
        "# The analysis from 10 to a million components",
        "",
        f"S = O, {MEMBERS} members, diagonal R, `analyse` as a user calls it (observation space below {MEMBERS}",
        "observations, ensemble space above, in tiles from 4,096 on); single precision, one thread. Time: processor",
        "time of a call, median. Copies: the most memory that is held during a call, arguments and result included, in",
        'ensembles [E, S]; the arguments alone are three for "sensor" and two for "etkf". Error: of the increment',
        "against double precision, relative, for variances R of 0.5, 1e-5 and 1e-7 (the members' is 1).",
        "",
        *head("scheme", "S = O", "time, ms", "copies", "error, R = 0.5", "R = 1e-5", "R = 1e-7"),
    ]
    for scheme, values in found.items():
        for row, size in enumerate(values["sizes"]):
            errors = [f"{values['errors'][noise][row]:.0e}" for noise in NOISES]
            cells = [f"{1e3 * values['seconds'][row]:.3g}", f"{values['copies'][row]:.2f}", *errors]
            lines.append(line(scheme, f"{size:,}", *cells))
    lines += ["", *head("what", "value", "wanted", "met")]
    for row in rows_of(found):
        wanted = row.note if row.least else f"<= {row.target}"
        lines.append(line(row.name, f"{row.ratio:.2f}", wanted, row.met_text))
    resident = ", ".join(f"{scheme} {values['resident_copies']:.2f}" for scheme, values in found.items())
    lines += [
        "",
        f"* Copies by torch's allocator; by the resident peak of a child process at the largest size: {resident}.",
        f"* `{command}`: {seconds:.0f} s; torch {torch.__version__}.",
    ]
    return "\n".join(lines) + "\n"


@dataclass
class Scaling:
    """The analysis for S = O = 10 to a million: time, memory and digits."""

    rounds: int = 9  # measurements of each time
    out: Path | None = None  # write the tables to this Markdown file
    smoke: bool = False  # small sizes, one round: does it run?

    def __call__(self) -> None:
        """Measures and prints."""
        began = time.perf_counter()
        found = measure(1 if self.smoke else self.rounds, (10, 100, 10_000, 20_000) if self.smoke else SIZES)
        write_page(table(found, command("speed.scaling"), time.perf_counter() - began), self.out)


if __name__ == "__main__":
    parse(Scaling)()
