"""Tests how loops are bundled into functions: short ones, which all steps share; the oracle is the eager function."""

import pytest
import torch
from torch._inductor.utils import run_and_get_code

from tests.filters.factories import has_compiler
from torch_denkf.compilation import options_for_processors


@pytest.fixture
def layers():
    torch.manual_seed(0)
    return [(torch.randn(8, 8) / 4, torch.randn(8)) for _ in range(2)]


def steps(x, layers, count):
    for _ in range(count):
        for weight, bias in layers:
            x = torch.relu(x @ weight.mT + bias)
    return x


def compiled(count, *arguments):
    """Returns the result of a number of compiled steps, and how many functions of C++ they need."""
    torch._dynamo.reset()
    function = torch.compile(lambda *args: steps(*args, count), options=options_for_processors(), fullgraph=True)
    with torch.no_grad():
        out, code = run_and_get_code(function, *arguments)
    return out, code[0].count("\nvoid ") + code[0].count('extern "C"  void')


@pytest.mark.slow
@pytest.mark.skipif(not has_compiler(), reason="inductor needs a C++ compiler, g++")
def test_twice_the_steps_need_no_more_functions(layers):
    x = torch.randn(1, 8)
    few, functions = compiled(2, x, layers)
    many, functions_of_many = compiled(4, x, layers)
    assert functions_of_many == functions >= len(layers)
    torch.testing.assert_close(few, steps(x, layers, 2))
    torch.testing.assert_close(many, steps(x, layers, 4))
