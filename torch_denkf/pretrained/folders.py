"""Trained filters by name, or from a folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

from torch_denkf import _registered
from torch_denkf.deployment.files import write_text
from torch_denkf.deployment.folder import load_folder, read_folder_config, save_folder
from torch_denkf.filters import Filter

__all__ = ["available", "from_pretrained", "save_pretrained"]


def available() -> list[str]:
    """Returns names of the pretrained filters, for :func:`from_pretrained`.

    Example:
        >>> available()
        ['car-odometry', 'imu', 'quadruped', 'reacher', 'ur5-table']
    """
    return sorted(_registered.weights())


def from_pretrained(
    name_or_folder: str | Path, *, builders: Mapping[str, Callable[..., Filter]] | None = None
) -> Filter:
    """Loads a trained filter by name, or from a folder; without downloads.

    The weights are data only, the filter is built by a function of this library from the settings in ``config.json``,
    and the weights' SHA-256 is compared with that in ``config.json``: no code of a file is executed.

    Args:
        name_or_folder: one of :func:`available`, or a folder of :func:`save_pretrained` or ``denkf train``.
        builders: functions of your own by the name that ``config.json`` gives as ``"builder"``. A filter that
            :func:`save_pretrained` wrote with ``builder=still`` needs ``builders={"still": still}`` here, because the
            folder holds the function's name and not its code.

    Returns:
        The filter, on the CPU, in evaluation mode; ``filter.settings`` are its settings: a dataclass, or the arguments
        of its builder by name.

    Raises:
        FileNotFoundError: if there is no filter of that name and no such folder, or the weights are missing.
        TypeError: if ``name_or_folder`` is neither text nor a path.
        ValueError: if a file is damaged, changed, of another format, or does not match the other; the message names it.

    Example:
        >>> from_pretrained("car-odometry").settings.dt
        0.103
    """
    if not isinstance(name_or_folder, str | os.PathLike):
        raise TypeError(f"name_or_folder is a name or a path, such as 'car-odometry'; got {name_or_folder!r}")
    folder = Path(name_or_folder).expanduser()
    shipped = _registered.weights()
    if str(name_or_folder) in shipped:  # a folder of that name is loaded as "./car-odometry"
        folder = shipped[str(name_or_folder)]
    elif not folder.is_dir():
        raise FileNotFoundError(
            f"there is no trained filter {str(name_or_folder)!r} and no such folder; the library comes with "
            f"{', '.join(shipped)}"
        )
    known = {**_registered.builders(), **(builders or {})}
    model = load_folder(folder, known)
    if not hasattr(model, "settings"):
        config = read_folder_config(folder, known)
        model.builder, model.settings = config["builder"], config["settings"]
    return model  # type: ignore[return-value]


def save_pretrained(
    model: Filter,
    folder: str | Path,
    *,
    training: Mapping[str, Any] | None = None,
    card: str | None = None,
    builder: Callable[..., Filter] | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Path:
    """Writes a filter to a folder that :func:`from_pretrained` reads.

    The filter is built again from its settings, and compared with the given one: ensemble size, keys, schemes, shapes,
    all that the weights do not determine. If they differ, nothing is written.

    Args:
        model: filter of a builder of this library, such as
            :func:`torch_denkf.applications.car.odometry.filter.car_filter`. For other filters pass ``builder`` and
            ``settings``.
        folder: destination of ``weights.safetensors`` and ``config.json``; existing files are overwritten.
        training: command, seed, data: plain values, as a record only.
        card: text of ``card.md``, for people: data, command, scores, limits, licence.
        builder: your function of the settings that builds such a filter. Only its name is saved: pass the function to
            :func:`from_pretrained`, too.
        settings: arguments of ``builder``, plain values.

    Returns:
        The folder.

    Raises:
        ValueError: if the builder is unknown, or builds another filter; the message names the difference.
        OSError: if the folder cannot be written to.
        TypeError: if ``training`` or ``settings`` are not JSON-serialisable, or ``builder`` is no function with a name.

    Example:
        >>> import tempfile, torch
        >>> from torch_denkf.filters import KalmanFilter
        >>> def still(size):
        ...     eye = torch.eye(size)
        ...     return KalmanFilter(eye, eye, process_noise_cov=eye, noise_cov=eye, mean=torch.zeros(size), cov=eye)
        >>> folder = save_pretrained(still(2), tempfile.mkdtemp(), builder=still, settings={"size": 2})
        >>> from_pretrained(folder, builders={"still": still}).carry_keys
        [('belief', 'mean'), ('belief', 'cov')]
    """
    known = _registered.builders()
    own = getattr(model, "settings", None)
    if builder is None and settings is None:
        builder = known.get(getattr(model, "builder", ""))
        if is_dataclass(own) and not isinstance(own, type):
            settings = asdict(own)
        elif isinstance(own, Mapping):
            settings = own
    if builder is None or settings is None:
        raise ValueError(
            f"it is not known what builds this {type(model).__name__}; pass builder=FUNCTION and settings={{...}}, a "
            "function of yours and its arguments; from_pretrained then gets it as builders={NAME: function}"
        )
    name = next((name for name, each in known.items() if each is builder), getattr(builder, "__name__", ""))
    if name not in known and not name.isidentifier():
        raise TypeError(f"builder is a function with a name, which the folder holds; got {builder!r}")
    folder = save_folder(model, folder, builder=name, settings=settings, training=training, build=builder)
    if card is not None:
        write_text(folder / "card.md", card)
    return folder
