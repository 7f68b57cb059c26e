"""A real arm behind a box: ``python -m benchmarks.occlusion.arm --root G1``.

Recordings, sensor, motion and lasting errors are those of ``benchmarks.g1.together``. A box stands before the hand for
three seconds. The filters learn what the picture says of a reading from single frames, of which some have a box.
"""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import head, line, write_page
from benchmarks.g1.readings import standardised
from benchmarks.g1.recordings import ARM as JOINTS
from benchmarks.g1.sensors import code_of, encoding_size
from benchmarks.g1.together import LEVEL, RATE, SIZE, Arm, Together, run, scored, unforeseen
from torch_denkf import EKF
from torch_denkf.envs import OccludingBox
from torch_denkf.functional import crps_gaussian
from torch_denkf.imperfect import Visibility
from torch_denkf.modules import ConstantNoise, LearnedTransition, MappedNoise, Select
from torch_denkf.objectives import SensorLoss
from torch_denkf.training import hold_last
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

ROWS = 3 * RATE  # that the box stands there
COPIES = 4  # of each training episode, with boxes at other times


@dataclass(frozen=True)
class Behind(Together):
    """A real arm behind a box."""

    widths: tuple[float, ...] = (0.36, 0.7)  # of a box, in widths of the picture; its height is as much
    updates: int = 600  # of what filters learn from single frames


class Box:
    """Episodes with a box before the hand.

    Args:
        arm: the arm, its camera and its motion.
        study: the study.
        width: of the box.
    """

    def __init__(self, arm: Arm, study: Behind, width: float):
        self.arm, self.study, self.width = arm, study, width
        self.side = (min(width * study.size[1] / study.size[0], 1.0), width)

    def readings(self, role: str, copies: int = 1) -> TensorDict:
        """What the camera reads ``[N * copies, T]``; ``"visible"`` is 0 behind the box, NaN where it may see a part."""
        arm, study = self.arm, self.study
        file = study.out / "codes" / f"{arm.sensor.name}-{role}-behind-{self.width}.pt"
        codes = torch.cat([arm.codes(role)] * copies)
        if not file.exists():
            write_checkpoint(file, self._hide(codes.clone(), role, copies))
        hidden = read_checkpoint(file)
        codes["code"] = torch.where(hidden["boxed"].unsqueeze(-1), hidden["code"], codes["code"])
        out = arm.read(codes)
        out["boxed"], out["visible"] = hidden["boxed"].unsqueeze(-1), hidden["visible"].unsqueeze(-1)
        return out

    @cached_property
    def away(self) -> tuple[Damped, MappedNoise]:
        """A motion that does not know where the arm mostly is, and what it does not foresee."""
        pairs = self.arm.pairs
        motion = Damped(pairs)
        return motion, unforeseen(motion, pairs)

    def filter(self, *knows: str) -> EKF:
        """A filter of the camera that knows some of ``"errors last"``, ``"visibility"`` and ``"home"``."""
        arm, initial = self.arm, self.arm.start()
        bias, white = arm.errors("camera", "episodes" if "errors last" in knows else "white")
        motion, q = (arm.motion, arm.noise) if "home" in knows else self.away
        return EKF(
            LearnedTransition(motion, residual=False),
            None,
            Select(list(range(SIZE))),
            ConstantNoise(white, in_key="camera"),
            process_noise=q,
            initial=initial,
            observation_key="camera",
            sensor_error=bias,
            visibility=Visibility(encoding_size(arm.sensor.trained[0]), encoding_key="encoding")
            if "visibility" in knows
            else None,
        )

    @torch.no_grad()
    def _hide(self, codes: TensorDict, role: str, copies: int) -> dict[str, Tensor]:
        """Features of the frames with a box, and which these are."""
        arm, data = self.arm, self.study.data
        numbers = list(getattr(arm.roles, role)) * copies
        episodes = {episode.number: episode for episode in data.episodes}
        share = torch.rand(len(numbers), generator=torch.Generator().manual_seed(int(role == "test")))
        boxed = torch.zeros(codes.shape, dtype=torch.bool)
        visible, code = torch.ones(codes.shape), codes["code"].clone()
        for k, number in enumerate(numbers):
            episode = episodes[number]
            begin = int(RATE + share[k] * (episode.length - ROWS - 2 * RATE))
            rows = torch.arange(begin, begin + ROWS)
            part = data[episode.start + rows]
            place = (arm.sensor.hand(part["state"][:, list(JOINTS)]).flip(-1) + 1) / 2  # shares of height and width
            side = torch.tensor(self.side)
            corner = (place[ROWS // 2] - side / 2).clamp_min(0).minimum(1 - side)
            part = OccludingBox(self.side, corner.tolist())(part)
            code[k, rows] = torch.cat([code_of(arm.sensor.trained[0], one) for one in part["pixels"].split(32)])
            boxed[k, rows] = True
            deep = ((place - corner - side / 2).abs() < 0.3 * side).all(-1)
            visible[k, rows] = torch.where(deep, 0.0, torch.nan)
        return {"code": code, "boxed": boxed, "visible": visible}


class Damped(nn.Module):
    """Rates that fade; nothing pulls the arm anywhere.

    Args:
        pairs: true joints and rates of episodes, ``[T, 14]`` each.
    """

    def __init__(self, pairs: list[Tensor]):
        super().__init__()
        before, after = (torch.cat([one[part, SIZE:] for one in pairs]) for part in (slice(-1), slice(1, None)))
        self.register_buffer("keep", (before * after).sum(0) / before.square().sum(0))

    def forward(self, state: Tensor) -> Tensor:
        """States ``[*, 14]`` one row later."""
        rates = self.keep * state[..., SIZE:]
        return torch.cat([state[..., :SIZE] + rates, rates], -1)


def fit(filter: EKF, train: TensorDict, chosen: TensorDict, updates: int) -> None:
    """Trains the head on single frames; of what it was on the way, the best on other episodes is kept."""
    loss, learned = SensorLoss(filter, sensor=0.0, visible=1.0), filter["visibility"]
    optimiser = torch.optim.AdamW(learned.parameters(), 2e-3, weight_decay=0.1)
    best, kept = math.inf, None
    for update in range(updates):
        if update % 20 == 0:
            with torch.no_grad():
                now = float(loss(chosen)["loss_visible"])
            if now < best:
                best, kept = now, deepcopy(learned.state_dict())
        optimiser.zero_grad()
        loss(train[torch.randint(len(train), (512,))])["loss_visible"].backward()
        optimiser.step()
    learned.load_state_dict(kept)


def cells(mean: Tensor, std: Tensor | None, data: TensorDict) -> list[str]:
    """Errors, intervals and CRPS while the hand is seen, while a box is before it, and in the second after."""
    boxed, valid = data["boxed"].squeeze(-1), scored(data)
    after = torch.zeros_like(boxed)
    for back in range(1, RATE + 1):
        after[:, back:] |= boxed[:, :-back]
    out = []
    for at in (valid & ~boxed & ~after, boxed, after & ~boxed & valid):
        error = (mean - data["state"])[at]
        out.append(f"{error.abs().mean().rad2deg():.2f}")
        if std is None:
            out += ["", ""]
            continue
        out.append(f"{100 * (error.abs() < LEVEL * std[at]).float().mean():.0f} %")
        out.append(f"{crps_gaussian(torch.zeros_like(error), std[at].square(), error).mean().rad2deg():.2f}")
    return out


#: What a filter knows of the arm and of its camera.
KNOWS = (
    (),
    ("home",),
    ("errors last",),
    ("home", "errors last"),
    ("home", "errors last", "visibility"),
)


def table(box: Box) -> list[str]:
    """Trains what is learned, and tests."""
    study, arm = box.study, box.arm
    train, chosen, test = box.readings("tune", COPIES), box.readings("validation", COPIES), box.readings("test")
    seen = train["encoding"][train["camera_observed"].squeeze(-1)]
    loc, scale = seen.mean(0), seen.std(0).clamp_min(1e-3)
    for data in (train, chosen, test):
        data["encoding"] = standardised(data["encoding"], loc, scale)
        data["observed"] = data["camera_observed"]
    frames = [data[data["observed"].squeeze(-1)] for data in (train, chosen)]
    columns = (f"{when}: {what}" for when in ("seen", "box", "after") for what in ("error", "held", "CRPS"))
    lines = head("the filter knows", *columns)

    def add(name: str, mean: Tensor, std: Tensor | None) -> None:
        lines.append(line(name, *cells(mean, std, test)))
        print(lines[-1], flush=True)

    start = arm.start().mean[:SIZE]
    add("(last reading)", hold_last(test["camera"], test["observed"], start.expand_as(test["camera"][:, 0])), None)
    for knows in KNOWS:
        torch.manual_seed(study.seed)
        filter = box.filter(*knows)
        if "visibility" in knows:
            fit(filter, *frames, study.updates)
        add(", ".join(knows) or "nothing", *run(filter, test))
    with torch.no_grad():
        for data in (train, chosen, test):
            sees = filter["visibility"](data.select("encoding"))["sensor", "visible"] > 0.5
            data["behind"] = data["camera"]
            data["behind_observed"] = data["observed"] & ~sees
            data["camera_observed"] = data["observed"] & sees
    lasts = "home, errors last"
    add(f"{lasts}, no reading where the head sees a box", *run(arm.filter("camera"), test))
    boxed = test["boxed"] & test["observed"]
    found = [100 * test["behind_observed"][at].float().mean() for at in (boxed, test["observed"] & ~boxed)]
    told = test.copy().set("camera_observed", test["observed"] & ~boxed)
    add(f"{lasts}, told: no reading where the box is", *run(arm.filter("camera"), told))
    arm.unseen = [train, chosen]
    add(f"{lasts}, other ones where the head sees a box", *run(arm.filter("camera", "behind"), test))
    says = (
        f"The head sees a box in {found[0]:.0f} % of the frames that have one, and in {found[1]:.0f} % of the others."
    )
    return [*lines, "", says]


def main() -> None:
    """Writes the tables."""
    study = parse(Behind)
    torch.set_num_threads(1)
    lines = []
    for width in study.widths:
        lines += [f"**A box of {width:.0%} of the picture's width**", "", *table(Box(Arm(study), study, width)), ""]
    write_page("\n".join([*lines, *made_by("occlusion.arm"), ""]), study.page)


if __name__ == "__main__":
    main()
