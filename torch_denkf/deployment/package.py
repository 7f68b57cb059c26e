"""Loading a packaged step. This file imports torch alone: it is what runs on the robot."""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor

SIGNATURE = "torch_denkf"  # name of the description inside a package


class PackagedStep:
    """One step of a filter: state in, state out.

    Entries are named like the filter's keys, nested ones with dots: ``"belief.ensemble"``.

    Args:
        run: takes the inputs in order and returns the outputs in order.
        signature: names, shapes and dtypes, as :func:`torch_denkf.deployment.export_step` wrote them.

    Attributes:
        inputs: what a call needs, by name: shape and dtype.
        outputs: names of what it returns.
        carry: the outputs that are inputs of the next step.
    """

    def __init__(self, run: Callable[..., tuple[Tensor, ...]], signature: dict):
        self._run = run
        self.inputs = {name: (tuple(shape), dtype) for name, shape, dtype in signature["inputs"]}
        self.outputs: list[str] = signature["outputs"]
        self.carry: list[str] = signature["carry"]

    def __call__(self, entries: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Takes one step.

        Args:
            entries: all ``inputs``; others are ignored, so that the last outputs and a new frame can be passed on
                together.

        Raises:
            KeyError: if an input is missing.
            ValueError: if it has another shape or dtype than the package was made for.
        """
        values = []
        for name, (shape, dtype) in self.inputs.items():
            if name not in entries:
                raise KeyError(f"the step needs {name!r} {list(shape)}; it got {sorted(entries)}")
            value = entries[name]
            if tuple(value.shape) != shape or str(value.dtype) != dtype:
                raise ValueError(
                    f"{name!r} must be {dtype} {list(shape)}, got {value.dtype} {list(value.shape)}; a package has "
                    "static shapes: export another one"
                )
            values.append(value)
        return dict(zip(self.outputs, self._run(*values), strict=True))


def load_step(path: str | Path) -> PackagedStep:
    """Loads what :func:`torch_denkf.deployment.export_step` wrote.

    A package is a program: loading it runs the native code in it, with all rights of this process, and a package that
    is not compiled may hold pickles, which run code, too. Load packages alone that you would also execute; nothing in
    the file is checked against malice. Weights that are data only: :func:`torch_denkf.pretrained.save_pretrained`.

    Args:
        path: the ``.pt2`` file.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is not a packaged step, or one that is damaged.
        OSError: if there is no space to unpack it; names the folder and its free space.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; export_step(filter, example, path) writes it")
    try:
        with zipfile.ZipFile(path) as archive:
            compiled = any("aotinductor" in name for name in archive.namelist())
    except zipfile.BadZipFile as error:
        raise ValueError(f"{path} is no package of a step, or it was cut; export it again") from error
    try:
        run, signature = _load(path, compiled)
    except OSError:
        raise
    except Exception as error:  # torch raises whatever it stumbles over in a file of another kind
        reason = " ".join(str(error).split())[:200]
        raise ValueError(
            f"{path} is a zip file, but torch cannot load a step from it ({type(error).__name__}: {reason}); pass what "
            "export_step wrote, with this version of torch"
        ) from error
    if not signature:
        raise ValueError(f"{path} is a torch package, but not one of export_step: it lacks the entry {SIGNATURE!r}")
    try:
        return PackagedStep(run, json.loads(signature))
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} has a damaged description in its entry {SIGNATURE!r} ({type(error).__name__}: {error}); export it "
            "again"
        ) from error


def _load(path: Path, compiled: bool) -> tuple[Callable[..., tuple[Tensor, ...]], str]:
    if compiled:
        try:
            run = torch._inductor.aoti_load_package(str(path))
        except RuntimeError as error:
            # Where torch unpacks it; Python's tempfile passes over folders that are full.
            names = ("TMPDIR", "TMP", "TEMP", "TEMPDIR")
            folder = next((os.environ[name] for name in names if name in os.environ), "/tmp")
            if shutil.disk_usage(folder).free > 4 * path.stat().st_size:
                raise
            raise OSError(
                f"cannot unpack {path} in {folder}, which has {shutil.disk_usage(folder).free / 1e3:.0f} kB free: free "
                "some space, or set TMPDIR to another folder"
            ) from error
        return run, run.get_metadata().get(SIGNATURE, "")
    files = {SIGNATURE: ""}
    return torch.export.load(path, extra_files=files).module(), files[SIGNATURE]
