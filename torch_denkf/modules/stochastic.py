r"""Stochastic layers (the paper's SNN) and the network built from them.

There are two kinds, with the same interface:

* **MC dropout** (Gal & Ghahramani 2016, the paper's section III-A): each hidden unit is dropped with
  probability ``rate``, also at test time. Masks differ between members, so each member has its own network.
* **Flipout** (Wen et al. 2018, the authors' code): weights :math:`W \sim N(\mu, \sigma^2)`; one perturbation
  :math:`\Delta W = \sigma \circ \varepsilon` per call is decorrelated between rows by random signs,
  :math:`y_i = x_i \mu^T + ((x_i \circ s_i) \Delta W^T) \circ r_i`.

Sampling never depends on ``.training`` (torchrl puts transforms in eval mode): ``sample=False`` gives the
deterministic forward, the mean network.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise, repeat
from typing import Literal

import torch
from torch import nn
from torch.nn import functional as F

from torch_denkf._checks import check_choice, check_count, check_number
from torch_denkf.functional.jacobians import jacobian_of_layers
from torch_denkf.functional.kernels.dropped_relu import dropped_relu
from torch_denkf.functional.kernels.random_bits import (
    balanced_bytes,
    dropout_factor,
    random_bytes,
    random_signs,
    representable_rate,
)

__all__ = ["FlipoutLinear", "StochasticMLP", "deterministic"]


#: Replacement of linear layers for sequences, whose steps share their gradients.
LAYERS: list[Callable] = []


class FlipoutLinear(nn.Module):
    r"""A linear layer with Gaussian weights, sampled by flipout.

    Args:
        in_features: size of the input.
        out_features: size of the output.
        posterior_std: initial standard deviation of every weight.
        prior_std: standard deviation of the zero-mean Gaussian prior in :meth:`kl`.

    Shapes:
        input ``[*, in_features]``, output ``[*, out_features]``; ``signs`` bool ``[*, in_features + out_features]``;
        ``perturbation`` ``[out_features * in_features + out_features]``, standard normal, or one for each element of
        a batch, ``[*B, out_features * in_features + out_features]`` with input ``[*B, E, in_features]``.

    Reference:
        Wen, Vicol, Ba, Tran, Grosse, "Flipout: efficient pseudo-independent weight perturbations on
        mini-batches", ICLR 2018, arXiv:1803.04386.

    Example:
        >>> layer = FlipoutLinear(3, 2)
        >>> layer(torch.zeros(5, 3)).shape, layer.kl().item() > 0
        (torch.Size([5, 2]), True)
    """

    def __init__(self, in_features: int, out_features: int, *, posterior_std=0.05, prior_std: float = 1.0):
        super().__init__()
        check_count("in_features", in_features)
        check_count("out_features", out_features)
        check_number("posterior_std", posterior_std, above=0)
        check_number("prior_std", prior_std, above=0)
        self.in_features, self.out_features = in_features, out_features
        self.prior_std = prior_std
        mean = nn.Linear(in_features, out_features)
        self.weight, self.bias = mean.weight, mean.bias
        rho = torch.tensor(posterior_std).expm1().log()  # softplus(rho) = posterior_std
        self.weight_rho = nn.Parameter(rho.expand(out_features, in_features).clone())
        self.bias_rho = nn.Parameter(rho.expand(out_features).clone())

    @property
    def perturbation_size(self) -> int:
        """Returns the number of standard-normal values in one perturbation of the weights."""
        return self.weight.numel() + self.bias.numel()

    def forward(self, x: torch.Tensor, signs=None, perturbation=None, *, sample: bool = True) -> torch.Tensor:
        """Applies the layer; missing noise is drawn. ``sample=False`` uses the mean weights."""
        mean = F.linear(x, self.weight, self.bias)
        if not sample:
            return mean
        if signs is None:
            signs = random_signs((*x.shape[:-1], self.in_features + self.out_features), device=x.device)
        if perturbation is None:
            perturbation = torch.randn(self.perturbation_size, device=x.device, dtype=x.dtype)
        sign_in, sign_out = (signs.to(x.dtype) * 2 - 1).split([self.in_features, self.out_features], -1)
        weight_eps, bias_eps = perturbation.split([self.weight.numel(), self.bias.numel()], -1)
        weight = F.softplus(self.weight_rho) * weight_eps.unflatten(-1, self.weight.shape)
        bias = F.softplus(self.bias_rho) * bias_eps
        if perturbation.ndim == 1:
            return mean + F.linear(x * sign_in, weight, bias) * sign_out
        change = torch.einsum("...ei,...oi->...eo", x * sign_in, weight) + bias.unsqueeze(-2)
        return mean + change * sign_out

    def kl(self) -> torch.Tensor:
        """Returns the KL divergence of the weights' posterior from the prior, in nats, a scalar."""
        total = self.weight.new_zeros(())
        for mean, rho in ((self.weight, self.weight_rho), (self.bias, self.bias_rho)):
            std = F.softplus(rho) / self.prior_std
            total = total + 0.5 * (std**2 + (mean / self.prior_std) ** 2 - 1 - 2 * std.log()).sum()
        return total


class StochasticMLP(nn.Module):
    """A multi-layer perceptron of stochastic layers, the paper's ``SNN`` blocks.

    Args:
        in_features: size of the input.
        out_features: size of the output.
        num_cells: width of each hidden layer; Table I's transition has (32, 32, 64, 64).
        layer: ``"dropout"`` (after each hidden activation, also in evaluation mode), ``"flipout"`` or ``"none"``
            (deterministic, the paper's ``fc``).
        rate: drop probability of a hidden unit (``"dropout"``), rounded to a multiple of 1/256.
        posterior_std: initial standard deviation of the weights (``"flipout"``).
        activation: the non-linearity of hidden layers, ReLU by default.
        output_gain: factor of the last layer's initial weights; with a small one a residual model starts near the
            identity, with zero it is the identity.
        masks: ``"balanced"`` drops each unit in the same share of an ensemble's members, drawn without replacement
            (``"dropout"``): the ensemble's mean is then nearer to that of infinitely many members. ``"random"`` draws
            independently.

    Shapes:
        input ``[*, in_features]``, output ``[*, out_features]``. Noise: for dropout, uint8 random bytes
        ``[*, noise_size]``, of which values of at least ``256 * rate`` keep a unit, or a boolean mask of the units to
        keep; for flipout, a dictionary of ``signs`` bool ``[*, noise_size]`` and ``perturbation`` ``[P]``, one draw for
        all rows, or ``[*B, P]`` with ``x`` ``[*B, E, in_features]``.

    Raises:
        ValueError: if ``layer`` is none of the three, or a number is out of range.

    Example:
        >>> net = StochasticMLP(5, 2)
        >>> x = torch.zeros(32, 5)
        >>> net(x).shape, bool((net(x, sample=False) == net(x, sample=False)).all())
        (torch.Size([32, 2]), True)
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        num_cells: Sequence[int] = (32, 32, 64, 64),
        *,
        layer: Literal["dropout", "flipout", "none"] = "dropout",
        rate: float = 0.1,
        posterior_std: float = 0.05,
        activation: Callable[[], nn.Module] = nn.ReLU,
        output_gain: float = 1.0,
        masks: Literal["balanced", "random"] = "balanced",
    ):
        check_number("posterior_std", posterior_std, above=0)
        super().__init__()
        check_choice("layer", layer, ("dropout", "flipout", "none"))
        check_choice("masks", masks, ("balanced", "random"))
        for name, size in (("in_features", in_features), ("out_features", out_features)):
            check_count(name, size)
        for size in num_cells:
            check_count("num_cells", size, cure=f"These are the widths of the hidden layers: {list(num_cells)}")
        check_number("output_gain", output_gain)
        self.layer, self.rate, self.balanced = layer, representable_rate(rate), masks == "balanced"
        self.sample = True
        sizes = [in_features, *num_cells, out_features]
        self.in_features, self.out_features = in_features, out_features

        def make(n_in: int, n_out: int) -> nn.Linear | FlipoutLinear:
            if layer == "flipout":
                return FlipoutLinear(n_in, n_out, posterior_std=posterior_std)
            return nn.Linear(n_in, n_out)

        layers = [make(n_in, n_out) for n_in, n_out in pairwise(sizes)]
        self.layers = nn.ModuleList(layers)
        self.activation = activation()
        with torch.no_grad():
            layers[-1].weight.mul_(output_gain)
            layers[-1].bias.mul_(output_gain)
        if layer == "dropout":
            self.noise_splits = list(num_cells)
        elif layer == "flipout":
            self.noise_splits = [n_in + n_out for n_in, n_out in pairwise(sizes)]
        else:
            self.noise_splits = []
        #: Number of random bytes (dropout) or signs (flipout) for one row of the input.
        self.noise_size = sum(self.noise_splits)

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Names the noise tensors of one call, see :class:`torch_denkf.modules.SubModel`."""
        if not self.noise_size or not self.sample:
            return ()
        return ("",) if self.layer == "dropout" else ("signs", "perturbation")

    def draw_noise(
        self, batch_size: Sequence[int], *members: int, time: bool = False, device=None, dtype=None, generator=None
    ) -> torch.Tensor | dict[str, torch.Tensor] | None:
        """Draws the noise of one call on rows ``[*batch_size, *members]``, in bulk.

        Args:
            batch_size: batch dimensions (the tensordict's).
            members: event dimensions in front of the features, usually the ensemble size.
            time: whether the last of ``batch_size`` is time. All rows of one time share flipout's perturbation of the
                weights; different times have different ones, as if the sequence ran step by step.
            device: device of the noise.
            dtype: dtype of the flipout perturbation.
            generator: source of randomness; torch's global one by default.

        Returns:
            See the class: bytes, a dictionary, or ``None`` for a deterministic network.
        """
        if not self.noise_size:
            return None
        rows = (*batch_size, *members, self.noise_size)
        if self.layer == "dropout" and members and self.balanced:
            return balanced_bytes(rows[:-2], *rows[-2:], device=device, generator=generator)
        if self.layer == "dropout":
            return random_bytes(rows, device=device, generator=generator)
        size = sum(self._perturbation_sizes())
        times = batch_size[-1:] if time else ()
        perturbation = torch.randn((*times, size), device=device, dtype=dtype, generator=generator)
        signs = random_signs(rows, device=device, generator=generator)
        # Expanded dimensions need no memory.
        return {"signs": signs, "perturbation": perturbation.expand(*batch_size, size)}

    def forward(self, x: torch.Tensor, noise=None, *, sample: bool | None = None, with_hidden: bool = False):
        """Maps ``x`` ``[*, in_features]`` to ``[*, out_features]``; missing noise is drawn.

        Args:
            x: the input.
            noise: see the class.
            sample: whether to draw; ``False`` for the deterministic forward.
            with_hidden: also return the last hidden layer, ``[*, num_cells[-1]]``.
        """
        sample = self.sample if sample is None else sample
        if sample and noise is None and self.noise_size:
            noise = self.draw_noise(x.shape[:-1], device=x.device, dtype=x.dtype)
        run: Sequence[tuple[Callable[..., torch.Tensor], torch.Tensor | None]]
        if self.layer == "flipout":
            run = self._flipout(noise) if sample else [(partial(layer, sample=False), None) for layer in self.layers]
        elif self.layer == "dropout" and sample:
            factors = dropout_factor(noise, self.rate, x.dtype).split(self.noise_splits, -1)
            run = list(zip(self.layers, (*factors, None), strict=True))
        else:
            run = list(zip(self.layers, repeat(None)))
        if LAYERS and not torch.compiler.is_compiling():
            run = [(LAYERS[0](layer), factor) for layer, factor in run]
        hidden, recorded = x, torch.is_grad_enabled()
        for layer, factor in run[:-1]:
            hidden = layer(hidden)
            if factor is None:
                hidden = self.activation(hidden)
            elif isinstance(self.activation, nn.ReLU):
                hidden = dropped_relu(hidden, factor, self.rate) if recorded else (hidden * factor).relu_()
            else:
                hidden = self.activation(hidden) * factor
        out = run[-1][0](hidden)
        return (out, hidden) if with_hidden else out

    def jacobian(self, x: torch.Tensor, size: int) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Returns the mean network's output and its Jacobian by the first ``size`` inputs, ``[*, out_features, size]``.

        It is ``None`` if the activation's derivative is not known, see
        :func:`~torch_denkf.functional.jacobians.jacobian_of_network`.
        """
        layers = [part for layer in self.layers for part in (layer, self.activation)][:-1]
        return jacobian_of_layers(layers, x, size, (nn.Linear, FlipoutLinear))

    def _perturbation_sizes(self) -> list[int]:
        """Returns the number of perturbed weights and biases of each flipout layer."""
        return [layer.perturbation_size for layer in self.layers if isinstance(layer, FlipoutLinear)]

    def _flipout(self, noise: Mapping[str, torch.Tensor]) -> list[tuple[Callable[..., torch.Tensor], None]]:
        perturbation = noise["perturbation"]
        for dim in range(perturbation.ndim - 1):  # rows that share a draw share the product with it
            if perturbation.stride(dim) == 0 or perturbation.shape[dim] == 1:
                perturbation = perturbation.narrow(dim, 0, 1)
        if perturbation.numel() == perturbation.shape[-1]:
            perturbation = perturbation.flatten()
        signs = noise["signs"].split(self.noise_splits, -1)
        perturbations = perturbation.split(self._perturbation_sizes(), -1)
        return [
            (partial(layer, signs=sign, perturbation=eps), None)
            for layer, sign, eps in zip(self.layers, signs, perturbations, strict=True)
        ]

    def kl(self) -> torch.Tensor:
        """Returns the KL divergence of the weights from their prior, in nats; zero for layers without a prior."""
        zero = next(self.layers.parameters()).new_zeros(())
        return sum((layer.kl() for layer in self.layers if isinstance(layer, FlipoutLinear)), zero)


class deterministic:
    """Context manager in which every :class:`StochasticMLP` inside ``module`` runs its deterministic forward.

    Example:
        >>> net = StochasticMLP(5, 2)
        >>> with deterministic(net):
        ...     same = bool((net(torch.ones(5)) == net(torch.ones(5))).all())
        >>> same, net.sample
        (True, True)
    """

    def __init__(self, module: nn.Module):
        self.networks = [part for part in module.modules() if isinstance(part, StochasticMLP)]

    def __enter__(self) -> None:
        self.before = [network.sample for network in self.networks]
        for network in self.networks:
            network.sample = False

    def __exit__(self, *exc_info) -> None:
        for network, sample in zip(self.networks, self.before, strict=True):
            network.sample = sample
