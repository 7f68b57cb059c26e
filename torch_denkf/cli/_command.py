"""One way to run every sub-command: its words, its mistakes, its exit status."""

from __future__ import annotations

import argparse
import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import NoReturn

from torch_denkf._lock import locked

__all__ = ["Command", "alone_in", "filled", "path", "say", "whole"]


class _Parser(argparse.ArgumentParser):
    """Reports a mistake in one line."""

    def error(self, message: str) -> NoReturn:
        """Write the message and leave with status 2."""
        self.exit(2, f"error: {message}; see {self.prog} --help\n")


class _Formatter(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Shows defaults, but not those that say nothing."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if any(action.default is silent for silent in (None, False, argparse.SUPPRESS)) or action.default == []:
            return action.help
        return super()._get_help_string(action)


class Command:
    """A sub-command: call it with its words.

    Args:
        name: what comes after ``denkf``.
        summary: what it does, in a line.
        example: one whole command line.
        arguments: adds the arguments to a parser.
        run: does the work; returns the exit status, ``None`` for 0.
        resumable: whether a repeated command goes on where an interrupted one stopped.
        mistakes: exceptions whose message is for the user, beside ``ImportError``, ``OSError``, ``ValueError`` and a
            ``KeyError`` with a message.

    Example:
        >>> def run(args):
        ...     if args.count < 1:
        ...         raise ValueError("count must be positive")
        >>> count = Command("count", "Count.", "denkf count 3", lambda p: p.add_argument("count", type=int), run)
        >>> count(["3"]), count(["0"]), count(["three"])
        (0, 2, 2)
    """

    def __init__(
        self,
        name: str,
        summary: str,
        example: str,
        arguments: Callable[[argparse.ArgumentParser], object],
        run: Callable[[argparse.Namespace], int | None],
        *,
        resumable: bool = False,
        mistakes: tuple[type[Exception], ...] = (),
    ):
        self.name, self.run, self.resumable = name, run, resumable
        self.mistakes: tuple[type[Exception], ...] = (ImportError, OSError, ValueError, *mistakes)
        self.parser = _Parser(
            allow_abbrev=False,
            prog=f"denkf {name}",
            description=summary,
            epilog=f"example:\n  {example}",
            formatter_class=_Formatter,
        )
        arguments(self.parser)

    def __call__(self, arguments: Sequence[str] | None = None) -> int:
        """Run the command.

        Args:
            arguments: its words; by default the process's own.

        Returns:
            The exit status: 0; 1 if what was checked is not in order; 2 with a message on stderr for a mistake; 130
            when interrupted.
        """
        words = list(sys.argv[1:] if arguments is None else arguments)
        try:
            args = self.parser.parse_args(words)
        except SystemExit as left:  # after --help, or a mistake
            return int(left.code or 0)
        args.command_line = shlex.join(["denkf", *self.name.split(), *words])
        try:
            with warnings.catch_warnings():
                warnings.showwarning = _show
                return self.run(args) or 0
        except self.mistakes as error:
            return _mistake(str(error))
        except KeyError as error:
            message = str(error.args[0]) if error.args else ""
            if " " not in message:  # a bare key: not the user's mistake
                raise
            return _mistake(message)
        except KeyboardInterrupt:
            sys.stderr.write(f"interrupted{'; the same command goes on from here' if self.resumable else ''}\n")
            return 130


def whole(least: int) -> Callable[[str], int]:
    """The type of an argument that is a whole number, at least so large.

    Example:
        >>> whole(1)("3")
        3
    """

    def read(text: str) -> int:
        number = int(text)
        if number < least:
            raise argparse.ArgumentTypeError(f"must be at least {least}, got {number}")
        return number

    read.__name__ = "whole number"  # argparse names it for what is no number
    return read


def filled(text: str) -> str:
    """The type of an argument that must not be empty, as that of a variable of the shell that is not set.

    Example:
        >>> filled("runs/car")
        'runs/car'
    """
    if not text:
        raise argparse.ArgumentTypeError("must not be empty")
    return text


def path(text: str) -> Path:
    """The type of an argument that names a file or folder.

    Example:
        >>> path("runs/car").name
        'car'
    """
    return Path(filled(text))


def alone_in(out: Path) -> AbstractContextManager[None]:
    """A folder is this command's alone while it works: two would leave files of both.

    Raises:
        OSError: if another command writes to it, or it cannot be written to; names the folder and the process.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with alone_in(folder), alone_in(folder):
        ...     pass
        Traceback (most recent call last):
        OSError: cannot use ...: another process is writing to it (process ...); wait for it to end, or choose ...
    """
    return locked(out, ".denkf", "is writing to it")


def say(text: str) -> None:
    """Write a line to stdout."""
    sys.stdout.write(f"{text}\n")


def _mistake(message: str) -> int:
    sys.stderr.write(f"error: {' '.join(message.split())}\n")
    return 2


def _show(message, category, filename, lineno, file=None, line=None) -> None:
    sys.stderr.write(f"warning: {' '.join(str(message).split())}\n")
