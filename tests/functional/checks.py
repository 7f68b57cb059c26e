"""Checks that many tests share: a function raises, and it compiles."""

import pytest
import torch


def assert_raises(error, words, call, /, *args, **kwargs):
    """``call(*args, **kwargs)`` raises ``error``, and its message holds ``words``, a regular expression."""
    with pytest.raises(error, match=words):
        call(*args, **kwargs)


def assert_compiled_is_eager(function, *inputs, gradients=False, rtol=None, atol=None, backend="aot_eager", **options):
    """``function`` is one graph, and one more for gradients of the inputs that ask for any, with the eager numbers.

    "aot_eager" traces forward and backward, which is what breaks if anything does; the kernels are the same.
    """
    eager = function(*inputs, **options)
    compiled = torch.compile(function, fullgraph=True, backend=backend)(*inputs, **options)
    torch.testing.assert_close(compiled, eager, rtol=rtol, atol=atol)
    if gradients:
        leaves = [value for value in inputs if value.requires_grad]
        both = [torch.autograd.grad(sum(v.square().sum() for v in out), leaves) for out in (compiled, eager)]
        torch.testing.assert_close(*both, rtol=gradients, atol=gradients)
