"""Finds what a step on a GPU must not do: wait for the device, copy to it, or call what no CUDA graph captures."""

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from torch_denkf.functional.kernels import small_system

#: Operators that look at numbers, or that torch computes by routines of MAGMA or on the host.
WAITS = {"cholesky_solve", "cholesky_inverse", "linalg_qr", "linalg_inv_ex", "linalg_cholesky", "linalg_matrix_exp"}
WAITS |= {"_linalg_eigh", "_linalg_svd", "linalg_lu_factor_ex", "_linalg_solve_ex", "_linalg_det", "_linalg_slogdet"}
WAITS |= {"_local_scalar_dense", "nonzero", "is_nonzero", "masked_select", "equal", "_unique2"}
#: Operators that launch nothing.
VIEWS = {"view", "_unsafe_view", "expand", "t", "transpose", "permute", "slice", "select", "unsqueeze", "squeeze"}
VIEWS |= {"detach", "alias", "as_strided", "split", "split_with_sizes", "unbind", "diagonal", "lift_fresh", "unfold"}
VIEWS |= {"empty", "empty_like", "new_empty", "empty_strided", "new_empty_strided", "_reshape_alias", "is_same_size"}
VIEWS |= {"scalar_tensor", "promote_types"}


class _NoLists(TorchFunctionMode):
    """Raises where a list picks components: torch copies it to the device, and waits, before any operator is called."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        if function in (torch.Tensor.__getitem__, torch.Tensor.__setitem__):
            places = args[1] if isinstance(args[1], tuple) else (args[1],)
            lists = [place for place in places if isinstance(place, list)]
            assert not lists or args[0].device.type == "cpu", f"{lists} is copied to the device"
        return function(*args, **(kwargs or {}))


class NothingWaits(TorchDispatchMode):
    """Raises where an operator waits for a device among ``small_system.GPUS``, and where one copies to a device."""

    def __enter__(self):
        self.lists = _NoLists()
        self.lists.__enter__()
        return super().__enter__()

    def __exit__(self, *error):
        self.lists.__exit__(*error)
        return super().__exit__(*error)

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function.overloadpacket.__name__
        there = any(isinstance(value, torch.Tensor) and value.device.type in small_system.GPUS for value in args)
        assert not there or name not in WAITS, f"{function} waits, or is not captured"
        if there and name in ("index", "index_put_", "_index_put_impl_", "index_put"):
            numbers = [value for value in args[1] if value is not None and value.device.type == "cpu"]
            assert args[0].device.type == "cpu" or not numbers, f"{function} copies {numbers} to the device"
        out = function(*args, **(kwargs or {}))
        if name in ("_to_copy", "copy_", "index_put_") and isinstance(out, torch.Tensor) and out.device.type != "cpu":
            moved = [value for value in args if isinstance(value, torch.Tensor) and value.device.type == "cpu"]
            assert not moved, f"{function} copies {moved} to the device"
        return out


class Launches(TorchDispatchMode):
    """Counts the operators that launch something on a GPU, by name."""

    def __init__(self):
        super().__init__()
        self.counts = {}

    @property
    def total(self):
        return sum(self.counts.values())

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function.overloadpacket.__name__
        if name not in VIEWS:
            self.counts[name] = self.counts.get(name, 0) + 1
        return function(*args, **(kwargs or {}))
