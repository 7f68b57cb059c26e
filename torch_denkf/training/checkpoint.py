"""Checkpoint files: atomic writes, and checks before use.

torchrl's own ``Checkpoint`` has neither checksums nor a sync with the disk, and may read pickles.
"""

from __future__ import annotations

import io
import re
import sys
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from torch_denkf.deployment.files import write_bytes

__all__ = ["read_checkpoint", "write_checkpoint"]

_FORMAT = "torch_denkf.training/1"


def write_checkpoint(file: Path | str, content: Mapping[str, Any]) -> None:
    """Writes ``content`` atomically to ``file``: after a kill there is either the old file or the new one.

    Equal content gives equal bytes.

    Args:
        file: path; its folder is created.
        content: nested tensors, state dicts and plain values.

    Raises:
        OSError: if it cannot be written, as on a full disk; the message names the file and the free space.

    Example:
        >>> from tempfile import mkdtemp
        >>> file = Path(mkdtemp()) / "last.pt"
        >>> write_checkpoint(file, {"model": {"weight": torch.ones(1)}})
        >>> read_checkpoint(file)["model"]
        {'weight': tensor([1.])}
    """
    memory = io.BytesIO()  # torch.save to a full disk fails with another error, or ends the process
    torch.save(_alone({"format": _FORMAT, **content}), memory)
    write_bytes(file, memory.getbuffer())


def _alone(content: Any) -> Any:
    """Copies the content to new containers, with one object for each text.

    Pickle writes a repeated object as a reference. So equal content gives other bytes if two equal texts are different
    objects, as after reading one of them from a file.
    """
    if isinstance(content, dict):
        return {_alone(key): _alone(value) for key, value in content.items()}
    if type(content) in (list, tuple):
        return type(content)(map(_alone, content))
    return sys.intern(content) if type(content) is str else content


def read_checkpoint(file: Path | str) -> dict[str, Any]:
    """Reads a checkpoint to the CPU, as data only: nothing in the file is executed.

    Returns:
        the content that :func:`write_checkpoint` was given.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is damaged or not one of this library's; the message names the file.
    """
    file = Path(file)
    if not file.is_file():
        raise FileNotFoundError(f"There is no checkpoint {file}.")
    cure = "move it away to start again, or restore it from a copy"
    try:
        with zipfile.ZipFile(file) as archive:  # torch.load ignores the checksums
            if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
                raise ValueError("its parts are compressed, and could be of any size; torch stores them as they are")
            damaged = archive.testzip()
        content = torch.load(file, map_location="cpu", weights_only=True) if damaged is None else None
    except Exception as error:  # zipfile, torch and pickle raise a dozen kinds for truncated files
        raise ValueError(f"{file} cannot be read as a checkpoint ({error}); {cure}.") from error
    if damaged is not None:
        raise ValueError(f"{file} is damaged: the checksum of its part {damaged!r} is wrong; {cure}.")
    if not isinstance(content, dict) or content.pop("format", None) != _FORMAT:
        raise ValueError(f"{file} is not a checkpoint of torch_denkf.training ({_FORMAT}); {cure}.")
    return content


#: Entries of a training's checkpoint.
_STATE = {
    "settings": dict,
    "stage": int,
    "update": int,
    "model": dict,
    "updates": (dict, type(None)),
    "results": dict,
    "best": (dict, type(None)),
    "last_metrics": dict,
    "first": (float, type(None)),
    "logs": dict,
    "hooks": dict,
}
_BEST = {"stage": str, "update": int, "model": dict, "metrics": dict}


def check_state(file: Path | str, state: Mapping[str, Any]) -> None:
    """Raises unless a checkpoint has the state of a training, without NaN in the parameters.

    Args:
        file: the checkpoint, for the message.
        state: its content.

    Raises:
        ValueError: if an entry is missing, of another kind or out of range; the message names the file and the entry.
    """

    def refuse(what: str) -> None:
        raise ValueError(f"{file} is not the state of a training: {what}; move it away to start again.")

    def check(part: Mapping[str, Any], kinds: Mapping[str, Any], where: str) -> None:
        for name, kind in kinds.items():
            if name not in part or not isinstance(part[name], kind) or isinstance(part[name], bool):
                refuse(f"{where}{name!r} is {'missing' if name not in part else type(part[name]).__name__}")

    check(state, _STATE, "")
    check(state["settings"], {"seed": int, "processes": int, "stages": list}, "in its settings ")
    stages = state["settings"]["stages"]
    if not 0 <= state["stage"] <= len(stages) or state["update"] < 0:
        refuse(f"stage {state['stage']}, update {state['update']} of {len(stages)} stages")
    most = stages[state["stage"]].get("updates", state["update"]) if state["stage"] < len(stages) else 0
    if state["update"] > most or (state["updates"] is None) != (state["stage"] == len(stages)):
        refuse(f"update {state['update']} of {most} in stage {state['stage']}, with its optimiser's state or without")
    if state["best"] is not None:
        check(state["best"], _BEST, "in its best ")
        if not re.fullmatch(r"[\w-]+", state["best"]["stage"]):
            refuse(f"its best is of stage {state['best']['stage']!r}")
    for name, value in state["model"].items():
        # Infinite buffers are allowed, such as a mask of -inf.
        if isinstance(value, torch.Tensor) and value.is_floating_point() and bool(value.isnan().any()):
            refuse(f"{name!r} of its model has NaN")


def check_settings(file: Path | str, saved: Mapping[str, Any], wanted: Mapping[str, Any], stage: int) -> None:
    """Raises unless a checkpoint belongs to the training to resume.

    Stages that had not begun may be changed, added or left out.

    Args:
        file: the checkpoint, for the message.
        saved: the settings in the checkpoint: ``seed``, ``processes`` and ``stages``, a list of dicts.
        wanted: settings of the training.
        stage: number of the stage in which the checkpoint was written.

    Raises:
        ValueError: if settings differ; the message names the file and the settings.

    Example:
        >>> fit, tune = {"seed": 0, "processes": 1, "stages": [{"lr": 1.0}]}, {"lr": 0.1}
        >>> check_settings("last.pt", fit, {**fit, "stages": [{"lr": 1.0}, tune]}, stage=1)
        >>> check_settings("last.pt", fit, {**fit, "stages": [tune]}, stage=0)
        Traceback (most recent call last):
        ValueError: last.pt is of another training: stages[0].lr (1.0, now 0.1) differ. Give another out, or ...
    """
    pairs = [(name, saved[name], wanted[name]) for name in ("seed", "processes")]
    for number, old in enumerate(saved["stages"][: stage + 1]):
        new = wanted["stages"][number] if number < len(wanted["stages"]) else {}
        pairs += [(f"stages[{number}].{key}", old.get(key), new.get(key)) for key in {**old, **new}]
    different = [f"{name} ({_short(old, new)}, now {_short(new, old)})" for name, old, new in pairs if old != new]
    if different:
        raise ValueError(
            f"{file} is of another training: {', '.join(different)} differ. Give another out, or start again with "
            "fit(resume=False)."
        )


def _short(value: Any, other: Any) -> str:
    """Returns a setting for a message; of lists of parameter names, only the names that the other lacks."""
    if not isinstance(value, list) or not isinstance(other, list):
        return str(value)
    own = [name for group in value for name in group if not any(name in theirs for theirs in other)]
    some = ", ".join(own[:2]) + (", ..." if len(own) > 2 else "")
    return f"{sum(map(len, value))} names, of which only here: {some or 'none'}"
