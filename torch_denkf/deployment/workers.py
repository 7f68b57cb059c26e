"""Worker processes that end with the process that started them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from multiprocessing.connection import wait

__all__ = ["follow_parent"]


def follow_parent() -> None:
    """Makes a worker, which was spawned, end when its parent ends, however that ends.

    Workers of a parent that was killed would wait for work for ever. Call it in a pool's initializer. Ctrl-C is then
    the parent's alone, which must see to it that its workers end.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: multiprocessing.process.BaseProcess) -> None:
    wait([parent.sentinel])
    os._exit(1)
