"""Draws what the property tests need: sizes, scales, precisions, and numbers from a seed; the same in each run."""

import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

#: Drawn the same in each run; a compiled or slow machine does not fail a test.
FIXED = settings(
    derandomize=True, deadline=None, max_examples=40, database=None, suppress_health_check=list(HealthCheck)
)
SEEDS = st.integers(0, 2**31)
BATCHES = st.lists(st.integers(1, 3), max_size=2).map(tuple)
DIMS = st.integers(1, 6)
MEMBERS = st.integers(2, 12)
DTYPES = st.sampled_from([torch.float32, torch.float64])
SCHEMES = st.sampled_from(["sensor", "perturbed", "etkf", "sakov"])
#: Powers of ten: of units that are much too small, usual, much too large.
SCALES = st.integers(-12, 12).map(lambda power: 10.0**power)


class Draw:
    """Random tensors of one seed, float64 unless said otherwise."""

    def __init__(self, seed, dtype=torch.float64):
        self.generator, self.dtype = torch.Generator().manual_seed(seed), dtype

    def normal(self, *shape):
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64).to(self.dtype)

    def uniform(self, *shape):
        return torch.rand(*shape, generator=self.generator, dtype=torch.float64).to(self.dtype)

    def mask(self, *shape):
        return torch.rand(*shape, generator=self.generator) < 0.6

    def covariance(self, *shape):
        root = self.normal(*shape, shape[-1])
        return root @ root.mT + 0.1 * torch.eye(shape[-1], dtype=self.dtype)

    def order(self, size):
        return torch.randperm(size, generator=self.generator)

    def units(self, scale, size):
        """Factors of ``size`` components, around ``scale``."""
        return scale * (0.5 + self.uniform(size))


def close(one, other, rtol=1e-8, atol=1e-8):
    """Equal up to rounding, relative to the largest number of the last dimension."""
    size = other.abs().amax().clamp_min(torch.finfo(other.dtype).tiny)
    torch.testing.assert_close(one / size, other / size, rtol=rtol, atol=atol)
