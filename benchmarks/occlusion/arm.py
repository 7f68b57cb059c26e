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
from benchmarks.g1.together import LEVEL, RATE, SIZE, Arm, Together, run, unforeseen
from torch_denkf import EKF
from torch_denkf.envs import OccludingBox
from torch_denkf.functional import crps_gaussian
from torch_denkf.modules import ConstantNoise, DiagonalNoise, LearnedTransition, MappedNoise, Select, Visibility
from torch_denkf.objectives import SensorLoss
from torch_denkf.training import hold_last
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

ROWS = 3 * RATE  # that the box stands there
COPIES = 4  # of each training episode, with boxes at other times


@dataclass(frozen=True)
class Behind(Together):
    """A real arm behind a box."""

    width: float = 0.36  # of the box, in widths of the picture; its height is as much
    updates: int = 600  # of what filters learn from single frames


class Box:
    """Episodes with a box before the hand.

    Args:
        arm: the arm, its camera and its motion.
        study: the study.
    """

    def __init__(self, arm: Arm, study: Behind):
        self.arm, self.study = arm, study
        height, width = study.size
        self.side = (study.width * width / height, study.width)

    def readings(self, role: str, copies: int = 1) -> TensorDict:
        """What the camera reads ``[N * copies, T]``; ``"visible"`` is 0 behind the box, NaN where it may see a part."""
        arm, study = self.arm, self.study
        file = study.out / "codes" / f"{arm.sensor.name}-{role}-behind-{study.width}.pt"
        codes = torch.cat([arm.codes(role)] * copies)
        if not file.exists():
            write_checkpoint(file, self._hide(codes.clone(), role, copies))
        hidden = read_checkpoint(file)
        codes["code"] = torch.where(hidden["boxed"].unsqueeze(-1), hidden["code"], codes["code"])
        out = arm.read(codes)
        out["boxed"], out["visible"] = hidden["boxed"].unsqueeze(-1), hidden["visible"].unsqueeze(-1)
        out["observed"] = out.pop("camera_observed")
        return out

    @property
    def features(self) -> int:
        """Of the camera's encoding."""
        return encoding_size(self.arm.sensor.trained[0])

    @cached_property
    def away(self) -> tuple[Damped, MappedNoise]:
        """A motion that does not know where the arm mostly is, and what it does not foresee."""
        pairs = self.arm.pairs
        motion = Damped(pairs)
        return motion, unforeseen(motion, pairs)

    def filter(self, *knows: str) -> EKF:
        """A filter of the camera that knows some of ``"errors last"``, ``"noise"``, ``"visibility"`` and ``"home"``."""
        arm, initial = self.arm, self.arm.start()
        bias, white = arm.camera
        if "errors last" not in knows:
            white = (white.square() + bias.std.square().unflatten(0, (-1, SIZE)).sum(0)).sqrt()
        features = {"in_features": self.features, "num_cells": (16,), "in_key": "encoding"}
        noise = DiagonalNoise(SIZE, r=white, **features) if "noise" in knows else ConstantNoise(white, in_key="camera")
        motion, q = (arm.motion, arm.noise) if "home" in knows else self.away
        return EKF(
            LearnedTransition(motion, residual=False),
            None,
            Select(list(range(SIZE))),
            noise,
            process_noise=q,
            initial=initial,
            observation_key="camera",
            sensor_error=bias if "errors last" in knows else None,
            visibility=Visibility(self.features, encoding_key="encoding") if "visibility" in knows else None,
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
    """Trains what a filter says of single frames; of what it was on the way, the best on other episodes is kept."""
    terms = {"noise": float("noise" in filter.module), "visible": float("visibility" in filter.module)}
    learned = [filter[name] for name in ("noise", "visibility") if name in filter.module]
    loss = SensorLoss(filter, sensor=0.0, **terms)
    loss.set_keys(sensor="camera")
    parameters = [p for module in learned for p in module.parameters()]
    if not parameters:
        return
    optimiser = torch.optim.AdamW(parameters, 2e-3, weight_decay=0.1)
    best, kept = math.inf, None
    for update in range(updates):
        if update % 20 == 0:
            with torch.no_grad():
                now = sum(float(value) for value in loss(chosen).values())
            if now < best:
                best, kept = now, deepcopy(filter.state_dict())
        optimiser.zero_grad()
        sum(loss(train[torch.randint(len(train), (512,))]).values()).backward()
        optimiser.step()
    filter.load_state_dict(kept)


def cells(mean: Tensor, std: Tensor | None, data: TensorDict) -> list[str]:
    """Errors, intervals and CRPS while the hand is seen, while a box is before it, and in the second after."""
    boxed, valid = data["boxed"].squeeze(-1), data["valid"].squeeze(-1).clone()
    valid[:, 0] = False
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


KNOWS = {
    "nothing": (),
    "home": ("home",),
    "home, noise": ("home", "noise"),
    "home, errors last": ("home", "errors last"),
    "home, visibility": ("home", "visibility"),
    "errors last, visibility": ("errors last", "visibility"),
    "home, errors last, visibility": ("home", "errors last", "visibility"),
}


def main() -> None:
    """Trains what is learned, and writes the table."""
    study = parse(Behind)
    torch.set_num_threads(1)
    box = Box(Arm(study), study)
    train, chosen, test = box.readings("tune", COPIES), box.readings("validation", COPIES), box.readings("test")
    seen = train["encoding"][train["observed"].squeeze(-1)]
    loc, scale = seen.mean(0), seen.std(0).clamp_min(1e-3)
    for data in (train, chosen, test):
        data["encoding"] = standardised(data["encoding"], loc, scale)
    frames = [data[data["observed"].squeeze(-1)] for data in (train, chosen)]
    lines = head(
        "knows", *(f"{when}: {what}" for when in ("seen", "box", "after") for what in ("error", "held", "CRPS"))
    )

    def add(name: str, mean: Tensor, std: Tensor | None) -> None:
        lines.append(line(name, *cells(mean, std, test)))
        print(lines[-1], flush=True)

    start = box.arm.start().mean[:SIZE]
    add("reading, held", hold_last(test["camera"], test["observed"], start.expand_as(test["camera"][:, 0])), None)
    for name, knows in KNOWS.items():
        torch.manual_seed(study.seed)
        filter = box.filter(*knows)
        fit(filter, *frames, study.updates)
        add(name, *run(filter, test))
    told = test.copy()
    told["observed"] = test["observed"] & ~test["boxed"]
    add("home, errors last, told of the box", *run(box.filter("home", "errors last"), told))
    write_page("\n".join([*lines, "", *made_by("occlusion.arm"), ""]), study.page)


if __name__ == "__main__":
    main()
