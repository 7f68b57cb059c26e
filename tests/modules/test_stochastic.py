"""Oracles: exact expectation over all dropout masks, closed-form variances, torch.distributions.

Monte-Carlo bounds are five standard errors, estimated from the draws themselves.
"""

from itertools import product

import pytest
import torch
from torch.distributions import Normal, kl_divergence
from torch.nn import functional as F

from torch_denkf.modules import StochasticMLP, deterministic
from torch_denkf.modules.stochastic import FlipoutLinear

LAYERS = ["dropout", "flipout"]


def assert_mean(draws, expected):
    """The mean over dimension 0 is within five standard errors of ``expected``."""
    error = draws.mean(0) - expected
    assert (error.abs() < 5 * draws.std(0) / len(draws) ** 0.5).all(), error


class TestDropout:
    def test_expectation_over_all_masks_is_the_deterministic_forward(self, float64):
        # One hidden layer of 6 units: 64 masks, each with its probability. The last layer is linear, so exact.
        net = StochasticMLP(3, 2, (6,), rate=0.25)
        x = torch.randn(3)
        masks = torch.tensor(list(product([False, True], repeat=6)))
        weights = torch.where(masks, 0.75, 0.25).prod(-1)
        outputs = net(x.expand(64, 3), masks)
        torch.testing.assert_close(weights @ outputs, net(x, sample=False), rtol=0, atol=1e-14)

    def test_mean_and_variance_of_draws(self, float64):
        net = StochasticMLP(3, 2, (16,), rate=0.25)
        x = torch.randn(3)
        draws = net(x.expand(100_000, 3)).detach()
        expected, hidden = (value.detach() for value in net(x, sample=False, with_hidden=True))
        assert_mean(draws, expected)
        # Var of a kept-and-rescaled Bernoulli factor is p / (1 - p).
        variance = (net.layers[-1].weight.detach() ** 2 * hidden**2).sum(-1) * 0.25 / 0.75
        assert_mean((draws - expected) ** 2, variance)

    def test_rate_is_the_rounded_one(self):
        # 26/256, not 0.1: the factor has to fit the masks that are drawn, or the mean is biased.
        assert StochasticMLP(3, 2, rate=0.1).rate == 26 / 256

    def test_mask_reaches_the_right_layer(self, float64):
        net = StochasticMLP(2, 1, (3, 4), rate=0.5)
        x, mask = torch.randn(5, 2), torch.rand(5, 7) < 0.5
        first, second, last = net.layers
        hidden = F.relu(first(x)) * mask[:, :3] * 2
        hidden = F.relu(second(hidden)) * mask[:, 3:] * 2
        torch.testing.assert_close(net(x, mask), last(hidden), rtol=0, atol=1e-15)
        torch.testing.assert_close(net(x, mask, with_hidden=True)[1], hidden, rtol=0, atol=1e-15)

    def test_members_are_uncorrelated(self):
        net, x = StochasticMLP(3, 1, (8,), rate=0.3, masks="random"), torch.randn(3)
        with torch.no_grad():
            draws = net(x.expand(20_000, 2, 3), net.draw_noise([20_000], 2)).squeeze(-1)
        assert draws.T.corrcoef()[0, 1].abs() < 5 / 20_000**0.5


class TestFlipout:
    def test_mean_variance_and_correlation_of_rows(self, float64):
        layer = FlipoutLinear(3, 2, posterior_std=0.3)
        with torch.no_grad():
            layer.weight_rho.add_(torch.randn(2, 3))
            layer.bias_rho.add_(torch.randn(2))
            x = torch.randn(2, 3)
            draws = torch.stack([layer(x) for _ in range(10_000)])
            expected = F.linear(x, layer.weight, layer.bias)
            std, bias_std = F.softplus(layer.weight_rho), F.softplus(layer.bias_rho)
            assert_mean(draws, expected)
            # sum_j x_j^2 sigma_ij^2 + sigma_b^2: signs square to one.
            assert_mean((draws - expected) ** 2, x**2 @ (std**2).mT + bias_std**2)
            # Two rows share the perturbation but not the signs: uncorrelated.
            first, second = (draws - expected).unbind(1)
            assert_mean(first.unsqueeze(-1) * second.unsqueeze(-2), torch.zeros(2, 2))

    def test_same_signs_make_rows_of_a_call_share_one_weight_matrix(self, float64):
        layer = FlipoutLinear(3, 2)
        x, signs, eps = torch.randn(4, 3), torch.ones(4, 5, dtype=torch.bool), torch.randn(8)
        weight = layer.weight + F.softplus(layer.weight_rho) * eps[:6].view(2, 3)
        bias = layer.bias + F.softplus(layer.bias_rho) * eps[6:]
        torch.testing.assert_close(layer(x, signs, eps), x @ weight.mT + bias, rtol=0, atol=1e-14)

    @pytest.mark.parametrize("batch", [(4,), (2, 3)])
    def test_each_row_of_a_batch_may_have_its_own_perturbation(self, float64, batch):
        layer = FlipoutLinear(3, 2, posterior_std=0.5)
        x, signs, eps = torch.randn(*batch, 6, 3), torch.rand(*batch, 6, 5) < 0.5, torch.randn(*batch, 8)
        out = layer(x, signs, eps)
        for index in torch.ones(batch).nonzero().tolist():
            row = tuple(index)
            torch.testing.assert_close(out[row], layer(x[row], signs[row], eps[row]), rtol=0, atol=1e-14)
        shared = layer(x, signs, eps[(0,) * len(batch)].expand(*batch, 8))
        torch.testing.assert_close(shared, layer(x, signs, eps[(0,) * len(batch)]), rtol=0, atol=1e-14)

    def test_each_time_of_a_sequence_has_its_own_weights_which_the_batch_shares(self, float64):
        net = StochasticMLP(3, 2, (4,), layer="flipout", posterior_std=0.5)
        noise = net.draw_noise([2, 7], 3, time=True, dtype=torch.float64)
        eps, size = noise["perturbation"], (3 * 4 + 4) + (4 * 2 + 2)
        assert eps.shape == (2, 7, size)
        assert eps.untyped_storage().nbytes() == 8 * 7 * size, "what is shared takes no memory"
        assert eps[0].equal(eps[1])
        assert (eps[0, 1:] != eps[0, :-1]).all()
        x = torch.randn(2, 7, 3, 3)
        out = net(x, noise)
        for t in range(7):  # the sequence, step by step
            step = net(x[:, t], {name: value[:, t] for name, value in noise.items()})
            torch.testing.assert_close(out[:, t], step, rtol=0, atol=1e-13)
        one = net.draw_noise([2, 7], 3, dtype=torch.float64)["perturbation"]
        assert one.equal(one[:1, :1].expand(2, 7, size)), "without time it is one call"

    def test_kl_is_that_of_torch_distributions(self, float64):
        layer = FlipoutLinear(3, 2, posterior_std=0.2, prior_std=0.7)
        with torch.no_grad():
            layer.weight_rho.add_(torch.randn(2, 3))
        prior = Normal(0.0, 0.7)
        expected = sum(
            kl_divergence(Normal(mean, F.softplus(rho)), prior).sum()
            for mean, rho in ((layer.weight, layer.weight_rho), (layer.bias, layer.bias_rho))
        )
        torch.testing.assert_close(layer.kl(), expected, rtol=1e-13, atol=0)

    def test_kl_of_a_network_is_the_sum_over_layers_and_zero_without(self):
        net = StochasticMLP(3, 2, (4,), layer="flipout")
        torch.testing.assert_close(net.kl(), net.layers[0].kl() + net.layers[1].kl())
        assert StochasticMLP(3, 2, (4,), layer="dropout").kl() == 0


@pytest.mark.parametrize("layer", LAYERS)
class TestBothKinds:
    def test_sampling_ignores_train_and_eval(self, layer):
        net, x = StochasticMLP(3, 2, layer=layer), torch.randn(5, 3)
        outputs = {}
        for mode in (True, False):
            net.train(mode)
            torch.manual_seed(1)
            outputs[mode] = net(x)
            assert not net(x).equal(net(x)), "it samples"
            assert net(x, sample=False).equal(net(x, sample=False)), "it does not"
        assert outputs[True].equal(outputs[False])

    def test_noise_given_is_noise_drawn(self, layer):
        net, x = StochasticMLP(3, 2, layer=layer), torch.randn(6, 4, 3)
        torch.manual_seed(1)
        drawn = net(x)
        torch.manual_seed(1)
        noise = net.draw_noise([6, 4])
        assert net(x, noise).equal(drawn)
        assert net(x, noise).equal(net(x, noise))

    def test_deterministic_context(self, layer):
        outer = torch.nn.Sequential(StochasticMLP(3, 2, layer=layer), StochasticMLP(2, 1, layer=layer))
        outer[1].sample = False
        x = torch.randn(4, 3)
        with deterministic(outer):
            inside = outer(x)
        assert inside.equal(outer[1](outer[0](x, sample=False), sample=False))
        assert [net.sample for net in outer] == [True, False]
        with pytest.raises(RuntimeError, match="inside"), deterministic(outer):
            raise RuntimeError("inside")
        assert [net.sample for net in outer] == [True, False]


def test_output_gain():
    torch.manual_seed(1)
    plain = StochasticMLP(3, 2, layer="none")
    torch.manual_seed(1)
    small = StochasticMLP(3, 2, layer="none", output_gain=0.125)
    x = torch.randn(5, 3)
    torch.testing.assert_close(small(x), 0.125 * plain(x))
    assert (StochasticMLP(3, 2, output_gain=0.0)(x) == 0).all()
