"""Files of tracked paths: mean and covariance at each frame."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.applications.car.odometry.tracking import TrackedBelief
from torch_denkf.data.text import read_lines
from torch_denkf.deployment.files import replacing
from torch_denkf.functional.moments import ensemble_cov

__all__ = ["PATH_COLUMNS", "read_path", "write_path"]

_STATE = ("x_m", "y_m", "theta_rad", "v_m_per_s", "theta_dot_rad_per_s")
#: Columns of path.csv; ``std_`` are standard deviations, ``cov_xy_m2`` is the covariance of x and y; ``hidden`` is the
#: share of the image with a static occlusion.
PATH_COLUMNS = ("frame", "time_s", "observed", *_STATE, *(f"std_{name}" for name in _STATE), "cov_xy_m2", "hidden")


def write_path(beliefs: Iterable[TrackedBelief], file: str | Path) -> Iterator[TrackedBelief]:
    """Writes beliefs to a CSV file as they arrive, and yields them.

    Rows are written at once to a temporary hidden file next to ``file``, which replaces ``file`` at the end, or on an
    interruption: written rows are kept, and a full disk does not destroy an existing file. The temporary file of a
    killed process is removed with the next write. Numbers have nine digits, which represent float32 exactly.

    Args:
        beliefs: from :func:`torch_denkf.applications.car.track`.
        file: CSV file with a row for each belief, see ``PATH_COLUMNS``; its folder is created.

    Yields:
        The beliefs.

    Raises:
        OSError: if the file cannot be written, as on a full disk; an existing file is then unchanged.

    Example:
        >>> import tempfile
        >>> belief = TrackedBelief(3, 0.3, True, torch.ones(5), torch.full((5,), 4.0), torch.randn(8, 5))
        >>> file = Path(tempfile.mkdtemp()) / "path.csv"
        >>> for written in write_path([belief], file):
        ...     pass
        >>> read_path(file)["belief", "var"]
        tensor([[4., 4., 4., 4., 4.]], dtype=torch.float64)
    """
    broken_off: BaseException | None = None
    sound = False
    with replacing(file) as part, part.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(PATH_COLUMNS)
        try:
            for belief in beliefs:
                sound = False
                writer.writerow(_row(belief))
                stream.flush()
                sound = True
                yield belief
        except BaseException as error:
            if not sound:  # the file itself could not be written
                raise
            broken_off = error
    if broken_off is not None:
        raise broken_off


def _row(belief: TrackedBelief) -> list[Any]:
    covariance = float(ensemble_cov(belief.ensemble[:, :2])[0, 1])
    numbers = [*belief.mean.tolist(), *belief.var.sqrt().tolist(), covariance, belief.hidden]
    return [belief.frame, f"{belief.time:.9g}", int(belief.observed), *(f"{value:.9g}" for value in numbers)]


def read_path(file: str | Path) -> TensorDict:
    """Reads a file of :func:`write_path`.

    Args:
        file: ``path.csv``.

    Returns:
        ``[T]``, float64: ``("belief", "mean")`` and ``("belief", "var")`` ``[T, 5]``, ``("belief", "cov")`` ``[T, 5,
        5]`` (of x and y; other entries are diagonal), ``"time"`` ``[T, 1]``, ``"frame"``, ``"observed"`` and
        ``"hidden"`` ``[T, 1]``.

    Raises:
        FileNotFoundError: without the file.
        ValueError: if it lacks columns or rows, or a number cannot be read or is not finite; the message names file
            and line.
    """
    file = Path(file)
    if not file.is_file():
        raise FileNotFoundError(f"no path {file}; `denkf odometry` leaves a path.csv")
    reader = csv.DictReader(read_lines(file))
    if missing := [name for name in PATH_COLUMNS if name not in (reader.fieldnames or ())]:
        raise ValueError(f"{file} has no columns {', '.join(missing)}; pass a path.csv of `denkf odometry`")
    rows = []
    for row in reader:
        try:
            rows.append([float(row[name]) for name in PATH_COLUMNS])
        except (TypeError, ValueError) as error:
            raise ValueError(f"{file}:{reader.line_num}: expected {len(PATH_COLUMNS)} numbers ({error})") from error
        if broken := [name for name, value in zip(PATH_COLUMNS, rows[-1], strict=True) if not math.isfinite(value)]:
            raise ValueError(f"{file}:{reader.line_num}: {', '.join(broken)} not finite; write the path again")
    if not rows:
        raise ValueError(f"{file} has no rows")
    table = torch.tensor(rows, dtype=torch.float64)
    frame, time, observed, mean, std, cov, hidden = table.split([1, 1, 1, 5, 5, 1, 1], -1)
    belief = TensorDict({"mean": mean, "var": std.square(), "cov": _cov(std, cov)}, [len(rows)])
    entries = {"belief": belief, "time": time, "frame": frame.long(), "observed": observed.bool(), "hidden": hidden}
    return TensorDict(entries, [len(rows)])


def _cov(std: Tensor, cov: Tensor) -> Tensor:
    matrix = torch.diag_embed(std.square())
    matrix[:, 0, 1] = matrix[:, 1, 0] = cov.squeeze(-1)
    return matrix
