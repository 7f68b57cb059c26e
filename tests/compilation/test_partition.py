"""Fewer saved tensors: the oracle is eager autograd, and the default partitioner for how many there are."""

import pytest
import torch
from functorch.compile import nop
from torch._dynamo.backends.common import aot_autograd
from torch._inductor import config
from torch._inductor.compile_fx import partition_fn
from torch._inductor.decomposition import select_decomp_table

from torch_denkf.compilation import partition as _partition
from torch_denkf.compilation.partition import FewSavedTensors


def compiled(function, partitioner=None):
    """Returns the function through all that inductor does before it writes code, which alone needs a C++ compiler."""
    torch._dynamo.reset()

    def split(*args, **fields):
        with config.patch(custom_partitioner_fn=partitioner):
            return partition_fn(*args, **fields)

    stages = {"fw_compiler": nop, "bw_compiler": nop, "partition_fn": split}
    backend = aot_autograd(**stages, decompositions=select_decomp_table())
    return torch.compile(function, backend=backend, fullgraph=True, dynamic=False)


def steps(x: torch.Tensor, w: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Six steps, the second of which is also a result."""
    outputs = []
    for _ in range(6):
        x = torch.tanh(x @ w).sin() + x
        outputs.append(x)
    return x, outputs[1]


def run(function, shape, dtype):
    """Returns gradients of weights and input, and the shapes of all that was saved for them."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(shape, generator=generator, dtype=dtype).requires_grad_()
    w = (0.3 * torch.randn(shape[-1], shape[-1], generator=generator, dtype=dtype)).requires_grad_()
    saved: list[tuple[int, ...]] = []

    def pack(value):
        saved.append(tuple(value.shape))
        return value

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda value: value):
        last, second = function(x, w)
    return torch.autograd.grad(last.square().sum() + second.sum(), (x, w)), saved


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_small_tensors_go_as_one_and_gradients_stay(dtype):
    shape = (4, 5)
    expected, _ = run(steps, shape, dtype)
    theirs, many = run(compiled(steps), shape, dtype)
    ours, few = run(compiled(steps, FewSavedTensors()), shape, dtype)
    assert sum(saved == shape for saved in many) >= 6
    assert sum(saved == shape for saved in few) <= 2  # the input, and the step that is also a result
    joined = [saved for saved in few if saved[0] >= 5 * shape[0]]
    assert len(joined) == 1
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    for value, other, eager in zip(ours, theirs, expected, strict=True):
        torch.testing.assert_close(value, eager, rtol=tolerance, atol=tolerance)
        torch.testing.assert_close(value, other, rtol=tolerance, atol=tolerance)


def layers(x: torch.Tensor, first, bias, second, third) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns five steps through a layer with bias and a second one; a third sees what the first one does."""
    outputs = []
    for _ in range(5):
        hidden = torch.nn.functional.linear(x, first, bias).relu()
        x = x + torch.sin(torch.nn.functional.linear(hidden, second)) + 0.1 * x @ third
        outputs.append(x)
    return x, outputs[1]


def run_layers(function, rows):
    """Returns gradients of the input, the weights and the bias."""
    generator = torch.Generator().manual_seed(0)
    shapes = ((2, rows, 4), (4, 4), (4,), (4, 4), (4, 4))
    args = [torch.randn(shape, generator=generator, dtype=torch.float64).mul(0.3).requires_grad_() for shape in shapes]
    last, early = function(*args)
    return torch.autograd.grad(last.square().sum() + early.sum(), args)


@pytest.mark.parametrize("rows", [3, 2000])
def test_the_gradient_of_a_weight_is_one_product(monkeypatch, rows):
    """Steps of few rows are joined, steps of many are not; the gradients are eager's."""
    products: list[tuple[int, int]] = []
    join = _partition.join_products

    def count(graph):
        return len(graph.find_nodes(op="call_function", target=torch.ops.aten.mm.default))

    def spy(graph, sums):
        before = count(graph)
        join(graph, sums)
        products.append((before, count(graph)))

    monkeypatch.setattr(_partition, "join_products", spy)
    function = compiled(layers, FewSavedTensors())
    gradients = run_layers(function, rows)
    ((before, after),) = products
    assert before - after == (3 * 4 if rows == 3 else 0)  # three layers, five steps each
    for value, eager in zip(gradients, run_layers(layers, rows), strict=True):
        torch.testing.assert_close(value, eager, rtol=1e-11, atol=1e-11 * eager.abs().max().item())
