"""Oracles: the defining equations of the matrix functions, and finite differences."""

import pytest
import torch

from torch_denkf.functional import cholesky, inverse_square_root, inverse_square_root_difference

# Eigenvalues with repetitions, zeros, and eight decades between them.
SPECTRA = [[0.0, 0.0, 0.0, 0.0], [2.0, 2.0, 0.0, 0.0], [1e6, 1.0, 1.0, 1e-2], [3.0, 2.0, 1.0, 0.5]]


def matrix_with(spectrum):
    generator = torch.Generator().manual_seed(0)
    orthogonal = torch.linalg.qr(torch.randn(4, 4, generator=generator, dtype=torch.float64)).Q
    return orthogonal @ torch.diag(torch.tensor(spectrum, dtype=torch.float64)) @ orthogonal.T


@pytest.mark.parametrize("spectrum", SPECTRA)
def test_matrix_functions_satisfy_their_definitions(spectrum):
    matrix, identity = matrix_with(spectrum), torch.eye(4, dtype=torch.float64)
    root, difference = inverse_square_root(matrix), inverse_square_root_difference(matrix)
    # Round-off 1e-16 times the norm of the matrix, 1e6 at most.
    torch.testing.assert_close(root @ (identity + matrix) @ root, identity, rtol=0, atol=1e-9)
    torch.testing.assert_close(identity + matrix @ difference, root, rtol=0, atol=1e-9)
    assert torch.linalg.eigvalsh(root).min() > 0  # the positive root, there is only one
    torch.testing.assert_close(root, root.mT)


@pytest.mark.parametrize("function", [inverse_square_root, inverse_square_root_difference])
@pytest.mark.parametrize("spectrum", [[4.0, 4.0, 4.0, 4.0], [2.0, 2.0, 1.0, 1.0], [3.0, 2.0, 1.0, 0.5]])
def test_gradients_equal_finite_differences_at_repeated_eigenvalues(function, spectrum):
    matrix = torch.stack([matrix_with(spectrum), matrix_with(SPECTRA[3])]).requires_grad_()
    assert torch.autograd.gradcheck(lambda m: function((m + m.mT) / 2), matrix)


@pytest.mark.parametrize("function", [inverse_square_root, inverse_square_root_difference])
def test_second_derivatives_raise_instead_of_being_wrong(function):
    matrix = matrix_with(SPECTRA[3]).requires_grad_()
    (gradient,) = torch.autograd.grad(function(matrix).square().sum(), matrix, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_cholesky_fails_loudly_and_only_where_it_fails():
    good = matrix_with(SPECTRA[3])
    factor = cholesky(torch.stack([good, -good]))
    assert torch.equal(factor[0], torch.linalg.cholesky(good))
    assert factor[1].isnan().all()
