"""Oracles: the Kalman update of the same moments, the paper's equations written out, finite differences."""

import math
import shutil

import pytest
import torch

from tests.functional.checks import assert_compiled_is_eager, assert_raises
from torch_denkf.functional import analyse, crps_ensemble, kalman_predict, kalman_update
from torch_denkf.functional.gaussian import gaussian_log_prob
from torch_denkf.functional.inflation import inflate, random_rotation, relax_to_prior_spread
from torch_denkf.functional.moments import ensemble_cov, ensemble_mean
from torch_denkf.functional.scores import energy_score

SCHEMES = ["sensor", "perturbed", "etkf", "sakov"]
SPACES = ["observation", "ensemble"]
# (E, S, O): O < E with E > S; E <= S; O = E; O > E.
SIZES = [(12, 4, 3), (5, 7, 3), (4, 5, 4), (4, 3, 9)]
BATCHES = [(), (3,), (2, 3)]
# Both routes are backward stable and the systems here have condition numbers below 1e4, so round-off
# (1e-16) leaves about 1e-12; 1e-8 is what we promise.
EXACT = {"rtol": 1e-8, "atol": 1e-8}


class Problem:
    """A random linear problem; `options(scheme)` fixes the scheme's random inputs."""

    def __init__(self, size, state_dim, dim, batch=(), *, mask=None, noise=None, dtype=torch.float64, seed=0):
        self.generator = torch.Generator().manual_seed(seed)
        self.forecast = 2 + self.randn(*batch, size, state_dim)
        self.matrix = self.randn(*batch, dim, state_dim)
        self.predicted = self.forecast @ self.matrix.mT
        self.samples = self.randn(*batch, size, dim)
        self.noise = 0.1 + self.randn(*batch, dim).square() if noise is None else torch.full((*batch, dim), noise)
        self.perturbation = self.randn(*batch, size, dim)
        self.observed = None
        if mask == "partial":
            self.observed = torch.rand(*batch, dim, generator=self.generator) < 0.6
        for name, value in vars(self).items():
            if isinstance(value, torch.Tensor) and value.is_floating_point():
                setattr(self, name, value.to(dtype))

    def randn(self, *shape):
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64)

    @property
    def tensors(self):
        return self.forecast, self.predicted, self.samples, self.noise

    def options(self, scheme):
        perturbation = self.perturbation if scheme == "perturbed" else None
        return {"scheme": scheme, "observed": self.observed, "perturbation": perturbation}

    def analyse(self, scheme, **options):
        return analyse(*self.tensors, **{**self.options(scheme), **options})

    def kalman(self):
        moments = ensemble_mean(self.forecast), ensemble_cov(self.forecast)
        return kalman_update(*moments, self.samples.mean(-2), self.matrix, self.noise, observed=self.observed)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("mask", [None, "partial"])
@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("sizes", SIZES)
def test_schemes_reproduce_the_kalman_update(sizes, batch, mask, space):
    problem = Problem(*sizes, batch, mask=mask)
    expected = problem.kalman()
    rotation = random_rotation(sizes[0], batch, generator=problem.generator, dtype=torch.float64)
    for scheme, options in [
        ("etkf", {}),
        ("etkf", {"rotation": rotation}),
        *((name, {}) for name in SCHEMES if name != "etkf"),
    ]:
        result = problem.analyse(scheme, space=space, **options)
        torch.testing.assert_close(ensemble_mean(result.ensemble), expected.mean, **EXACT)
        torch.testing.assert_close(result.innovation, expected.innovation, **EXACT)
        torch.testing.assert_close(result.nis, expected.nis, **EXACT)
        torch.testing.assert_close(result.log_likelihood, expected.log_likelihood, **EXACT)
        if scheme == "etkf":
            torch.testing.assert_close(ensemble_cov(result.ensemble), expected.cov, **EXACT)


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("mask", [None, "partial"])
@pytest.mark.parametrize("sizes", SIZES)
def test_spaces_agree(sizes, mask, scheme):
    problem = Problem(*sizes, (3,), mask=mask)
    first, second = (problem.analyse(scheme, space=space) for space in SPACES)
    automatic = problem.analyse(scheme)
    smaller = first if sizes[2] < sizes[0] else second
    for ours, theirs, chosen, auto in zip(first, second, smaller, automatic, strict=True):
        torch.testing.assert_close(ours, theirs, **EXACT)
        assert torch.equal(chosen, auto)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("sizes", SIZES)
def test_sensor_scheme_is_the_papers_equations(sizes, space):
    size = sizes[0]
    problem = Problem(*sizes)
    x, hx, y = problem.forecast.T, problem.predicted.T, problem.samples.T  # columns are members, as there
    ones = torch.ones(size, dtype=x.dtype)
    ha = hx - torch.outer(hx.sum(1) / size, ones)  # eq. 7
    s = ha @ ha.T / (size - 1) + torch.diag(problem.noise)  # eq. 9
    a = x - torch.outer(x.sum(1) / size, ones)  # eq. 10
    k = a @ ha.T @ torch.linalg.inv(s) / (size - 1)  # eq. 11
    expected = x + k @ (y - hx)  # eq. 12
    result = problem.analyse("sensor", space=space)
    torch.testing.assert_close(result.ensemble, expected.T, **EXACT)

    # The other schemes from the same K: Burgers et al. (centred draws), Sakov & Oke, Bishop et al.
    draws = problem.perturbation - problem.perturbation.mean(0)
    draws = draws * math.sqrt(size / (size - 1)) * problem.noise.sqrt()
    mean = y.mean(1, keepdim=True)
    perturbed = x + k @ (mean + draws.T - hx)
    torch.testing.assert_close(problem.analyse("perturbed", space=space).ensemble, perturbed.T, **EXACT)
    mean_analysis = x.mean(1, keepdim=True) + k @ (mean - hx.mean(1, keepdim=True))
    sakov = mean_analysis + a - k @ ha / 2
    torch.testing.assert_close(problem.analyse("sakov", space=space).ensemble, sakov.T, **EXACT)
    inverse = torch.eye(size) + ha.T @ torch.diag(1 / problem.noise) @ ha / (size - 1)
    values, vectors = torch.linalg.eigh(inverse)
    etkf = mean_analysis + a @ vectors @ torch.diag(values**-0.5) @ vectors.T
    torch.testing.assert_close(problem.analyse("etkf", space=space).ensemble, etkf.T, **EXACT)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize(("scheme", "rotated"), [*((scheme, False) for scheme in SCHEMES), ("etkf", True)])
def test_unobserved_rows_come_back_bit_for_bit(scheme, rotated, space):
    problem = Problem(6, 4, 3, (2,), dtype=torch.float32)
    problem.observed = torch.tensor([[False], [True]])
    problem.samples[0] = torch.nan
    rotation = random_rotation(6, (2,), generator=problem.generator) if rotated else None
    result = problem.analyse(scheme, space=space, rotation=rotation)
    assert torch.equal(result.ensemble[0].view(torch.int32), problem.forecast[0].view(torch.int32))
    assert result.nis[0] == result.log_likelihood[0] == 0
    assert (result.innovation[0] == 0).all()
    assert not torch.isclose(result.ensemble[1], problem.forecast[1]).any()


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("sizes", [(5, 3, 2), (3, 4, 4)])  # E > O + 1: repeated eigenvalues; E <= S, E <= O
@pytest.mark.parametrize("scheme", SCHEMES)
def test_gradients_equal_finite_differences(scheme, sizes, space):
    problem = Problem(*sizes)
    problem.observed = torch.arange(sizes[2]) != 1 if sizes[2] > 2 else None
    inputs = [tensor.requires_grad_() for tensor in problem.tensors]

    def call(*tensors):
        return analyse(*tensors, **problem.options(scheme), space=space)

    assert torch.autograd.gradcheck(call, inputs)


@pytest.mark.parametrize(("dtype", "noise"), [(torch.float64, 1e-8), (torch.float32, 1e-6)])
@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_tiny_noise_gives_finite_gradients(scheme, sizes, dtype, noise):
    problem = Problem(*sizes, noise=noise, dtype=dtype)
    inputs = [tensor.requires_grad_() for tensor in problem.tensors]
    result = problem.analyse(scheme)
    gradients = torch.autograd.grad(sum(value.square().sum() for value in result), inputs)
    assert all(value.isfinite().all() for value in (*result, *gradients))


def test_perturbations_drawn_here_follow_the_seed_and_have_the_noise_variance():
    # One scalar observed with tiny prior weight of the forecast: K = 1 - 1e-6, so members = y + noise.
    size = 20_000
    forecast = 1e3 * torch.randn(size, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    arguments = (forecast, forecast, torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64))
    torch.manual_seed(1)
    first = analyse(*arguments, scheme="perturbed").ensemble
    torch.manual_seed(1)
    assert torch.equal(first, analyse(*arguments, scheme="perturbed").ensemble)
    assert not torch.equal(first, analyse(*arguments, scheme="perturbed").ensemble)
    # The standard error of a sample variance is sqrt(2 / E) = 1 %.
    assert abs(first.var().item() - 1) < 0.03


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_an_indefinite_system_is_nan_and_only_there(scheme, space):
    problem = Problem(6, 4, 3, (2,))
    problem.noise[1] = -1
    result = problem.analyse(scheme, space=space)
    assert result.ensemble[0].isfinite().all()
    assert result.ensemble[1].isnan().all()
    assert result.log_likelihood[1].isnan()


@pytest.mark.parametrize(
    ("sizes", "schemes", "backend"),
    [
        # Observation space and ensemble space, with a square root and without; each scheme's shift in one of them.
        pytest.param((6, 4, 3), ["sensor", "etkf"], "aot_eager", marks=pytest.mark.slow),
        ((3, 4, 5), ["perturbed", "etkf"], "aot_eager"),
        pytest.param((6, 4, 3), SCHEMES, "inductor", marks=pytest.mark.slow),
        pytest.param((3, 4, 5), SCHEMES, "inductor", marks=pytest.mark.slow),
    ],
)
def test_compiled_equals_eager_forward_and_backward(sizes, schemes, backend):
    if backend == "inductor" and shutil.which("g++") is None:
        pytest.skip("inductor needs a C++ compiler, g++")
    problem = Problem(*sizes, (2,), mask="partial")
    inputs = [tensor.requires_grad_() for tensor in problem.tensors]
    transition, noise = 0.9 * torch.eye(sizes[1], dtype=torch.float64), torch.eye(sizes[1], dtype=torch.float64)

    def call(forecast, predicted, samples, variance):  # all in one graph: compiling is what takes the time
        tensors = forecast, predicted, samples, variance
        analyses = [value for scheme in schemes for value in analyse(*tensors, **problem.options(scheme))]
        mean, cov = kalman_predict(ensemble_mean(forecast), ensemble_cov(forecast), transition, noise)
        update = kalman_update(mean, cov, samples.mean(-2), problem.matrix, variance, observed=problem.observed)
        inflated, target = inflate(forecast, 1.1), mean + 1.0
        scores = crps_ensemble(inflated, target), energy_score(inflated, target), gaussian_log_prob(target, *update[:2])
        return [*analyses, *update, *scores, relax_to_prior_spread(forecast, inflated**3, 0.3)]

    assert_compiled_is_eager(call, *inputs, gradients=1e-8, backend=backend, **EXACT)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"forecast": torch.zeros(3)}, r"forecast must be \[\*B, E, S\]"),
        ({"forecast": torch.zeros(1, 2)}, "forecast has E = 1 members"),
        ({"predicted": torch.zeros(4, 3)}, r"predicted must be \[\*B, E, O\] = \[5, 3\], got \[4, 3\]"),
        ({"observation": torch.zeros(2)}, r"observation must be \[\*B, O\] = \[3\], got \[2\]"),
        ({"observation": torch.zeros(3)}, "'sensor' needs one observation per member"),
        ({"observation": torch.zeros(4, 3)}, "got 4 samples; give the sensor the ensemble_size"),
        ({"noise": torch.zeros(1)}, r"noise must be \[\*B, O\]"),
        ({"observed": torch.ones(2, dtype=torch.bool)}, "observed must be"),
        ({"observed": torch.ones(3)}, r"pass observed.bool\(\)"),
        ({"scheme": "enkf"}, 'scheme is "sensor", "perturbed", "etkf" or "sakov"'),
        ({"space": "state"}, 'space is "auto"'),
        ({"perturbation": torch.zeros(5, 3)}, "perturbation is for scheme 'perturbed'"),
        ({"rotation": torch.eye(5)}, "rotation is for scheme 'etkf'"),
        ({"rotation": torch.eye(3), "scheme": "etkf"}, r"rotation must be \[\*B, E, E\]"),
    ],
)
def test_errors_name_the_argument(change, message):
    arguments = {
        "forecast": torch.zeros(5, 2),
        "predicted": torch.zeros(5, 3),
        "observation": torch.zeros(5, 3),
        "noise": torch.ones(3),
    }
    assert_raises(ValueError, message, analyse, **arguments | change)


@pytest.mark.parametrize("scheme", ["sensor", "perturbed", "sakov"])
def test_a_taper_of_blocks_is_one_analysis_for_each_block(scheme):
    problem = Problem(6, 5, 3, (2,), mask="partial")
    state, dim = torch.tensor([0, 0, 1, 1, 2]), torch.tensor([0, 0, 1])  # block 2 is observed by nothing
    taper = ((state[:, None] == dim).double(), (dim[:, None] == dim).double())
    tapered = problem.analyse(scheme, taper=taper)
    torch.testing.assert_close(tapered.ensemble[..., 4], problem.forecast[..., 4], **EXACT)
    nis = 0
    for block in range(2):
        rows, columns = state == block, dim == block
        options = problem.options(scheme)
        options["observed"] = options["observed"][..., columns]
        if scheme == "perturbed":
            options["perturbation"] = options["perturbation"][..., columns]
        parts = [problem.forecast[..., rows], *(value[..., columns] for value in problem.tensors[1:])]
        alone = analyse(*parts, **options)
        torch.testing.assert_close(tapered.ensemble[..., rows], alone.ensemble, **EXACT)
        nis = nis + alone.nis
    torch.testing.assert_close(tapered.nis, nis, **EXACT)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("sizes", SIZES)
def test_a_rotation_multiplies_the_anomalies_from_the_left(sizes, space):
    problem, rotation = Problem(*sizes, (3,)), random_rotation(sizes[0], (3,), dtype=torch.float64)
    assert (rotation - rotation.mT).abs().amax((1, 2)).min() > 0.1, "from the right it would be another one"
    plain, rotated = (problem.analyse("etkf", space=space, **o).ensemble for o in ({}, {"rotation": rotation}))
    mean = plain.mean(-2, keepdim=True)
    torch.testing.assert_close(rotated, mean + rotation @ (plain - mean), **EXACT)
