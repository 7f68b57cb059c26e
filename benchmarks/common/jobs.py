"""Runs the jobs of a study in parallel, each once, and saves their rows."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import active_children, get_context
from pathlib import Path

import torch
from tqdm import tqdm

from torch_denkf.deployment.files import write_text
from torch_denkf.deployment.workers import follow_parent


def once(file: Path, rows: Callable[[], list[dict]]) -> None:
    """Computes rows and saves them in a JSON file, unless it exists: an interrupted study resumes."""
    if file.exists():
        return
    write_text(file, json.dumps(rows()))


def same_settings(out: Path, settings: dict) -> None:
    """Saves settings in ``out/settings.json``; a study that resumes in this folder needs the same settings.

    Raises:
        SystemExit: if the folder has other settings; names them.
    """
    file, settings = out / "settings.json", json.loads(json.dumps(settings, default=str))
    if not file.exists():
        write_text(file, json.dumps(settings))
    there = json.loads(file.read_text())
    other = [name for name in {**settings, **there} if settings.get(name) != there.get(name)]
    if other:
        named = ", ".join(f"{name}={there.get(name)!r} (now {settings.get(name)!r})" for name in other)
        raise SystemExit(f"{out} was begun with {named}. Give another --out, or the same settings.")


def side_by_side(calls: Sequence[Callable[[], object]], processes: int, title: str) -> None:
    """Runs all calls in a pool of new processes, which end with this one; an exception of a call is raised here."""
    if processes < 2:
        for call in tqdm(calls, desc=title, disable=None):
            call()
        return
    context = get_context("spawn")
    with ProcessPoolExecutor(processes, context, initializer=follow_parent) as pool:
        futures = [pool.submit(call) for call in calls]
        try:
            for future in tqdm(as_completed(futures), total=len(futures), desc=title, disable=None):
                future.result()
        except KeyboardInterrupt:
            for worker in active_children():  # they leave Ctrl-C to this process, which would wait for all their calls
                worker.terminate()
            raise


def compute(jobs: Mapping[Path, Callable[[], list[dict]]], processes: int, title: str) -> list[dict]:
    """Runs all jobs and returns their rows; each job saves its rows in a file, which a resumed run reads."""
    side_by_side([partial(_alone, file, rows) for file, rows in jobs.items()], processes, title)
    return read_rows(jobs)


def _alone(file: Path, rows: Callable[[], list[dict]]) -> None:
    torch.set_num_threads(1)
    once(file, rows)


def read_rows(files: Iterable[Path], shared: Callable[[dict], Hashable] = lambda row: None) -> list[dict]:
    """Returns all rows of some JSON files.

    Args:
        files: in the order of their rows.
        shared: key by which rows of several files are duplicates, or ``None``; those of the first file are kept.

    Raises:
        ValueError: if a file is damaged; names it.
    """
    rows: list[dict] = []
    seen: set[Hashable] = set()
    for file in files:
        try:
            found = json.loads(file.read_text())
        except ValueError as error:
            raise ValueError(f"{file} is damaged ({error}); remove it, and the study computes it again") from error
        keyed = [(shared(row), row) for row in found]
        rows += [row for key, row in keyed if key not in seen]
        seen |= {key for key, _ in keyed if key is not None}
    return rows


def rows_in(out: Path) -> list[dict]:
    """Returns all rows in the folder ``out/rows`` of a study."""
    return read_rows(sorted((out / "rows").glob("*.json")))
