"""Writes out small matrix products of a compiled step, whose call takes longer than their arithmetic.

A product of small matrices takes a microsecond, plus two for the library call. Inductor fuses written-out products with
the operations before and after.
"""

from __future__ import annotations

from typing import Any

import torch
from torch._inductor.custom_graph_pass import CustomGraphPass, get_hash_for_files
from torch.fx import Graph, Node, map_arg

__all__ = ["FewCalls", "insert_call"]

aten = torch.ops.aten

#: Largest number of multiplications per matrix of a batch for inductor's loop (measured: 128 and 320).
SMALL = 1024
#: Largest number of rows, and of multiplications, of a written-out product with one matrix.
FEW_ROWS, SMALL_OF_ROWS = 8, 2**15


class FewCalls(CustomGraphPass):
    """Applied last to each graph, forward and backward: see :func:`part_bias` and :func:`write_out_products`."""

    def __call__(self, graph: Graph) -> None:
        """Changes ``graph`` in place."""
        part_bias(graph)
        write_out_products(graph)

    def uuid(self) -> bytes:
        """Identifies the pass in inductor's cache."""
        return get_hash_for_files((__file__,))


def part_bias(graph: Graph) -> None:
    """Adds the bias of a linear layer after the product, in the kernel of the activation.

    The library's product with bias first copies the bias to every row of its result. Batched products with a sum are
    also split, so that the product can be written out.
    """
    for node in graph.find_nodes(op="call_function", target=aten.baddbmm.default):
        (other, left, right), factors = node.args, node.kwargs
        with graph.inserting_before(node):
            product = insert_call(graph, aten.bmm.default, left, right)
            if factors.get("beta", 1) != 1:
                other = insert_call(graph, aten.mul.Tensor, other, factors["beta"])
            if factors.get("alpha", 1) != 1:
                product = insert_call(graph, aten.mul.Tensor, product, factors["alpha"])
            _replace(graph, node, insert_call(graph, aten.add.Tensor, other, product))
    for node in graph.find_nodes(op="call_function", target=aten.addmm.default):
        bias, x, weight = node.args
        if bias.meta["val"].ndim == 1 and not node.kwargs:  # factors other than 1
            with graph.inserting_before(node):
                product = insert_call(graph, aten.mm.default, x, weight)
                _replace(graph, node, insert_call(graph, aten.add.Tensor, product, bias))


def write_out_products(graph: Graph) -> None:
    """Writes products of tiny matrices, and of few rows with a matrix, as sums of products.

    The former are covariances of two observed components, in batches; the latter are layers of a network for one robot.
    """
    for target in (aten.bmm.default, aten.mm.default):
        for node in graph.find_nodes(op="call_function", target=target):
            left, right = node.args
            *batch, rows, inner = left.meta["val"].shape
            multiplications = rows * inner * right.meta["val"].shape[-1]
            limit = SMALL if batch or rows > FEW_ROWS else SMALL_OF_ROWS
            if multiplications <= limit:
                with graph.inserting_before(node):
                    left = insert_call(graph, aten.unsqueeze.default, left, len(batch) + 2)
                    right = insert_call(graph, aten.unsqueeze.default, right, len(batch))
                    products = insert_call(graph, aten.mul.Tensor, left, right)
                    _replace(graph, node, insert_call(graph, aten.sum.dim_IntList, products, [len(batch) + 1]))


def insert_call(graph: Graph, function: Any, *args: Any) -> Node:
    """Inserts a node that calls ``function``, with the shape of its result."""
    node = graph.call_function(function, args)
    node.meta["val"] = function(*map_arg(args, lambda argument: argument.meta["val"]))
    return node


def _replace(graph: Graph, old: Node, new: Node) -> None:
    old.replace_all_uses_with(new)
    graph.erase_node(old)
