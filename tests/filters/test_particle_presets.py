"""The presets are made of the parts they say, parts that are set already are kept, and clones move along."""

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import OBS, M, NoisyLinear, assert_equal, linear_system, toy_frames
from tests.filters.particle_for_tests import BELIEF, bootstrap, toy_parts
from torch_denkf.filters import DPF, MixtureParticleFilter, ParticleFilter
from torch_denkf.modules import (
    ConstantNoise,
    DiagonalNoise,
    GaussianLikelihood,
    LearnedLikelihood,
    LinearObservation,
    NoisyTransition,
)


def test_dpf():
    parts = toy_parts()
    noisy = parts.pop("transition")
    filter = DPF(
        noisy.module["transition"],
        likelihood=LearnedLikelihood(M, OBS, num_cells=(8,), encoding_key="measurement"),
        motion_noise=noisy.module["noise"],
        noisy_dims=[0, 2],
        **parts,
    )
    assert filter["transition"].scheme == "systematic"
    assert isinstance(filter["transition"].module, NoisyTransition)
    assert filter["transition"].module.before
    assert "noise" not in dict(filter.module.named_children())
    out = filter.sequence(toy_frames((3, 6)))
    out["belief", "mean"].square().sum().backward()
    for part in (filter["transition"], filter["likelihood"], filter["observation"]):
        assert any(p.grad is not None and p.grad.any() for p in part.parameters())


@pytest.mark.parametrize("learned", [False, True])
def test_pfm(learned):
    likelihood = LearnedLikelihood(M, OBS, bound="clipped", encoding_key="measurement") if learned else None
    filter = MixtureParticleFilter(
        **toy_parts(), noise=None if learned else DiagonalNoise(OBS), learned_likelihood=likelihood
    )
    assert (filter["transition"].scheme, filter["transition"].alpha) == ("soft", 0.05)
    assert isinstance(filter["likelihood"], LearnedLikelihood if learned else GaussianLikelihood)
    out = filter.sequence(toy_frames((3, 6)))
    out["belief", "mean"].square().sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in filter.parameters())
    with pytest.raises(ValueError, match="its Gaussian likelihood, or a learned_likelihood"):
        MixtureParticleFilter(**toy_parts())


@pytest.mark.parametrize("preset", [ParticleFilter, MixtureParticleFilter])
def test_a_raw_reading_is_read_where_the_key_says(float64, preset):
    """Against the filter whose likelihood names the reading: the same belief, bit for bit."""
    F, Q, H, R = linear_system()
    scheme = "soft" if preset is MixtureParticleFilter else "systematic"
    expected = bootstrap(50, resampling=scheme, observed_key="up")
    motion = NoisyLinear(F, torch.linalg.cholesky(Q))
    noise = ConstantNoise(R.sqrt(), in_key="observation")
    options = {"initial": expected.initial, "observed_key": "up"}
    found = preset(motion, None, LinearObservation(H), noise=noise, observation_key="observation", **options)
    td = TensorDict({"observation": torch.randn(3, 9, 2), "up": torch.rand(3, 9, 2) < 0.7}, [3, 9])
    td = expected.draw_noise(td)
    assert_equal(found.sequence(td.copy()), expected.sequence(td.copy()), BELIEF)

    with pytest.raises(ValueError, match="pass the key of the reading: observation_key="):
        preset(motion, None, LinearObservation(H), noise=noise, **options)
