"""What many tests ask of a function: that it refuses, that it compiles, how much memory it takes."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class Shapes(TorchDispatchMode):
    """Remembers the shapes of all tensors that operations return with storage of their own."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        known = {t.untyped_storage().data_ptr() for t in tree_leaves((args, kwargs)) if torch.is_tensor(t)}
        for tensor in tree_leaves(out):
            if torch.is_tensor(tensor) and tensor.untyped_storage().data_ptr() not in known:
                self.seen.append(tensor.shape)
        return out


def assert_refused(error, words, call, /, *args, **kwargs):
    """``call(*args, **kwargs)`` raises ``error``, and its message holds ``words``, a regular expression."""
    with pytest.raises(error, match=words):
        call(*args, **kwargs)


def assert_compiled_is_eager(function, *inputs, gradients=False, rtol=None, atol=None, **options):
    """``function`` is one graph, and one more for gradients of the inputs that ask for any, with the eager numbers.

    "aot_eager" traces forward and backward, which is what breaks if anything does; the kernels are the same.
    """
    eager = function(*inputs, **options)
    compiled = torch.compile(function, fullgraph=True, backend="aot_eager")(*inputs, **options)
    torch.testing.assert_close(compiled, eager, rtol=rtol, atol=atol)
    if gradients:
        leaves = [value for value in inputs if value.requires_grad]
        both = [torch.autograd.grad(sum(v.square().sum() for v in out), leaves) for out in (compiled, eager)]
        torch.testing.assert_close(*both, rtol=gradients, atol=gradients)
