"""Partition of a chunk into forward and backward for torch.compile, with few saved tensors.

A step of small networks saves two dozen small tensors for its backward pass. Each has an overhead of a few
microseconds: an allocation, a Python object, and autograd's records. So tensors of the same shape are concatenated. The
inputs of a layer in all steps of a chunk are then one matrix, and the gradient of its weights is one product.
"""

from __future__ import annotations

import operator
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch._functorch import config
from torch._functorch.partitioners import min_cut_rematerialization_partition
from torch._inductor.custom_graph_pass import CustomPartitionerFn, get_hash_for_files
from torch.fx import Graph, GraphModule, Node

from torch_denkf.compilation.kernels import insert_call

__all__ = ["FewSavedTensors"]

aten = torch.ops.aten

#: Bytes from which a tensor is not concatenated, as copying it costs about as much as the overhead.
LARGE = 2**15


class FewSavedTensors(CustomPartitionerFn):
    """The default partitioner of inductor; then :func:`join_saved` and :func:`join_products`."""

    def __call__(self, gm: GraphModule, joint_inputs: Sequence[object], **fields: Any) -> tuple[GraphModule, ...]:
        """Splits a joint graph; ``fields`` are the default partitioner's."""
        with config.patch(recompute_views=True):  # views are cheap to recompute, but not to save
            forward, backward = min_cut_rematerialization_partition(gm, joint_inputs, **fields)
        sums = _sums_of_products(backward.graph)
        layer = {_viewed(product.args[1]): root for root, products in sums.items() for product in products}
        join_saved(forward.graph, backward.graph, fields["num_fwd_outputs"], layer)
        join_products(backward.graph, sums)
        for module in (forward, backward):
            module.graph.lint()
            module.recompile()
        return forward, backward

    def uuid(self) -> bytes:
        """Identifies the pass in inductor's cache."""
        return get_hash_for_files((__file__,))


def join_saved(forward: Graph, backward: Graph, outputs: int, kinds: Mapping[Node, Any]) -> None:
    """Concatenates saved tensors of one shape, type and kind in the forward graph; the backward graph splits them.

    Args:
        forward: its results are ``outputs`` values for the caller, then the saved ones.
        backward: its inputs begin with the saved ones, in the same order.
        outputs: number of values for the caller.
        kinds: groups of inputs of the backward graph; one group by default.
    """
    end, inputs = forward.output_node(), backward.find_nodes(op="placeholder")
    results = list(end.args[0])
    theirs, saved = results[:outputs], results[outputs:]
    if [node.name for node in saved] != [node.name for node in inputs[: len(saved)]]:
        return  # dynamic sizes are ordered differently in the two graphs
    groups: dict[tuple, list[int]] = defaultdict(list)
    for index, node in enumerate(saved):
        if node not in theirs and node.op == "call_function" and _small(node):
            value = node.meta["val"]
            groups[value.dtype, value.device, value.shape, kinds.get(inputs[index])].append(index)

    joined, gone = [], set()
    for members in groups.values():
        if len(members) > 1:
            with forward.inserting_before(end):
                whole = insert_call(forward, aten.cat.default, [saved[index] for index in members])
            with backward.inserting_before(inputs[0]):
                given = backward.placeholder(whole.name)
            given.meta["val"] = whole.meta["val"]
            _split(backward, given, [inputs[index] for index in members], after=inputs[-1])
            joined.append(whole)
            gone.update(members)
    for index in gone:
        backward.erase_node(inputs[index])
    kept = [node for index, node in enumerate(saved) if index not in gone]
    end.args = ((*theirs, *joined, *kept),)
    end.meta["desc"] = end.meta["desc"][: len(end.args[0])]  # descriptions number the saved tensors


def join_products(graph: Graph, sums: Mapping[Node, Sequence[Node]]) -> None:
    """Writes the gradient of a weight, sum of g_t' x_t over the steps, as G' X, and that of its bias as a sum over G.

    Args:
        graph: of the backward pass.
        sums: products in each sum.
    """
    end, rows = graph.output_node(), {}
    for root, products in sums.items():
        whole, products = _in_order_of_one_input(products)
        gradients = [product.args[0].args[0] for product in products]
        with graph.inserting_before(end):
            stacked = rows[tuple(sorted(gradients))] = insert_call(graph, aten.cat.default, gradients)
            if whole is None:
                x = insert_call(graph, aten.cat.default, [product.args[1] for product in products])
            else:
                x = insert_call(graph, aten.reshape.default, whole, [-1, products[0].args[1].meta["val"].shape[1]])
            transposed = insert_call(graph, aten.permute.default, stacked, [1, 0])
            root.replace_all_uses_with(insert_call(graph, aten.mm.default, transposed, x))
    for root in end.all_input_nodes:
        sources = [_viewed(term) for term in _terms(root)]
        if all(source.target is aten.sum.dim_IntList and source.args[1:] == ([0], True) for source in sources):
            stacked = rows.get(tuple(sorted(source.args[0] for source in sources)))
            if stacked is not None and root.meta["val"].ndim == 1:
                with graph.inserting_before(end):
                    root.replace_all_uses_with(insert_call(graph, aten.sum.dim_IntList, stacked, [0]))
    graph.eliminate_dead_code()


def _sums_of_products(graph: Graph) -> dict[Node, list[Node]]:
    """Returns results of the graph that are sums of several g' x, both small."""
    sums = {}
    for root in graph.output_node().all_input_nodes:
        terms = _terms(root)
        if len(terms) > 1 and all(map(_is_weight_gradient, terms)):
            sums[root] = terms
    return sums


def _is_weight_gradient(node: Node) -> bool:
    if node.target is not aten.mm.default:
        return False
    left, right = node.args
    return left.target is aten.permute.default and left.args[1] == [1, 0] and _small(left.args[0]) and _small(right)


def _terms(node: Node) -> list[Node]:
    """Lists the terms of a sum, through additions with a single user."""
    parts = node.args if node.target is aten.add.Tensor and not node.kwargs and len(node.users) == 1 else ()
    if parts and all(isinstance(part, Node) for part in parts):
        return [term for part in parts for term in _terms(part)]
    return [node]


def _viewed(node: Node) -> Node:
    """Returns the base node of a view or reshape."""
    while node.target in (aten.view.default, aten.reshape.default):
        node = node.args[0]
    return node


def _in_order_of_one_input(products: Sequence[Node]) -> tuple[Node | None, list[Node]]:
    """Returns the tensor whose split gives the right factors of ``products``, if any, and these in its order."""
    pieces = [_viewed(product.args[1]) for product in products]
    if any(piece.target is not operator.getitem for piece in pieces):
        return None, list(products)
    split = pieces[0].args[0]
    if len(set(pieces)) < len(pieces) or set(pieces) != set(split.users):  # the split has other users, too
        return None, list(products)
    order = sorted(range(len(pieces)), key=lambda index: pieces[index].args[1])
    return split.args[0], [products[index] for index in order]


def _small(node: Node) -> bool:
    """Returns True if a node computes a small contiguous tensor."""
    value = node.meta.get("val")
    if not isinstance(value, torch.Tensor) or not value.ndim:
        return False
    return value.is_contiguous() and value.numel() * value.element_size() < LARGE


def _split(graph: Graph, whole: Node, parts: Sequence[Node], after: Node) -> None:
    """Reads ``parts`` from ``whole`` ``[len(parts) * n, ...]`` wherever they are used."""
    rows = whole.meta["val"].shape[0] // len(parts)
    with graph.inserting_after(after):
        pieces = insert_call(graph, aten.split.Tensor, whole, rows)
    for place, part in reversed(list(enumerate(parts))):
        with graph.inserting_after(pieces):
            piece = insert_call(graph, operator.getitem, pieces, place)
        part.replace_all_uses_with(piece)
