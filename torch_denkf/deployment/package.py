"""Loads a packaged step. This file imports only torch, and runs on the robot."""

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
NEEDS_ONNX = 'ONNX models need the extra "onnx": pip install "torch_denkf[onnx]"'
_MOST_UNPACKED = 50  # largest ratio of unpacked to packed size; torch does not compress, and text shrinks to a tenth


class PackagedStep:
    """One step of a filter: state in, state out.

    Entries are named like the filter's keys, nested ones with dots: ``"belief.ensemble"``.

    Args:
        run: takes the inputs in order and returns the outputs in order.
        signature: names, shapes and dtypes, as :func:`torch_denkf.deployment.export_step` wrote them.

    Attributes:
        inputs: shape and dtype of each input, by name.
        outputs: names of the outputs.
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
            entries: all ``inputs``; other entries are ignored, so that the last outputs and a new frame can be passed
                together.

        Raises:
            KeyError: if an input is missing.
            ValueError: if its shape or dtype differs from the package's.
        """
        nested = [key for key in entries if not isinstance(key, str) or isinstance(entries[key], Mapping)]
        if nested or not isinstance(entries, Mapping):
            found = f"nested entries, {nested[0]!r}" if nested else type(entries).__name__
            raise TypeError(f"a packaged step takes a flat dictionary of {list(self.inputs)}; got {found}")
        values = []
        for name, (shape, dtype) in self.inputs.items():
            if name not in entries:
                raise KeyError(f"the step needs {name!r} {list(shape)}; it got {sorted(entries)}")
            value = entries[name]
            if not isinstance(value, Tensor):
                raise TypeError(f"{name!r} must be a tensor, {dtype} {list(shape)}, got a {type(value).__name__}")
            if tuple(value.shape) != shape or str(value.dtype) != dtype:
                raise ValueError(
                    f"{name!r} must be {dtype} {list(shape)}, got {value.dtype} {list(value.shape)}; a package has "
                    "static shapes: export another one"
                )
            values.append(value.contiguous())  # native code assumes the memory layout of the example
        return dict(zip(self.outputs, self._run(*values), strict=True))


def load_step(path: str | Path) -> PackagedStep:
    """Loads a package of :func:`torch_denkf.deployment.export_step`.

    A package is a program: loading it executes its native code with all rights of this process, and a package that is
    not compiled may have pickles, which execute code, too.

    Load only packages that you trust; the file is not checked against malice. For weights as data see
    :func:`torch_denkf.pretrained.save_pretrained`. An ONNX model (``.onnx``) has neither. onnxruntime runs it, on the
    processor, with as many threads as torch has when the model is loaded.

    Args:
        path: the ``.pt2`` or ``.onnx`` file.

    Raises:
        FileNotFoundError: if the file does not exist.
        ImportError: for an ONNX model without onnxruntime; the message names the extra.
        ValueError: if it is no packaged step, or damaged.
        OSError: if there is no space to unpack it; the message names the folder and its free space.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path} is no file; export_step(filter, example, path) writes it")
    run: Callable[..., tuple[Tensor, ...]]
    counts = None
    if path.suffix == ".onnx":
        try:
            run, signature = run_onnx(path.read_bytes())
        except (RuntimeError, ValueError) as error:
            raise ValueError(f"{path} is no ONNX model, or it is damaged ({error}); export it again") from error
    elif _is_compiled(path):
        try:
            run = torch._inductor.aoti_load_package(str(path))
        except RuntimeError as error:
            # The folder in which torch unpacks it; Python's tempfile skips full folders.
            folder = next(
                (os.environ[name] for name in ("TMPDIR", "TMP", "TEMP", "TEMPDIR") if name in os.environ), "/tmp"
            )
            if shutil.disk_usage(folder).free > 4 * path.stat().st_size:
                reason = " ".join(str(error).split())
                raise ValueError(f"{path} cannot be loaded ({reason}); export it again, on such a machine") from error
            raise OSError(
                f"cannot unpack {path} in {folder}, which has {shutil.disk_usage(folder).free / 1e3:.0f} kB free: free "
                "some space, or set TMPDIR to another folder"
            ) from error
        signature = run.get_metadata().get(SIGNATURE, "")
    else:
        files = {SIGNATURE: ""}
        try:
            program = torch.export.load(path, extra_files=files)
        except Exception as error:  # torch, json and pickle raise a dozen kinds for invalid files
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise ValueError(f"{path} cannot be loaded ({reason}); export it again") from error
        # Shapes and dtypes are checked here; torch's checks fail for unused inputs.
        run, signature = program.module(check_guards=False), files[SIGNATURE]
        counts = len(program.graph_signature.user_inputs), len(program.graph_signature.user_outputs)
    if not signature:
        raise ValueError(f"{path} holds a model, but not one of export_step: it lacks the entry {SIGNATURE!r}")
    return PackagedStep(run, _described(path, signature, counts))


def run_onnx(model: bytes) -> tuple[Callable[..., tuple[Tensor, ...]], str]:
    """Returns a function that runs an ONNX model on tensors, and its description, which may be empty.

    Raises:
        ImportError: without onnxruntime; the message names the extra.
        RuntimeError: if it is no such model.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError(NEEDS_ONNX) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3  # errors
    try:
        session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # a dozen kinds without a common class
        raise RuntimeError(" ".join(str(error).split())) from error
    names = [each.name for each in session.get_inputs()]

    def run(*values: Tensor) -> tuple[Tensor, ...]:
        arrays = (value.detach().cpu().numpy() for value in values)
        return tuple(map(torch.as_tensor, session.run(None, dict(zip(names, arrays, strict=True)))))

    return run, session.get_modelmeta().custom_metadata_map.get(SIGNATURE, "")


def _is_compiled(path: Path) -> bool:
    """Returns True if a package has native code; raises if it is damaged, as that could end the process.

    Raises:
        ValueError: if it is no package, or a part has a wrong checksum.
    """
    again = "export it again"
    try:
        with zipfile.ZipFile(path) as archive:
            parts = archive.infolist()
            size = sum(part.file_size for part in parts)
            if size > _MOST_UNPACKED * path.stat().st_size:
                raise ValueError(f"it would unpack to {size} bytes")
            damaged = archive.testzip()
    except Exception as error:  # zipfile raises half a dozen kinds for damaged files
        raise ValueError(f"{path} is no package of a step, or it was cut ({error}); {again}") from error
    if damaged is not None:
        raise ValueError(f"{path} is damaged: the checksum of its part {damaged!r} is wrong; {again}")
    return any("aotinductor" in part.filename for part in parts)


def _described(path: Path, text: str, counts: tuple[int, int] | None) -> dict:
    """Returns the description in a package.

    Args:
        path: path for the message.
        text: the description.
        counts: numbers of inputs and outputs of the package, if known.

    Raises:
        ValueError: if it is no description of export_step, or does not match the package.
    """
    try:
        found = json.loads(text)
        inputs = [(str(name), [int(n) for n in shape], str(dtype)) for name, shape, dtype in found["inputs"]]
        outputs, carry = list(map(str, found["outputs"])), list(map(str, found["carry"]))
        fits = counts is None or counts == (len(inputs), len(outputs))
        if not fits or not set(carry) <= set(outputs):
            raise ValueError(f"{len(inputs)} inputs, outputs {outputs}, of which {carry} are carried on")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} has a damaged description ({error}); export it again") from error
    return {"inputs": inputs, "outputs": outputs, "carry": carry}
