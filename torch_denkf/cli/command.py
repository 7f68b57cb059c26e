"""One way to run every sub-command: its words, its mistakes, its exit status."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import inspect
import io
import re
import shlex
import sys
import warnings
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import ClassVar

from torch_denkf.compilation.lock import locked

__all__ = ["Command", "alone_in", "meant", "say"]

_FRAME = re.compile("[\u2500-\u257f]")  # what tyro draws around a mistake


class Command:
    """The base of all sub-commands, which are dataclasses: fields are options, their comments the help.

    What :meth:`run` raises as ``ImportError``, ``OSError``, ``ValueError`` or one of ``mistakes``, or as a ``KeyError``
    with a message, is printed in a line.

    Attributes:
        name: what comes after ``denkf``.
        example: one whole command line.
        resumable: whether a repeated command continues where an interrupted one stopped.
        mistakes: further exceptions whose message is for the user.
        command_line: the words that were given, for the record.

    Example:
        >>> from dataclasses import dataclass
        >>> @dataclass
        ... class Count(Command):
        ...     "Count."
        ...     to: int = 3  # the last number
        ...     name, example = "count", "denkf count --to 3"
        ...
        ...     def run(self):
        ...         if self.to < 1:
        ...             raise ValueError("--to must be positive")
        >>> Count.main(["--to", "4"]), Count.main(["--to", "0"]), Count.main(["--to", "three"])
        (0, 2, 2)
    """

    name: ClassVar[str]
    example: ClassVar[str]
    resumable: ClassVar[bool] = False
    mistakes: ClassVar[tuple[type[Exception], ...]] = ()
    command_line = ""

    def run(self) -> int | None:
        """Does the work; returns the exit status, ``None`` for 0."""
        raise NotImplementedError

    @classmethod
    def main(cls, arguments: Sequence[str] | None = None) -> int:
        """Runs the command.

        Args:
            arguments: its words; by default the process's own.

        Returns:
            The exit status: 0; 1 if what was checked is not in order; 2 with a message on stderr for a mistake; 130
            when interrupted.
        """
        words = list(sys.argv[1:] if arguments is None else arguments)
        try:
            command = cls.read(words)
        except SystemExit as left:  # after --help, or a mistake
            return int(left.code or 0)
        command.command_line = shlex.join(["denkf", cls.name, *words])
        mistakes: tuple[type[Exception], ...] = (ImportError, OSError, ValueError, *cls.mistakes)
        try:
            with warnings.catch_warnings():
                warnings.showwarning = _show
                return command.run() or 0
        except mistakes as error:
            return _mistake(str(error))
        except KeyError as error:
            message = str(error.args[0]) if error.args else ""
            if " " not in message:  # a bare key: not the user's mistake
                raise
            return _mistake(message)
        except KeyboardInterrupt:
            sys.stderr.write(f"interrupted{'; the same command goes on from here' if cls.resumable else ''}\n")
            return 130

    @classmethod
    def read(cls, words: Sequence[str]) -> Command:
        """Returns the options that some words ask for.

        Raises:
            SystemExit: after the help, with status 0; after a line on stderr that tells a mistake, with status 2.
        """
        import tyro  # here: `denkf --help` does not need it

        drawn = io.StringIO()
        try:
            _check_no_empty_word(words)
            _check_known(cls, words)
            with contextlib.redirect_stderr(drawn):
                return tyro.cli(
                    cls,
                    prog=f"denkf {cls.name}",
                    args=words,
                    description=f"{inspect.getdoc(cls)}\n\nexample: {cls.example}",
                    config=(tyro.conf.FlagCreatePairsOff,),  # --overwrite, and no --no-overwrite
                )
        except ValueError as error:
            drawn.write(str(error))
        except SystemExit as left:
            if not left.code:
                raise
        told = _FRAME.sub(" ", drawn.getvalue()).partition("For full helptext")[0]
        sys.stderr.write(f"error: {_in_line(told)}; see denkf {cls.name} --help\n")
        raise SystemExit(2)


def alone_in(out: Path) -> AbstractContextManager[None]:
    """Locks a folder for this command while it works: two would leave files of both.

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
    """Writes a line to stdout."""
    sys.stdout.write(f"{text}\n")


def _check_no_empty_word(words: Sequence[str]) -> None:
    """Raises for an empty word: a variable of the shell that is not set, and as a path the working folder."""
    for before, word in zip(["", *words], words, strict=False):
        if not word or (word.startswith("--") and word.endswith("=")):
            raise ValueError(f"argument {word.rstrip('=') or before}: must not be empty")


def _check_known(command: type, words: Sequence[str]) -> None:
    """Raises for a misspelt option by its name: a parser would first miss the one that was meant."""
    known = [f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(command)]
    allowed = {"--help", *known, *(f"--no-{option[2:]}" for option in known)}
    for word in words:
        option = word.partition("=")[0].replace("_", "-")
        if option.startswith("--") and option not in allowed:
            raise ValueError(f"unknown option {option}{meant(option, known)}")


def meant(word: str, known: Sequence[str]) -> str:
    """Returns the end of a message about a word that is unknown: the nearest known one, or all.

    Example:
        >>> meant("dmo", ["demo", "info"]), meant("x", ["demo", "info"])
        ('; did you mean demo?', '; there are demo, info')
    """
    near = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {near[0]}?" if near else f"; there are {', '.join(known)}"


def _mistake(message: str) -> int:
    sys.stderr.write(f"error: {_in_line(message)}\n")
    return 2


def _in_line(text: str) -> str:
    return " ".join(text.split())


def _show(message, category, filename, lineno, file=None, line=None) -> None:
    sys.stderr.write(f"warning: {_in_line(str(message))}\n")
