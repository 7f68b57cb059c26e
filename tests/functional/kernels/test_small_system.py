"""Oracle: torch.linalg on the same systems, values and gradients."""

import pytest
import torch

from torch_denkf.functional.kernels.small_system import (
    LARGEST,
    LARGEST_ELIMINATED,
    LARGEST_FACTOR,
    WrittenOut,
    made_once,
)
from torch_denkf.functional.linalg import Solver, cholesky


def solutions(gram, cross, shift, mean_shift):
    system = WrittenOut(gram, ridge=1)
    return system.between(shift, cross), system.square(mean_shift.mT), system.log_det()


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

    ours, theirs = solutions(*inputs), oracle(*inputs)
    for value, expected in zip(ours, theirs, strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-12, atol=1e-12)
    seeds = [torch.randn_like(value) for value in ours]
    gradients = [torch.autograd.grad(values, inputs, seeds, retain_graph=True) for values in (ours, theirs)]
    # Of G we read the lower triangle, linalg the whole: only the symmetric part of the gradient has a meaning.
    for value, expected in zip(*gradients, strict=True):
        symmetric = value.shape[-2:] == (size, size) and value is gradients[0][0]
        value, expected = (x + x.mT if symmetric else x for x in (value, expected))
        torch.testing.assert_close(value, expected, rtol=1e-11, atol=1e-11)


def test_indefinite_matrices_give_nan_in_their_row_only(float64):
    gram, cross, shift, mean_shift = systems(2)
    gram[1] = torch.tensor([[-3.0, 0.0], [0.0, 1.0]])
    for value in solutions(gram, cross, shift, mean_shift):
        assert value[1].isnan().all()
        assert value[[0, 2]].isfinite().all()


@pytest.mark.parametrize("size", range(1, LARGEST_FACTOR + 1))
def test_the_factor_and_its_gradient_are_those_of_linalg(float64, size):
    matrix = (systems(size)[0] + torch.eye(size)).requires_grad_()
    ours, theirs = WrittenOut(matrix).factor(), torch.linalg.cholesky(matrix)
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)
    seed = torch.randn_like(ours).tril()
    gradients = [torch.autograd.grad(value, matrix, seed)[0] for value in (ours, theirs)]
    torch.testing.assert_close(*(x + x.mT for x in gradients), rtol=1e-10, atol=1e-10)  # see above


@pytest.mark.parametrize("size", [LARGEST_FACTOR + 1, LARGEST_ELIMINATED, LARGEST_ELIMINATED + 1])
def test_a_compiler_sees_a_system_eliminated_with_the_values_and_gradients_of_linalg(float64, monkeypatch, size):
    gram, cross, shift, _ = systems(size)
    matrix = (gram + torch.eye(size)).requires_grad_()
    expected = [shift @ torch.linalg.solve(matrix, cross), matrix.logdet().unsqueeze(-1)]
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    monkeypatch.setattr(torch.linalg, "cholesky_ex", None if size <= LARGEST_ELIMINATED else torch.linalg.cholesky_ex)
    solver = Solver(matrix)
    ours = [solver.between(shift, cross), solver.log_det()]
    for value, wanted in zip(ours, expected, strict=True):
        torch.testing.assert_close(value, wanted, rtol=1e-10, atol=1e-10)
    gradients = [torch.autograd.grad(sum(value.sum() for value in found), matrix)[0] for found in (ours, expected)]
    torch.testing.assert_close(*(x + x.mT for x in gradients), rtol=1e-8, atol=1e-8)  # see above
    matrix.data[1] *= -1
    assert Solver(matrix).log_det()[:, 0].isnan().tolist() == [False, True, False]


@pytest.mark.parametrize("place", range(3))
def test_a_matrix_without_a_factor_is_nan_and_alone(float64, place):
    matrix = torch.eye(3).repeat(2, 1, 1)
    matrix[1, place, place] = -1
    factor = WrittenOut(matrix).factor()
    assert torch.equal(factor[0], torch.eye(3))
    assert factor[1].isnan().all()
    torch.testing.assert_close(factor, cholesky(matrix), equal_nan=True)


def test_a_constant_that_is_made_under_a_transform_is_no_part_of_it():
    make = lambda: torch.as_tensor([2.0, 3.0])  # noqa: E731
    jacobian = torch.func.jacfwd(lambda x: x * made_once(("test", "jacfwd"), make))
    torch.testing.assert_close(jacobian(torch.ones(2)), torch.diag(torch.tensor([2.0, 3.0])))
    kept = made_once(("test", "jacfwd"), make)
    assert kept.data_ptr()  # a wrapper of the transform would have none
    torch.testing.assert_close(kept, torch.tensor([2.0, 3.0]))


def test_a_constant_of_inference_mode_may_meet_gradients():
    """The first call, of which the constant is, may be one without gradients; inference tensors cannot be saved."""
    with torch.inference_mode():
        made = made_once("test of inference mode", lambda: torch.eye(2))
    assert made_once("test of inference mode", torch.empty) is made
    weight = torch.ones(2, 2, requires_grad=True)
    (weight * made).sum().backward()
    assert weight.grad.equal(torch.eye(2))
