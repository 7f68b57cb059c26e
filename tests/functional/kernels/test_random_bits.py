"""Oracles: the binomial distribution. Bounds are five standard deviations: one seed in a million would miss one."""

import pytest
import torch

from torch_denkf.functional.kernels.random_bits import dropout_factor, random_bytes, random_signs, representable_rate


def binomial_bound(n, p):
    return 5 * (n * p * (1 - p)) ** 0.5


@pytest.mark.parametrize(
    ("rate", "numerator"), [(0.0, 0), (0.1, 26), (0.25, 64), (0.5, 128), (1 / 512 + 1e-9, 1), (0.9999, 255)]
)
def test_rate_is_rounded_to_a_byte(rate, numerator):
    assert representable_rate(rate) == numerator / 256


@pytest.mark.parametrize("rate", [0.1, 0.25, 0.5, 0.9])
def test_keep_rate_in_every_byte_of_a_word(rate):
    words = 200_000
    kept = (random_bytes((words, 8)) >= 256 * representable_rate(rate)).sum(0)
    keep = 1 - representable_rate(rate)
    assert ((kept - words * keep).abs() < binomial_bound(words, keep)).all()


def test_neighbours_are_independent():
    # Under independence the product of two neighbours is Bernoulli(keep^2).
    n, keep = 400_001, 0.75
    mask = random_bytes((n,)) >= 64
    both = (mask[1:] & mask[:-1]).sum()
    # Overlapping pairs are correlated; each shares a bit with two others, so the variance is at most trebled.
    assert abs(both - (n - 1) * keep**2) < 3**0.5 * binomial_bound(n - 1, keep**2)


def test_generator_repeats_and_leaves_the_global_one_alone():
    before = torch.get_rng_state()
    draws = [random_bytes((999,), generator=torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    assert draws[0].equal(draws[1])
    assert not draws[0].equal(draws[2])
    assert torch.get_rng_state().equal(before)


def test_signs_are_fair():
    n = 400_000
    assert abs(random_signs((n,)).sum() - n / 2) < binomial_bound(n, 0.5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_dropout_factor_of_every_byte_at_every_rate(dtype):
    draws = torch.arange(256, dtype=torch.uint8)
    for numerator in range(256):
        rate = numerator / 256
        kept = torch.tensor(1 / (1 - rate), dtype=dtype)  # exactly this, and exactly zero
        expected = torch.where(torch.arange(256) >= numerator, kept, 0)
        assert dropout_factor(draws, rate, dtype).equal(expected), rate
        assert dropout_factor(torch.arange(256) >= numerator, rate, dtype).equal(expected), rate
