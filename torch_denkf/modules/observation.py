r"""Observation models: predicted observations :math:`H X_{t|t-1} = [h_\psi(x^1), \dots, h_\psi(x^E)]` (eq. 6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey
from torch import nn

from torch_denkf.functional.jacobians import jacobian_of_network
from torch_denkf.functional.linalg import product_of_known
from torch_denkf.modules.tensors import check_dims, register_location_and_scale, register_matrix
from torch_denkf.modules.transition import MemberNetwork
from torch_denkf.submodel import SubModel

__all__ = ["LearnedObservation", "LinearObservation", "Select"]


class LearnedObservation(MemberNetwork):
    """A learned observation model, deterministic as in Table I (``fc`` layers) or stochastic.

    Args:
        network: maps ``[*, S]`` to ``[*, O]``, e.g. ``StochasticMLP(S, O, layer="none")``; a stochastic network draws
            for each member.
        loc: mean of each state dimension ``[S]``; the network reads standardised states.
        scale: standard deviation of each state dimension ``[S]``.
        in_key: ensemble to observe ``[*B, E, S]``.
        out_key: predicted observations ``[*B, E, O]``.

    Example:
        >>> from tensordict import TensorDict
        >>> h = LearnedObservation(nn.Linear(5, 2))
        >>> h(TensorDict({("forecast", "ensemble"): torch.zeros(32, 5)}))["forecast", "observation"].shape
        torch.Size([32, 2])
    """

    def __init__(
        self,
        network: Callable[..., torch.Tensor],
        *,
        loc: torch.Tensor | Sequence[float] | None = None,
        scale: torch.Tensor | Sequence[float] | None = None,
        in_key: NestedKey = ("forecast", "ensemble"),
        out_key: NestedKey = ("forecast", "observation"),
    ):
        super().__init__(network, [in_key], [out_key])
        register_location_and_scale(self, loc, scale)

    def observe(self, state: torch.Tensor) -> torch.Tensor:
        """Returns the mean network's observation of states ``[*, S]``, as ``[*, O]``."""
        return self.compute(state, noise=None)

    def compute(self, ensemble, *, noise):
        """Returns the predicted observations."""
        return self._run(self.features(ensemble), noise)

    def features(self, state: torch.Tensor) -> torch.Tensor:
        """Returns the network's inputs, ``[*, S]``."""
        state = state if self.loc is None else state - self.loc
        return state if self.scale is None else state / self.scale

    def jacobian(self, state):
        """Returns the network's Jacobian with respect to states in their own units."""
        found = jacobian_of_network(self.module, self.features(state), state.shape[-1])
        return found if found is None or self.scale is None else (found[0], found[1] / self.scale)


class Select(SubModel):
    """Known observation of single state dimensions, e.g. the velocities of [x, y, theta, v, theta_dot].

    Args:
        dims: indices of the observed dimensions, in the observation's order.
        in_key: ensemble to observe ``[*B, E, S]``.
        out_key: predicted observations ``[*B, E, len(dims)]``.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({("forecast", "ensemble"): torch.tensor([[0.0, 1.0, 2.0, 3.0, 4.0]])})
        >>> Select([3, 4])(td)["forecast", "observation"].tolist()
        [[3.0, 4.0]]
    """

    def __init__(
        self,
        dims: Sequence[int],
        *,
        in_key: NestedKey = ("forecast", "ensemble"),
        out_key: NestedKey = ("forecast", "observation"),
    ):
        super().__init__(nn.Identity(), [in_key], [out_key])
        check_dims("dims", dims)
        self.register_buffer("dims", torch.tensor(list(dims)), persistent=False)

    def observe(self, state: torch.Tensor) -> torch.Tensor:
        """Returns the selected dimensions of states ``[*, S]``."""
        # Not index_select: inductor (torch 2.13) sums the rows of its Jacobian.
        return state.gather(-1, self.dims.expand(*state.shape[:-1], -1))

    def compute(self, ensemble):
        """Returns the predicted observations of all members."""
        return self.observe(ensemble)

    def jacobian(self, state):
        """Returns rows of the identity."""
        places = torch.arange(state.shape[-1], device=state.device)
        return self.observe(state), (self.dims.unsqueeze(-1) == places).to(state.dtype)


class LinearObservation(SubModel):
    """Known linear observation, ``y = H x``.

    Args:
        matrix: H, ``[O, S]``.
        in_key: ensemble to observe ``[*B, E, S]``.
        out_key: predicted observations ``[*B, E, O]``.

    Example:
        >>> from tensordict import TensorDict
        >>> sums = LinearObservation(torch.ones(1, 3))
        >>> sums(TensorDict({("forecast", "ensemble"): torch.ones(8, 3)}))["forecast", "observation"][0]
        tensor([3.])
    """

    def __init__(
        self,
        matrix: torch.Tensor | Sequence[Sequence[float]],
        *,
        in_key: NestedKey = ("forecast", "ensemble"),
        out_key: NestedKey = ("forecast", "observation"),
    ):
        super().__init__(nn.Identity(), [in_key], [out_key])
        register_matrix(self, "matrix", matrix, "[O, S]")

    def observe(self, state: torch.Tensor) -> torch.Tensor:
        """Returns ``H x`` for states ``[*, S]``; NaN for rows that use a dimension that is NaN."""
        return product_of_known(self.matrix, state)

    def compute(self, ensemble):
        """Returns the predicted observations."""
        return ensemble @ self.matrix.mT

    def jacobian(self, state):
        """Returns H."""
        return self.compute(state), self.matrix
