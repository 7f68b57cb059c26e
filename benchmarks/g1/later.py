"""Predicts future joints from encoders and from the commands that are not yet executed.

``python -m benchmarks.g1.later --root G1``. It reads no images. The state is the joints of a row and of the row
before; the motion, which also reads the row's commands, is fitted by least squares, its noise to the residuals. A
factor on that noise is chosen on validation episodes, for a 90 % coverage at the predicted time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.arm import JOINTS
from benchmarks.common.tables import head, line, write_page
from benchmarks.g1.recordings import ARM
from torch_denkf import DEnKF
from torch_denkf.data.episodes import hashed_share
from torch_denkf.data.lerobot.replay import is_for_tests
from torch_denkf.data.parquet import read_parquet
from torch_denkf.filters import Filter
from torch_denkf.fusion import BeliefAhead, FusedFilter, FusedSensor
from torch_denkf.modules import ConstantNoise, GaussianPrior, LearnedTransition, LinearTransition, MomentPrior, Select

RATE, LEVEL = 30, 1.6449  # rows per second; of a normal distribution, the 90 % interval
ENCODER = 0.1 * torch.pi / 180  # noise of the encoders, a standard deviation in rad
FIRST = 15  # first scored row, after which the initial belief has no influence
FACTORS = (1.0, 1.2, 1.4, 1.7, 2.0)  # on the standard deviations of the motion's noise
MEMBERS = 64


@dataclass(frozen=True)
class Later:
    """Options of the study of predictions."""

    root: Path = Path("../shared/data/g1")  # LeRobot folder
    page: Path | None = None  # file for the table
    rows: tuple[int, ...] = (3, 6, 12)  # prediction horizons, in rows of 1/30 s
    chosen: int = 6  # rows ahead at which the factor is chosen


def episodes(root: Path) -> dict[str, TensorDict]:
    """Returns joints and commands by role, ``[B, T]``, in rad; ``valid`` masks the padding after an episode."""
    found: dict[str, list[Tensor]] = {"train": [], "validation": [], "test": []}
    for file in sorted((root / "data").glob("*/*.parquet")):
        number, table = int(file.stem.rpartition("_")[-1]), read_parquet(file, ["observation.state", "action"])
        both = [torch.tensor(table[key].to_pylist())[:, list(ARM)] for key in ("observation.state", "action")]
        role = "validation" if hashed_share(str(number), "g1 later") < 0.1 else "train"
        found["test" if is_for_tests(number) else role].append(torch.stack(both, 1))
    out = {}
    for role, parts in found.items():
        both = torch.nn.utils.rnn.pad_sequence(parts, batch_first=True)
        long = torch.tensor([len(part) for part in parts])
        valid = torch.arange(both.shape[1]) < long.unsqueeze(-1)
        data = TensorDict({"joints": both[:, :, 0], "action": both[:, :, 1], "valid": valid}, both.shape[:2])
        generator = torch.Generator().manual_seed(0)
        noise = ENCODER * torch.randn(data["joints"].shape, generator=generator)
        out[role] = data.set("encoders", data["joints"] + noise)
    return out


@dataclass
class Motion:
    """A linear motion of the joints around their mean.

    Attributes:
        weight: ``[7, 21]``, for the joints, those of the row before, and the commands.
        noise: covariance of the residuals, ``[7, 7]``.
        center: mean of the joints, ``[7]``.
    """

    weight: Tensor
    noise: Tensor
    center: Tensor

    @classmethod
    def fitted(cls, data: TensorDict) -> Motion:
        """Fits the motion by least squares."""
        whole = data["valid"][:, 2:]
        center = data["joints"][data["valid"]].mean(0)
        joints, commands = data["joints"] - center, data["action"] - center
        read = torch.cat([joints[:, 1:-1], joints[:, :-2], commands[:, 1:-1]], -1)[whole]
        after = joints[:, 2:][whole]
        weight = torch.linalg.lstsq(read, after).solution
        left = after - read @ weight
        return cls(weight.mT, left.mT @ left / len(left), center)

    def filter(self, kind: str, factor: float) -> Filter:
        """Returns a filter of the joints of this row and the last; ``kind`` is ``"EKF"`` or ``"DEnKF"``."""
        passed = torch.eye(JOINTS, 2 * JOINTS)
        matrix = torch.cat([self.weight[:, : 2 * JOINTS], passed])
        control = torch.cat([self.weight[:, 2 * JOINTS :], torch.zeros(JOINTS, JOINTS)])
        reads = Select(list(range(JOINTS)))
        if kind == "EKF":
            noise = torch.zeros(2 * JOINTS, 2 * JOINTS)
            noise[:JOINTS, :JOINTS] = factor**2 * self.noise
            start = MomentPrior(torch.zeros(2 * JOINTS), torch.eye(2 * JOINTS))
            sensors = {"encoders": FusedSensor(reads, [ENCODER] * JOINTS)}
            return FusedFilter(LinearTransition(matrix, noise, control=control), sensors, initial=start)
        std = factor * self.noise.diagonal().sqrt()
        both = torch.cat([matrix, control], -1).mT
        return DEnKF(
            LearnedTransition(lambda state: state @ both, residual=False, action_key="action"),
            None,
            reads,
            ConstantNoise([ENCODER] * JOINTS, in_key="encoders"),
            initial=GaussianPrior([0.0] * 2 * JOINTS, [1.0] * 2 * JOINTS, ensemble_size=MEMBERS),
            process_noise=[*std.tolist(), *[0.0] * JOINTS],
            observation_key="encoders",
        )

    def centered(self, data: TensorDict, ahead: int) -> TensorDict:
        """Returns a filter's inputs, with the commands ``ahead`` rows on; those of the last rows wrap around."""
        drive = TensorDict({key: data[key] - self.center for key in ("encoders", "action")}, data.batch_size)
        waiting = [drive["action"].roll(-k, 1) for k in range(ahead)]
        return drive.set(("under_way", "action"), torch.stack(waiting, 2))


def looked(motion: Motion, data: TensorDict, kind: str, factor: float, steps: int) -> TensorDict:
    """Returns the belief now, and those of the next rows ``[B, T, steps, 14]``."""
    filter = motion.filter(kind, factor)
    ahead = BeliefAhead(filter, steps, each=True, keep=[("belief", "mean"), ("belief", "var")])
    with torch.no_grad():
        return ahead(filter.sequence(motion.centered(data, steps), keep=filter.belief_keys))


def scores(motion: Motion, data: TensorDict, out: TensorDict, ahead: int) -> tuple[float, ...]:
    """Returns errors of the last belief and of the predicted belief, in degrees, and the 90 % coverage."""
    last = data["valid"].shape[1] - ahead
    rows = data["valid"][:, ahead:] & (torch.arange(last) >= FIRST)
    truth = (data["joints"] - motion.center)[:, ahead:][rows]
    now = out["belief", "mean"][:, :last, :JOINTS][rows] - truth
    later = out["ahead", "belief", "mean"][:, :last, ahead - 1, :JOINTS][rows] - truth
    std = out["ahead", "belief", "var"][:, :last, ahead - 1, :JOINTS][rows].sqrt()
    rms = [error.square().mean().sqrt().rad2deg().item() for error in (now, later)]
    return *rms, (later.abs() < LEVEL * std).double().mean().item()


def main() -> None:
    """Writes the table."""
    study = parse(Later)
    torch.manual_seed(0)
    torch.set_default_dtype(torch.float64)  # for encoders of 0.1 degrees with a wide initial belief
    data = episodes(study.root)
    motion = Motion.fitted(data["train"])
    counts = ", ".join(f"{len(part)} {role}" for role, part in data.items())
    lines = [f"Episodes: {counts}. Errors in degrees, over the seven joints; encoders with 0.1 degrees of noise.", ""]
    lines += head("ahead, s", "filter", "last belief", "ahead", "ratio", "within 90 %", "factor")
    for kind in ("EKF", "DEnKF"):
        held = {}
        for factor in FACTORS:
            out = looked(motion, data["validation"], kind, factor, study.chosen)
            held[factor] = abs(scores(motion, data["validation"], out, study.chosen)[2] - 0.9)
        factor = min(held, key=held.__getitem__)
        out = looked(motion, data["test"], kind, factor, max(study.rows))
        for ahead in study.rows:
            now, later, inside = scores(motion, data["test"], out, ahead)
            cells = f"{now:.2f}", f"{later:.2f}", f"{later / now:.2f}", f"{100 * inside:.0f} %", factor
            lines.append(line(f"{ahead / RATE:.1f}", kind, *cells))
            print(lines[-1], flush=True)
    write_page("\n".join([*lines, "", *made_by("g1.later"), ""]), study.page)


if __name__ == "__main__":
    main()
