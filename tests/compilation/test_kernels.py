"""Passes over graphs of kernels: the oracle is the same function, traced and not changed."""

import pytest
import torch
from torch.fx.experimental.proxy_tensor import make_fx

from torch_denkf.compilation.kernels import FEW_ROWS, FewCalls

aten = torch.ops.aten


def changed(function, *args):
    """Returns the function as a graph of aten calls, after the passes; and what is called in it."""
    module = make_fx(function, tracing_mode="fake")(*args)
    FewCalls()(module.graph)
    module.graph.lint()
    module.recompile()
    return module, [node.target for node in module.graph.nodes if node.op == "call_function"]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_bias_is_added_after_the_product(dtype):
    torch.manual_seed(0)
    x, weight, bias = (torch.randn(shape, dtype=dtype) for shape in ((64, 16), (16, 8), (8,)))
    module, calls = changed(torch.addmm, bias, x, weight)
    assert calls == [aten.mm.default, aten.add.Tensor]
    torch.testing.assert_close(module(bias, x, weight), bias + x @ weight)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(2, 32, 5), (1, 1, 1), (2, 1, 7)])
def test_tiny_products_are_written_out(shape, dtype):
    torch.manual_seed(0)
    rows, inner, columns = shape
    left, right = torch.randn(3, inner, rows, dtype=dtype), torch.randn(3, inner, columns, dtype=dtype)
    module, calls = changed(lambda a, b: a.mT @ b, left, right)
    assert aten.bmm.default not in calls
    assert aten.sum.dim_IntList in calls
    torch.testing.assert_close(module(left, right), torch.einsum("bir,bic->brc", left, right))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rows", [1, FEW_ROWS])
def test_products_of_few_rows_are_written_out(rows, dtype):
    torch.manual_seed(0)
    x, weight = torch.randn(rows, 64, dtype=dtype), torch.randn(48, 64, dtype=dtype)
    module, calls = changed(lambda a, b: a @ b.mT, x, weight)
    assert aten.mm.default not in calls
    assert aten.sum.dim_IntList in calls
    torch.testing.assert_close(module(x, weight), torch.einsum("ri,ci->rc", x, weight))
