"""Training of one part of a filter, such as its sensor."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from torch import nn

from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint
from torch_denkf.training.stage import Stage
from torch_denkf.training.trainer import FilterTrainer

__all__ = ["train_part"]

M = TypeVar("M", bound=nn.Module)


def train_part(part: M, stage: Stage, *, out: Path | str, **settings: Any) -> M:
    """Trains one part of a filter separately, or loads it if it is trained already.

    A study trains its sensor like this before it trains filters on the sensor's readings.

    Args:
        part: e.g. a sensor or a motion model; trained in place.
        stage: the stage; the trained part is written to ``out/<name>.pt``.
        out: folder, from which an interrupted training resumes.
        **settings: settings of :class:`FilterTrainer`.

    Returns:
        the part.

    Example:
        >>> from tempfile import mkdtemp
        >>> import torch
        >>> from tensordict import TensorDict
        >>> net, out = nn.Linear(1, 1), mkdtemp()  # learns 2 x
        >>> loss = lambda batch: {"loss": (net(batch["x"]) - 2 * batch["x"]).square().mean()}
        >>> sample = lambda generator, length: TensorDict({"x": torch.rand(8, 1, generator=generator)}, [8])
        >>> trained = train_part(net, Stage("line", loss, sample, updates=200, lr=0.1), out=out, device="cpu")
        >>> again = train_part(nn.Linear(1, 1), Stage("line", loss, sample, updates=200), out=out)  # reads it
        >>> torch.equal(trained.weight, again.weight)
        True
    """
    file = Path(out) / f"{stage.name}.pt"
    if file.exists():
        part.load_state_dict(read_checkpoint(file)[stage.name])
        return part
    trainer = FilterTrainer(nn.ModuleDict({stage.name: part}), [stage], out=out, **settings)
    trainer.fit()
    if trainer.processes.is_main:
        write_checkpoint(file, {stage.name: part.state_dict()})
    return part
