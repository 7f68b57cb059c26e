"""Compares PPO with a filter in the policy whose noise is kept with the data, or drawn again in each update.

``python -m benchmarks.control.kept --seeds 2``. It runs the program of docs/how_to/policies.md. The filter has few
members and random draws, which matter: with exact ones and a linear motion its mean hardly depends on them.
"""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path

from torch import nn
from torch.nn.modules.module import register_module_forward_hook
from torchrl.objectives import ClipPPOLoss

from benchmarks.common.arguments import ROOT, made_by, parse
from benchmarks.common.tables import head, line, write_page
from torch_denkf import DEnKF
from torch_denkf.modules import (
    ConstantNoise,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedTransition,
    NoisyTransition,
    Select,
)

PAGE = ROOT / "docs" / "how_to" / "policies.md"


@dataclass(frozen=True)
class Kept:
    """Options of the study of kept noise."""

    seeds: int = 2
    rounds: int = 25
    members: int = 8
    page: Path | None = None  # file for the table


def make_filter(motion: nn.Module, members: int, keep: bool) -> DEnKF:
    """Returns the page's filter with random draws; the spring is known, the motor is learned."""
    q = ConstantNoise([0.0, 0.1], in_key=("belief", "mean"), out_key=("forecast", "noise"))
    return DEnKF(
        NoisyTransition(LearnedTransition(motion, residual=False, action_key="action"), q, draws="random"),
        None,
        Select([0]),
        ConstantNoise([0.3], in_key="observation"),
        EnsembleAnalysis("perturbed", observation_key="observation", draws="random"),
        initial=GaussianPrior([0.0, 0.0], [1.0, 0.5], ensemble_size=members, draws="random"),
        keep_noise=keep,
    )


def run(study: Kept, keep: bool, seed: int) -> list[str]:
    """Returns cells: share of the ratios that are clipped, return, seconds."""
    begun, clipped, names = time.process_time(), [], {}
    set_up, ppo = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(), re.MULTILINE | re.DOTALL)[:2]
    exec(re.sub(r"^ROUNDS, SEED = .*$", f"ROUNDS, SEED = {study.rounds}, {seed}", set_up, flags=re.MULTILINE), names)
    names["denkf"] = make_filter(names["motion"], study.members, keep)

    def note(module: nn.Module, args: tuple, terms) -> None:
        if isinstance(module, ClipPPOLoss):
            clipped.append(terms["clip_fraction"].item())

    noting = register_module_forward_hook(note)
    exec(ppo, names)
    noting.remove()
    seconds, returned = time.process_time() - begun, names["test"]()
    return [f"{100 * sum(clipped) / len(clipped):.1f} %", f"{returned:.1f}", f"{seconds:.0f}"]


def main() -> None:
    """Writes the table."""
    study = parse(Kept)
    lines = head("noise", "seed", "clipped", "return", "s of one core")
    for seed in range(study.seeds):
        for keep in (True, False):
            lines.append(line("kept" if keep else "drawn again", seed, *run(study, keep, seed)))
            print(lines[-1], flush=True)
    write_page("\n".join([*lines, "", *made_by("control.kept"), ""]), study.page)


if __name__ == "__main__":
    main()
