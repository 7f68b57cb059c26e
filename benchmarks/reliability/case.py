"""Runs one damaged input in a separate process, and returns a verdict on the outcome."""

from __future__ import annotations

import atexit
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import torch_denkf
from benchmarks.reliability.hostile import MARK

Kind = Literal["clear", "right", "unclear", "silent", "hang", "crash"]

SECONDS = 20.0  # after which a case counts as a hang
MEMORY = 6 << 30  # bytes of address space that a case may use in addition to its parent's
LIBRARY = str(Path(torch_denkf.__file__).parent)


@dataclass(frozen=True)
class Case:
    """A damaged input.

    Args:
        border: interface of the library.
        name: the damaged part and its damage; unique in its border.
        words: damaged arguments, keys or files: a clear message has one of them as a word.
        act: uses the input as a user would, in a given empty folder.
        right: whether a result is right, judged by the undamaged part of the input; ``None`` if the case must raise.
        within: time limit in s.
    """

    border: str
    name: str
    words: tuple[str, ...]
    act: Callable[[Path], Any]
    right: Callable[[Any], bool] | None = None
    within: float = SECONDS


class Refused(Exception):
    """A command ended with a message."""


@dataclass(frozen=True)
class Verdict:
    """Outcome of a case.

    Attributes:
        kind: ``clear``: an error raised in this library that names the damaged part. ``right``: no error, and the
            result of the undamaged part. ``silent``: no error, and no right result. ``unclear``: any other error.
            ``hang``: not finished in time. ``crash``: the process was ended by a signal.
        text: the message, or a description of the outcome.
    """

    kind: Kind
    text: str = ""


def forked(work: Callable[[], Any], log: Path | None = None) -> int:
    """Runs ``work`` in a forked process with its own session, whose output goes to a file; returns its id."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        os.setsid()
        if log:
            with log.open("a") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
        work()
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def apart(work: Callable[[], Any]) -> None:
    """Runs ``work`` in a forked process, so that its imports, compiled code and threads do not stay in this one."""
    _, status = os.waitpid(forked(work), 0)
    if status:
        raise RuntimeError(f"{work} failed; see above")


@cache
def workshop() -> Path:
    """Returns a folder for the cases' undamaged inputs, which is deleted when its process ends."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-sound-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)  # not in forked children, which leave by os._exit
    return folder


def judge(case: Case) -> Verdict:
    """Runs a case in a forked process, so that its crashes, hangs and side effects do not affect other cases."""
    with tempfile.TemporaryDirectory(prefix="fuzz-", ignore_cleanup_errors=True) as root:
        folder, said = Path(root, "work"), Path(root, "verdict")
        folder.mkdir()
        child = forked(lambda: _run(case, folder, said), Path(os.devnull))
        end, over, status = time.monotonic() + case.within, 0, 0
        while not over and time.monotonic() < end:
            time.sleep(0.002)
            over, status = os.waitpid(child, os.WNOHANG)
        with suppress(ProcessLookupError):  # with its children; it may have ended, or not yet called setsid
            os.killpg(child, signal.SIGKILL)
        if not over:
            os.waitpid(child, 0)
            return Verdict("hang", f"not over after {case.within:g} s")
        if said.exists():
            return Verdict(**json.loads(said.read_text()))
        code = os.waitstatus_to_exitcode(status)
        return Verdict("crash", f"ended by {signal.Signals(-code).name if code < 0 else f'exit status {code}'}")


def _run(case: Case, folder: Path, said: Path) -> None:
    """Runs the case in the child, and writes its verdict to a file."""
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY, held + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    warnings.simplefilter("ignore")
    os.chdir(folder)
    verdict = verdict_on(case, folder)
    if (folder / MARK).exists():
        verdict = Verdict("silent", "a hostile file got to run")
    said.write_text(json.dumps(vars(verdict)))


def verdict_on(case: Case, folder: Path) -> Verdict:
    """Runs a case in this process."""
    try:
        result = case.act(folder)
    except Exception as error:
        return _of_error(case, error)
    except SystemExit as left:
        return Verdict("unclear", f"SystemExit: {left.code}")
    if case.right is None:
        return Verdict("silent", "accepted")
    try:
        right = bool(case.right(result))
    except Exception as error:
        return Verdict("silent", f"the result cannot be compared: {type(error).__name__}: {error}"[:500])
    return Verdict("right") if right else Verdict("silent", "a result, and not that of the undamaged part")


def _of_error(case: Case, error: Exception) -> Verdict:
    """Returns the verdict on an error: clear if it was raised in this library with one of the case's words."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    message = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    ours = last.filename.startswith(LIBRARY) or isinstance(error, Refused)
    named = any(re.search(rf"(?<!\w){re.escape(word)}(?!\w)", message) for word in case.words)
    place = f"{Path(last.filename).name}:{last.lineno}"
    text = f"{type(error).__name__} at {place}: {' '.join(message.split())}"[:500]
    return Verdict("clear" if ours and named else "unclear", text)
