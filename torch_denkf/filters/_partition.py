"""How torch.compile splits a chunk into forward and backward: what one leaves for the other goes in few tensors.

A step of small networks leaves two dozen small tensors for its backward pass. Each costs a few microseconds more than
its numbers do: an allocation, a Python object, and autograd's records. So tensors of one shape go as one.
"""

from __future__ import annotations

import operator
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import torch
from torch._functorch import config
from torch._functorch.partitioners import min_cut_rematerialization_partition
from torch._inductor.custom_graph_pass import CustomPartitionerFn, get_hash_for_files
from torch.fx import Graph, GraphModule, Node

from torch_denkf.filters._kernels import insert_call

__all__ = ["FewSavedTensors"]

#: Bytes of a tensor from which on copying it costs more than an object of its own.
LARGE = 2**15


class FewSavedTensors(CustomPartitionerFn):
    """The default partitioner of inductor, after which small saved tensors of one shape and type are one tensor."""

    def __call__(self, gm: GraphModule, joint_inputs: Sequence[object], **fields: Any) -> tuple[GraphModule, ...]:
        """Splits a joint graph; ``fields`` are the default partitioner's."""
        with config.patch(recompute_views=True):  # a view is free, but not to save
            forward, backward = min_cut_rematerialization_partition(gm, joint_inputs, **fields)
        join_saved(forward.graph, backward.graph, fields["num_fwd_outputs"])
        forward.recompile()
        backward.recompile()
        return forward, backward

    def uuid(self) -> bytes:
        """What inductor's cache knows this by."""
        return get_hash_for_files((__file__,))


def join_saved(forward: Graph, backward: Graph, outputs: int) -> None:
    """Concatenates saved tensors of one shape and type where the forward graph ends; the backward graph splits them.

    Args:
        forward: its results are ``outputs`` values for the caller, then the saved ones.
        backward: its inputs begin with the saved ones, in the same order.
        outputs: number of values for the caller.
    """
    end, inputs = forward.output_node(), backward.find_nodes(op="placeholder")
    results = list(end.args[0])
    theirs, saved = results[:outputs], results[outputs:]
    if [node.name for node in saved] != [node.name for node in inputs[: len(saved)]]:
        return  # sizes that vary come first in the one, last in the other
    groups: dict[tuple, list[int]] = defaultdict(list)
    for index, node in enumerate(saved):
        if node not in theirs and _small(node):
            value = node.meta["val"]
            groups[value.dtype, value.device, value.shape].append(index)
    groups = {shape: members for shape, members in groups.items() if len(members) > 1}

    joined, first = [], inputs[0]
    for members in groups.values():
        with forward.inserting_before(end):
            whole = insert_call(forward, torch.ops.aten.cat.default, [saved[index] for index in members])
        joined.append(whole)
        with backward.inserting_before(first):
            given = backward.placeholder(whole.name)
        given.meta["val"] = whole.meta["val"]
        _split(backward, given, [inputs[index] for index in members], after=inputs[-1])
    gone = {index for members in groups.values() for index in members}
    for index in gone:
        backward.erase_node(inputs[index])
    kept = [node for index, node in enumerate(saved) if index not in gone]
    end.args = ((*theirs, *joined, *kept),)
    end.meta["desc"] = end.meta["desc"][: len(end.args[0])]  # they number what is saved


def _small(node: Node) -> bool:
    """Whether what a node computes is a small contiguous tensor. Inputs stay as they are."""
    value = node.meta.get("val")
    if node.op != "call_function" or not isinstance(value, torch.Tensor):
        return False
    return value.ndim > 0 and value.is_contiguous() and value.numel() * value.element_size() < LARGE


def _split(graph: Graph, whole: Node, parts: Sequence[Node], after: Node) -> None:
    """Reads ``parts`` from ``whole`` ``[len(parts) * n, ...]`` wherever they are used."""
    rows = whole.meta["val"].shape[0] // len(parts)
    with graph.inserting_after(after):
        pieces = insert_call(graph, torch.ops.aten.split.Tensor, whole, rows)
    for place, part in reversed(list(enumerate(parts))):
        with graph.inserting_after(pieces):
            piece = insert_call(graph, operator.getitem, pieces, place)
        part.replace_all_uses_with(piece)
