"""Logs of a training, which a resumed training continues without duplicates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path

from torchrl.record.loggers import CSVLogger, TensorboardLogger
from torchrl.record.loggers.common import Logger

from torch_denkf.deployment.files import clear_errors

__all__ = ["RunLogs"]

_KINDS = {
    "csv": (CSVLogger, "csv/**/*.csv"),
    "tensorboard": (TensorboardLogger, "tensorboard/**/events.out.tfevents.*"),
}


class RunLogs:
    """Wraps torchrl's loggers; the file loggers created here can be reset to an earlier :meth:`mark`.

    torchrl's file loggers only append, so that a checkpoint needs only the sizes of their files: on resuming, files are
    truncated to their size and later files are removed.

    Args:
        folder: folder of ``csv/scalars/*.csv`` (rows ``step,value``) and ``tensorboard/events.out.tfevents.*``.
        loggers: ``"csv"``, ``"tensorboard"``, or loggers of torchrl, which are not reset: values after the last
            checkpoint are logged twice.

    Raises:
        ValueError: for an unknown name.
        ImportError: if ``tensorboard`` is requested and not installed.

    Example:
        >>> from tempfile import mkdtemp
        >>> logs = RunLogs(mkdtemp())
        >>> logs.open({})
        >>> logs.log({"loss": 0.5}, step=10)
        >>> logs.mark()
        {'csv/scalars/loss.csv': 7}
    """

    def __init__(self, folder: Path | str, loggers: Iterable[str | Logger] = ("csv",)):
        self.folder, self._wanted = Path(folder), list(loggers)
        self._own: list[Logger] = []
        for logger in self._wanted:
            if isinstance(logger, str) and logger not in _KINDS:
                raise ValueError(f"Unknown logger {logger!r}: give one of {sorted(_KINDS)} or a torchrl Logger.")
        if "tensorboard" in self._wanted and find_spec("tensorboard") is None:
            raise ImportError(
                'loggers=("tensorboard",) needs the package tensorboard: pip install "torch_denkf[examples]".'
            )

    def open(self, mark: Mapping[str, int]) -> None:
        """Truncates the files to ``mark`` (``{}`` removes them) and opens the loggers."""
        for file, name in self._files():
            if name not in mark:
                file.unlink()
            elif file.stat().st_size > mark[name]:
                with file.open("r+b") as stream:
                    stream.truncate(mark[name])
        names = [logger for logger in self._wanted if isinstance(logger, str)]
        self._own = [_KINDS[name][0](exp_name=name, log_dir=str(self.folder)) for name in names]

    def log(self, values: Mapping[str, float], step: int) -> None:
        """Writes scalars.

        Raises:
            OSError: if they cannot be written, as on a full disk; the message names the folder and the free space.
        """
        with clear_errors(self.folder / "csv", "choose another out", name=f"logs to {self.folder}"):
            self._log(values, step)

    def files(self) -> list[Path]:
        """Returns the files of the loggers created here."""
        return [file for file, _ in self._files()]

    def _log(self, values: Mapping[str, float], step: int) -> None:
        for logger in (*self._own, *(logger for logger in self._wanted if not isinstance(logger, str))):
            logger.log_metrics(dict(values), step=step)

    def mark(self) -> dict[str, int]:
        """Returns the present sizes of all files in bytes."""
        with clear_errors(self.folder / "csv", "choose another out", name=f"logs to {self.folder}"):
            for logger in self._own:
                logger.flush()
        return {name: file.stat().st_size for file, name in self._files()}

    def close(self) -> None:
        """Closes the loggers created here."""
        own, self._own = self._own, []
        with clear_errors(self.folder / "csv", "choose another out", name=f"logs to {self.folder}"):
            for logger in own:
                logger.close()

    def _files(self) -> list[tuple[Path, str]]:
        # Only files of these loggers: the folder may have other files.
        patterns = [pattern for _, pattern in _KINDS.values()]
        files = sorted(file for pattern in patterns for file in self.folder.glob(pattern))
        return [(file, file.relative_to(self.folder).as_posix()) for file in files]
