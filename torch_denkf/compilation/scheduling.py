"""Bundling of the loops of a compiled step into functions of C++: a short function each, used again.

Inductor puts all loops between two calls of the library into one function. Where small products are written out, that
is a whole chunk of steps: tens of thousands of lines, with memory of its own for each number on the way. With one
function for each loop nest, the same function serves every step of the chunk, and the memory of one step serves the
next. Short functions compile sooner. And in steps this small, allocating memory takes as long as computing.
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

    Loops that several threads share stay in one function: they share the threads' start, too.
    """

    def __call__(self, nodes: Sequence[BaseSchedulerNode]) -> Sequence[BaseSchedulerNode]:
        """Returns ``nodes``; changes how the scheduler of this graph goes through them."""
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
    """Tells whether inductor shares the loops of a node among threads; by its rule, iterations for each thread."""
    threads = config.cpp.threads if config.cpp.threads > 0 else torch.get_num_threads()
    loops = [part for part in node.get_nodes() if isinstance(part, SchedulerNode)]
    sizes = [prod(int(size) for sizes in part.get_ranges() for size in sizes) for part in loops]
    return threads > 1 and max(sizes, default=0) // threads >= config.cpp.min_chunk_size
