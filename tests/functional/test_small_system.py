"""Oracle: torch.linalg on the same systems, values and gradients."""

import pytest
import torch

from torch_denkf.functional._small_system import LARGEST, solve_written_out


def systems(size, batch=(3,)):
    root = torch.randn(*batch, size, size + 1)
    return root @ root.mT, torch.randn(*batch, size, 5), torch.randn(*batch, 6, size), torch.randn(*batch, 1, size)


@pytest.mark.parametrize("size", range(1, LARGEST + 1))
def test_solution_and_gradients_are_those_of_linalg(float64, size):
    inputs = [value.requires_grad_() for value in systems(size)]

    def oracle(gram, cross, shift, mean_shift):
        matrix = gram + torch.eye(size)
        square = (mean_shift @ torch.linalg.solve(matrix, mean_shift.mT)).squeeze(-1)
        return shift @ torch.linalg.solve(matrix, cross), square, matrix.logdet().unsqueeze(-1)

    ours, theirs = solve_written_out(*inputs), oracle(*inputs)
    for value, expected in zip(ours, theirs, strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-12, atol=1e-12)
    seeds = [torch.randn_like(value) for value in ours]
    gradients = [torch.autograd.grad(values, inputs, seeds, retain_graph=True) for values in (ours, theirs)]
    # Of G we read the lower triangle, linalg the whole: only the symmetric part of the gradient has a meaning.
    for value, expected in zip(*gradients, strict=True):
        symmetric = value.shape[-2:] == (size, size) and value is gradients[0][0]
        value, expected = (x + x.mT if symmetric else x for x in (value, expected))
        torch.testing.assert_close(value, expected, rtol=1e-11, atol=1e-11)


def test_what_is_not_positive_definite_is_nan_and_alone(float64):
    gram, cross, shift, mean_shift = systems(2)
    gram[1] = torch.tensor([[-3.0, 0.0], [0.0, 1.0]])
    for value in solve_written_out(gram, cross, shift, mean_shift):
        assert value[1].isnan().all()
        assert value[[0, 2]].isfinite().all()
