"""A sensor's lasting error. Oracle: quantiles of the normal distribution, and a filter over many steps."""

import pytest
import torch
from scipy.stats import norm
from tensordict import TensorDict

from torch_denkf.applications.car.modules.member_gain import MemberGain


def test_factors_are_lognormal_quantiles_that_stay_with_their_members(float64):
    gain = MemberGain([0.1, 0.3], ensemble_size=50, in_key="y")
    samples = torch.rand(7, 50, 2) + 1
    out = gain(TensorDict({"y": samples}, [7]))["y"].detach()
    factor = (out / samples).log()
    torch.testing.assert_close(factor, factor[:1].expand_as(factor), rtol=0, atol=1e-12)  # the same at all times
    for dim, std in enumerate((0.1, 0.3)):
        quantiles = torch.as_tensor(norm.ppf((torch.arange(50) + 0.5).numpy() / 50))
        expected = std * quantiles / quantiles.square().mean().sqrt()
        expected = expected + expected.neg().exp().mean().log()
        torch.testing.assert_close(factor[0, :, dim].sort().values, expected, rtol=0, atol=1e-12)
        assert float(factor[0, :, dim].std(correction=0)) == pytest.approx(std)
        assert float(factor[0, :, dim].neg().exp().mean()) == pytest.approx(1.0, abs=1e-12)
    # Dimensions are shuffled apart: of 50 pairs, a correlation is 0 +- 0.14.
    assert abs(float(torch.corrcoef(factor[0].T)[0, 1])) < 0.42


def test_an_offset_lasts_and_comes_once_for_each_step_of_a_pair(float64):
    gain = MemberGain([1e-9, 1e-9], ensemble_size=32, offset_std=[0.0, 0.2], in_key="y")
    samples, steps = torch.rand(3, 32, 2), torch.tensor([[1], [0], [3]])
    with torch.no_grad():
        once = gain(TensorDict({"y": samples}, [3]))["y"] - samples
        out = gain(TensorDict({"y": samples, "steps": steps}, [3]))["y"] - samples
    torch.testing.assert_close(out, steps.unsqueeze(-1) * once, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(once[..., 0], torch.zeros(3, 32), rtol=0, atol=1e-7)
    assert float(once[0, :, 1].mean()) == pytest.approx(0.0, abs=1e-8)
    assert float(once[0, :, 1].std(correction=0)) == pytest.approx(0.2, rel=1e-6)
    assert abs(float(torch.corrcoef(torch.stack([gain.quantiles[:, 1], once[0, :, 1]]))[0, 1])) < 0.5  # 0 +- 0.18
    single = TensorDict({"y": samples.float(), "steps": steps.double()}, [3])
    assert gain.float()(single)["y"].dtype == torch.float32
    with pytest.raises(ValueError, match=r"steps must be \[\*B, 1\] = \[3, 1\], got \[3, 32\]"):
        gain(TensorDict({"y": samples, "steps": steps.expand(3, 32)}, [3]))
    with pytest.raises(ValueError, match=r"offset_std must be \[O\] = \[1\]"):
        MemberGain([0.1], offset_std=[0.1, 0.2])
