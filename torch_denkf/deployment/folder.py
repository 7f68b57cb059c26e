"""A trained filter as a folder: weights as data, and a text file with its builder and settings."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

import torch_denkf
from torch_denkf.compilation.lock import locked
from torch_denkf.deployment.files import sync, write_bytes, write_text
from torch_denkf.deployment.rebuilt import build_from, check_rebuilt

__all__ = ["described", "load_folder", "read_folder_config", "save_folder"]

FORMAT = "torch_denkf.filter/1"
WEIGHTS, CONFIG = "weights.safetensors", "config.json"
_UNSETTLED = re.compile(r"weights-[0-9a-f]{64}\.safetensors")


def save_folder(
    model: nn.Module,
    folder: str | Path,
    *,
    builder: str,
    settings: Mapping[str, Any],
    training: Mapping[str, Any] | None = None,
    build: Callable[..., nn.Module] | None = None,
) -> Path:
    """Writes a model to a folder.

    ``weights.safetensors`` gets parameters and buffers; ``config.json`` gets the builder's name, its settings, the
    SHA-256 of the weights, the versions of the libraries, the record of the training, and a SHA-256 of all these.

    Args:
        model: the model.
        folder: created if it does not exist; an existing model is replaced atomically, also if the process is killed.
        builder: name of the function that builds such a model from the settings.
        settings: plain values.
        training: command, seed, drives: plain values, for the record only.
        build: builder function, to check that it builds such a model; ``None`` for no check.

    Returns:
        The folder.

    Raises:
        OSError: if the folder cannot be written to, the disk is full, or another process saves to it; an existing model
            is then unchanged.
        TypeError: if settings or training are no JSON values.
        ValueError: if ``build`` makes another model; the message names the difference.

    Example:
        >>> import tempfile
        >>> folder = save_folder(nn.Linear(2, 1), tempfile.mkdtemp(), builder="line", settings={"size": 2})
        >>> load_folder(folder, {"line": lambda size: nn.Linear(size, 1)})
        Linear(in_features=2, out_features=1, bias=True)
    """
    for name, value in (("settings", settings), ("training", training)):
        if value is not None and not isinstance(value, Mapping):
            raise TypeError(f"{name} must be a dictionary of plain values; got {value!r}"[:200])
    folder = Path(folder).expanduser()
    versions = {"torch_denkf": torch_denkf.__version__, "torch": str(torch.__version__)}
    config = {"format": FORMAT, "builder": builder, "settings": dict(settings), "sha256": ""}
    config |= {"versions": versions, "training": dict(training or {})}
    try:
        json.dumps(config, allow_nan=False)  # before anything is written
    except (TypeError, ValueError) as error:
        raise TypeError(f"settings and training are plain values, as JSON knows them: {error}") from error
    if build is not None:
        check_rebuilt(model, builder, build, json.loads(json.dumps(config["settings"])))
    # Copies: safetensors raises for tensors that share memory.
    weights = save({name: value.detach().cpu().clone().contiguous() for name, value in model.state_dict().items()})
    config["sha256"] = hashlib.sha256(weights).hexdigest()
    with locked(folder, ".saving", "is saving to it"):
        _settle(folder)
        try:  # the new weights are next to the old ones until the rename of the description replaces the model
            write_bytes(_unsettled(folder, config["sha256"]), weights)
            write_text(folder / CONFIG, described(config))
        finally:
            _settle(folder)
    return folder


def described(config: Mapping[str, Any]) -> str:
    """Returns the text of ``config.json``, with a checksum of its content."""
    return json.dumps({**config, "checksum": _checksum(config)}, indent=1) + "\n"


def _checksum(config: Mapping[str, Any]) -> str:
    said = {name: value for name, value in config.items() if name != "checksum"}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def _unsettled(folder: Path, sha256: object) -> Path:
    """Returns the temporary path of new weights, before their description has replaced the old one."""
    return folder / f"weights-{sha256}.safetensors"


def _settle(folder: Path) -> None:
    """Renames weights that have a description to their final name, and removes others."""
    described = None
    with contextlib.suppress(OSError, ValueError, AttributeError):
        described = _unsettled(folder, json.loads((folder / CONFIG).read_text()).get("sha256"))
    for file in [file for file in folder.iterdir() if _UNSETTLED.fullmatch(file.name)]:
        if file == described:
            os.replace(file, folder / WEIGHTS)
        else:
            file.unlink()
    sync(folder)


def read_folder_config(folder: str | Path, builders: Mapping[str, object]) -> dict[str, Any]:
    """Reads the description that :func:`save_folder` wrote next to the weights.

    Args:
        folder: folder with ``config.json``.
        builders: allowed builders, by name.

    Raises:
        FileNotFoundError: if there is no filter in the folder.
        ValueError: if the file is damaged or changed, of another format, or names another builder.
    """
    file = Path(folder).expanduser() / CONFIG
    if not file.is_file():
        raise FileNotFoundError(f"no filter in {file.parent}: it has no {CONFIG}; `denkf train` leaves one")
    try:
        config = json.loads(file.read_text())
    except ValueError as error:
        raise ValueError(f"{file} is not JSON ({error}); restore it from a copy, or train again") from error
    if not isinstance(config, dict) or config.get("format") != FORMAT or not isinstance(config.get("settings"), dict):
        raise ValueError(f"{file} does not describe a filter (format {FORMAT!r}); pass a folder of `denkf train`")
    if not isinstance(config.get("builder"), str) or config["builder"] not in builders:
        raise ValueError(
            f"{file} is of a filter that {config.get('builder')!r} builds; expected {', '.join(map(repr, builders))}. "
            "Pass a function of your own by builders={NAME: function}"
        )
    if config.get("checksum") != _checksum(config):
        raise ValueError(
            f"{file} is damaged, or was changed by hand: it does not have its checksum; restore it from a copy, or "
            "build the filter you want and save it"
        )
    return config


def load_folder(folder: str | Path, builders: Mapping[str, Callable[..., nn.Module]]) -> nn.Module:
    """Reads a model that :func:`save_folder` wrote. Nothing in the files is executed: they name one of ``builders``.

    Args:
        folder: folder with ``config.json`` and ``weights.safetensors``.
        builders: functions of the settings that return an untrained model, by name.

    Returns:
        The model, on the CPU, in evaluation mode.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is damaged, changed, of another format, or does not fit the other; the message names it.
    """
    folder = Path(folder).expanduser()
    config = read_folder_config(folder, builders)
    try:
        model = build_from(builders[config["builder"]], config["settings"])
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{folder / CONFIG} does not make a filter: {error}") from error
    file = _unsettled(folder, config.get("sha256"))
    if not _UNSETTLED.fullmatch(file.name) or not file.is_file():
        file = folder / WEIGHTS
    if not file.is_file():
        raise FileNotFoundError(f"no weights {file}; restore the file from a copy, or train again")
    if _sha256(file) != config.get("sha256"):
        raise ValueError(
            f"{file} is damaged, or not the file that {CONFIG} describes: its SHA-256 is {_sha256(file)}, expected "
            f"{config.get('sha256')}; restore both from a copy, install torch_denkf again, or train again"
        )
    try:
        weights = load_file(file)
    except (SafetensorError, ValueError) as error:
        raise ValueError(f"{file} cannot be read ({error}); restore it from a copy, or train again") from error
    made = model.state_dict()
    strange = [name for name, value in weights.items() if name in made and not _fits(value, made[name])]
    if strange:
        raise ValueError(
            f"{file} holds NaN, infinity or whole numbers in {strange[:3]}, where {CONFIG} makes none; restore it from "
            "a copy, or train again"
        )
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{file} does not fit {CONFIG} next to it: {reason}") from error
    return model.eval()


def _fits(value: Tensor, made: Tensor) -> bool:
    """Returns True if values have the kind of the built ones, and are infinite only where these are."""
    if value.is_floating_point() != made.is_floating_point():
        return False
    if value.shape != made.shape:  # load_state_dict raises
        return True
    return not bool((~value.isfinite() & ~(made.isinf() & (value == made))).any())


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()
