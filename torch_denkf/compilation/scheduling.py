"""Splits the loops of a compiled step into short C++ functions, which are reused.

Inductor puts all loops between two library calls into one function. With written-out small products, that is a whole
chunk of steps: tens of thousands of lines, with separate memory for each intermediate value. With one function for each
loop nest, the same function serves every step of the chunk, and steps reuse memory. Short functions compile faster, and
in steps this small, allocating memory takes as long as computing.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import torch
from torch._inductor import config
from torch._inductor.custom_graph_pass import CustomSchedulerPass, get_hash_for_files
from torch._inductor.scheduler import BaseSchedulerNode, SchedulerNode

__all__ = ["ShortFunctions"]


class ShortFunctions(CustomSchedulerPass):
    """Applied to the loop nests of each graph, after inductor has fused them.

    Loops with several threads stay in one function, to start the threads only once.
    """

    def __call__(self, nodes: Sequence[BaseSchedulerNode]) -> Sequence[BaseSchedulerNode]:
        """Returns ``nodes``, and lets the scheduler of this graph end a function after each."""
        if not any(map(_by_several_threads, nodes)):
            devices = {node.get_device() for node in nodes}
            for device in devices:
                if device is not None and device.type == "cpu":
                    nodes[0].scheduler.get_backend(device).ready_to_flush = _always
        return nodes

    def uuid(self) -> bytes:
        """Identifies the pass in inductor's cache."""
        return get_hash_for_files((__file__,), str(torch.get_num_threads()))


def _always() -> bool:
    return True


def _by_several_threads(node: BaseSchedulerNode) -> bool:
    """Returns True if inductor distributes the loops of a node over threads, by its rule of iterations per thread."""
    threads = config.cpp.threads if config.cpp.threads > 0 else torch.get_num_threads()
    loops = [part for part in node.get_nodes() if isinstance(part, SchedulerNode)]
    sizes = [prod(int(size) for sizes in part.get_ranges() for size in sizes) for part in loops]
    return threads > 1 and max(sizes, default=0) // threads >= config.cpp.min_chunk_size
