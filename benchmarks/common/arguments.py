"""Options of a study: a dataclass, which tyro reads from the command line."""

from __future__ import annotations

import inspect
import os
import platform
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import torch
import tyro

T = TypeVar("T")
ROOT = Path(__file__).parents[2]
CONFIG = (tyro.conf.FlagCreatePairsOff,)  # --smoke, and no --no-smoke


def parse(options: type[T], arguments: Sequence[str] | None = None) -> T:
    """Returns the options of a command line; a field's comment is its help. Sets torch to one thread.

    The matrices of the studies are small: more threads would only wait for each other.
    """
    torch.set_num_threads(1)
    running = sys.modules["__main__"].__spec__ if options.__module__ == "__main__" else None
    name = running.name.removesuffix(".__main__") if running else options.__module__.rpartition(".")[0]
    return tyro.cli(
        options, prog=f"python -m {name}", args=arguments, config=CONFIG, description=inspect.getdoc(options)
    )


def run_one(commands: dict[str, type[Callable[[], None]]], arguments: Sequence[str] | None = None) -> None:
    """Runs the command that the command line names; ``--smoke`` alone runs all of them, tiny.

    Args:
        commands: by name, dataclasses of options that can be called and have a field ``smoke``.
        arguments: by default the command line's.
    """
    torch.set_num_threads(1)
    if list(sys.argv[1:] if arguments is None else arguments) == ["--smoke"]:
        for name, options in commands.items():
            print(f"-- {name}", flush=True)
            options(smoke=True)()
        return
    tyro.extras.subcommand_cli_from_dict(commands, args=arguments, config=CONFIG)()


def some_of(names: Iterable[str]) -> Any:
    """Returns the type of an option that takes several of the names."""
    return tuple[Literal[tuple(names)], ...]


def command(study: str) -> str:
    """Returns the command line that is running, for the record: ``python -m benchmarks.<study> ...``.

    Absolute paths become relative to the repository's root, so that the record has no folder of this machine.
    """
    return shlex.join(["python", "-m", f"benchmarks.{study}", *(_from_root(word) for word in sys.argv[1:])])


def _from_root(word: str) -> str:
    option, equals, value = word.partition("=") if word.startswith("--") else ("", "", word)
    return option + equals + (os.path.relpath(value, ROOT) if os.path.isabs(value) else value)


def processor() -> str:
    """Returns the processor's name, for the record."""
    info = Path("/proc/cpuinfo")
    for line in info.read_text().splitlines() if info.exists() else []:
        if line.startswith("model name"):
            return line.split(":")[1].strip()
    return platform.processor() or platform.machine()


def made_by(study: str, more: str = "") -> list[str]:
    """Returns the last lines of a page: the command, followed by ``more``, processor and torch."""
    return [f"* Command: `{command(study)}`{more}.", f"* Hardware: {processor()}; torch {torch.__version__}."]
