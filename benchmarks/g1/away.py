"""What a filter believes of an arm when its camera is off for seconds: ``python -m benchmarks.g1.away``.

The readings are the true joints with white noise. Two filters with the same learned motion learn from them: one from
windows in which every row is read, one from windows half of which are read at the beginning alone.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import head, line, write_page
from benchmarks.g1.motion import Motion, train_motion, with_rates
from benchmarks.g1.recordings import ARM as JOINTS
from benchmarks.g1.targets import ARM
from torch_denkf import DEnKF, DEnKFLoss
from torch_denkf.data.lerobot.replay import is_for_tests
from torch_denkf.modules import AroundState, ConstantNoise, EnsembleAnalysis, LearnedTransition, Select

NOISE, SIZE = math.radians(2.0), ARM.size  # rad, of a reading; joints
READ, AFTER = 30, (0, 30, 90, 300)  # rows that are read; rows after them at which is scored: 30 a second
WINDOWS = {"every row read": (64, None), "half of the windows with gaps": (160, 20)}  # rows of a window, rows read


@dataclass(frozen=True)
class Away:
    """An arm whose camera is off for 1, 3 and 10 s."""

    root: Path = Path("../shared/data/g1")  # LeRobot folder
    out: Path | None = None  # file of the table
    motion: int = 1500  # updates of the motion on true states
    updates: int = 120  # of a filter
    runs: int = 40  # that are scored, of test episodes


def episodes(root: Path) -> dict[int, Tensor]:
    """Joints ``[T, 7]`` by the number of the episode."""
    found = {}
    for file in sorted(root.glob("data/**/*.parquet")):
        table = pq.read_table(file, columns=["observation.state", "episode_index"])
        states, number = np.stack(table["observation.state"].to_numpy()), table["episode_index"].to_numpy()
        found |= {int(one): torch.tensor(states[number == one][:, list(JOINTS)]).float() for one in np.unique(number)}
    return found


def windows(known: list[Tensor], rows: int, count: int, read: int | None, facts, generator) -> TensorDict:
    """Stretches of episodes with readings, which end after so many rows, ``[count, rows]``."""
    long, states = [one for one in known if len(one) > rows], []
    for _ in range(count):
        one = long[int(torch.randint(len(long), (), generator=generator))]
        begin = int(torch.randint(len(one) - rows, (), generator=generator))
        states.append(with_rates(one)[begin : begin + rows])
    data = TensorDict({"state": torch.stack(states)}, [count, rows])
    joints = data["state"][..., :SIZE]
    data["reading"] = joints + NOISE * torch.randn(joints.shape, generator=generator)
    data["observed"] = (torch.arange(rows) < (rows if read is None else read)).view(1, -1, 1).expand(count, -1, 1)
    data["start"] = torch.cat([facts.loc, torch.zeros(SIZE)]).expand(count, rows, -1)
    return data


def make(motion: Motion, facts) -> DEnKF:
    """A filter of joints and their rates, with process noise that is learned."""
    q = torch.cat([0.01 * facts.rate, 0.5 * facts.acceleration])
    return DEnKF(
        LearnedTransition(motion, residual=False),
        None,
        Select(list(range(SIZE))),
        ConstantNoise([NOISE] * SIZE, in_key="reading"),
        EnsembleAnalysis("etkf", observation_key="reading"),
        initial=AroundState(torch.cat([facts.scale, facts.rate]).tolist(), ensemble_size=64, state_key="start"),
        process_noise=ConstantNoise(q, trainable=True, in_key=("belief", "mean"), out_key=("forecast", "noise")),
    )


def fit(filter: DEnKF, known: list[Tensor], facts, rows: int, read: int | None, updates: int) -> None:
    """Trains by the CRPS of the joints; every other update has windows with a gap, where ``read`` says how long."""
    loss = DEnKFLoss(filter, transition=0.0, sensor=0.0, dims=list(range(SIZE)), state_scale=[math.radians(1)] * SIZE)
    optimiser, generator = torch.optim.Adam(filter.parameters(), 2e-3), torch.Generator().manual_seed(0)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 4e-3, total_steps=updates)
    for update in range(updates):
        total = sum(loss(windows(known, rows, 8, read if update % 2 else None, facts, generator)).values())
        optimiser.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(filter.parameters(), 10.0)
        optimiser.step()
        schedule.step()


def cells(error: Tensor, std: Tensor | None) -> list[str]:
    """Mean absolute errors in degrees, and what 90 % intervals hold, at the rows that are scored."""
    rows = [READ - 1 + after for after in AFTER]
    off = [f"{error[:, row].mean().rad2deg():.1f}" for row in rows]
    if std is None:
        return off
    held = [f"{100 * (error[:, row] < 1.645 * std[:, row]).float().mean():.0f} %" for row in rows]
    return [f"{one}, {share}" for one, share in zip(off, held, strict=True)]


def main() -> None:
    """Trains both filters, and writes the table."""
    study = parse(Away)
    found = episodes(study.root)
    test = [one for number, one in found.items() if is_for_tests(number)]
    known = [one for number, one in found.items() if not is_for_tests(number)]
    rates, flat = [one.diff(dim=0) for one in known], torch.cat(known)
    rate, acceleration = (
        torch.cat(all_of).square().mean(0).sqrt() for all_of in (rates, [r.diff(dim=0) for r in rates])
    )
    facts = SimpleNamespace(loc=flat.mean(0), scale=flat.std(0), rate=rate, acceleration=acceleration)
    lines = head("belief", *(f"{after / 30:.0f} s after the last reading" for after in AFTER))
    scored = windows(test, READ + max(AFTER) + 1, study.runs, READ, facts, torch.Generator().manual_seed(5))
    joints = scored["state"][..., :SIZE]
    lines.append(line("mean pose", *cells((joints - facts.loc).abs(), None)))
    lines.append(line("pose of the last reading", *cells((joints - joints[:, READ - 1 : READ]).abs(), None)))
    for name, (rows, read) in WINDOWS.items():
        torch.manual_seed(0)
        with tempfile.TemporaryDirectory() as folder:
            pairs = [(one, one) for one in known]
            motion = train_motion(Motion(facts, ARM), pairs, out=Path(folder), seed=0, updates=study.motion)
        filter = make(motion, facts)
        fit(filter, known, facts, rows, read, study.updates)
        with torch.no_grad():
            belief = filter.sequence(scored.clone())["belief"]
        error = (belief["mean"][..., :SIZE] - joints).abs()
        lines.append(line(f"filter, {name}", *cells(error, belief["var"][..., :SIZE].sqrt())))
        print(lines[-1], flush=True)
    write_page("\n".join([*lines, "", *made_by("g1.away"), ""]), study.out)


if __name__ == "__main__":
    main()
