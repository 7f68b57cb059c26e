"""Linear-Gaussian system as an environment, for which the Kalman filter is the exact solution."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Composite, Unbounded

from torch_denkf._arguments import Checked
from torch_denkf._checks import check_count, check_number, check_shape, check_square, check_values
from torch_denkf.envs._seeded import SeededEnv

__all__ = ["LinearGaussianEnv"]


def _constant(name: str, value: torch.Tensor | Sequence) -> torch.Tensor:
    try:
        constant = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name} must be numbers, in a tensor or in lists of one length; got {value!r}") from error
    if constant.is_complex():
        raise TypeError(f"{name} must be real; got {constant.dtype}. Real and imaginary parts are two components each")
    constant = constant.to(torch.get_default_dtype())
    check_values(name, constant)
    return constant


class LinearGaussianEnv(Checked, SeededEnv):
    r"""Simulates :math:`x_{t+1} = F x_t + B a_t + N(0, Q)`, :math:`y_t = H x_t + N(0, R)`.

    Observations are ``"state"`` ``[*B, S]`` (ground truth), ``"observation"`` ``[*B, O]`` and ``"observed"`` ``[*B,
    1]``; missing readings are NaN. The ``"action"`` is ``[*B, A]``; without ``control`` it has no effect.

    Args:
        transition: F, ``[S, S]``.
        observation: H, ``[O, S]``.
        transition_std: standard deviations of Q's diagonal, ``[S]``.
        observation_std: standard deviations of R's diagonal, ``[O]``.
        control: B, ``[S, A]``; by default one action without effect.
        initial_std: standard deviation of the initial state, ``[S]``; one by default.
        missing: probability that a reading is missing.
        max_steps: length of an episode, a number or one for each row of the batch.
        batch_size: ``*B``.
        seed: seed of the environment's generator.

    Example:
        >>> env = LinearGaussianEnv(torch.eye(2), torch.eye(2), [0.1, 0.1], [1.0, 1.0], batch_size=[3])
        >>> env.rollout(5)["next", "observation"].shape
        torch.Size([3, 5, 2])
    """

    def __init__(
        self,
        transition: torch.Tensor,
        observation: torch.Tensor,
        transition_std: Sequence[float],
        observation_std: Sequence[float],
        *,
        control: torch.Tensor | None = None,
        initial_std: Sequence[float] | None = None,
        missing: float = 0.0,
        max_steps: int | Sequence[int] = 100,
        batch_size: Sequence[int] = (),
        seed: int = 0,
        device: torch.device | str | None = None,
    ):
        for count in batch_size:
            check_count("batch_size, each number,", count, least=0)
        super().__init__(batch_size=torch.Size(batch_size), device=device)
        dtype = torch.get_default_dtype()
        F, H = _constant("transition", transition), _constant("observation", observation)
        check_square("transition", F)
        state_dim, observation_dim = len(F), len(H)
        check_shape("observation", H, (observation_dim, state_dim), "[O, S]")
        for name, std, size in (
            ("transition_std", transition_std, state_dim),
            ("observation_std", observation_std, observation_dim),
            ("initial_std", initial_std, state_dim),
        ):
            if std is not None:
                vector = _constant(name, std)
                check_shape(name, vector, (size,), f"[{name[0].upper()}]")
                check_values(name, vector, least=0)
        if control is not None:
            matrix = _constant("control", control)
            check_shape("control", matrix, (state_dim, matrix.shape[-1] if matrix.ndim else 0), "[S, A]")
        check_number("missing", missing, least=0, most=1)
        for steps in [max_steps] if isinstance(max_steps, (int, float, str)) else list(max_steps):
            check_count("max_steps", steps if isinstance(steps, (int, float, str)) else int(steps))
        constants = {
            "F": F,
            "H": H,
            "B": torch.zeros(state_dim, 1) if control is None else torch.as_tensor(control, dtype=dtype),
            "transition_std": torch.as_tensor(transition_std, dtype=dtype),
            "observation_std": torch.as_tensor(observation_std, dtype=dtype),
            "initial_std": torch.ones(state_dim) if initial_std is None else torch.as_tensor(initial_std, dtype=dtype),
            "max_steps": torch.as_tensor(max_steps).expand(self.batch_size),
        }
        for name, value in constants.items():  # buffers move with the environment
            self.register_buffer(name, value if device is None else value.to(device), persistent=False)
        self.missing = missing
        shape = self.batch_size
        self.observation_spec = Composite(
            state=Unbounded((*shape, state_dim), dtype=dtype),
            observation=Unbounded((*shape, observation_dim), dtype=dtype),
            observed=Binary(shape=(*shape, 1), dtype=torch.bool),
            step=Unbounded((*shape, 1), dtype=torch.int64),
            shape=shape,
        )
        self.state_spec = Composite({key: self.observation_spec[key].clone() for key in ("state", "step")}, shape=shape)
        self.action_spec = Unbounded((*shape, self.B.shape[1]), dtype=dtype)
        self.reward_spec = Unbounded((*shape, 1))
        flag = Binary(shape=(*shape, 1), dtype=torch.bool)
        self.full_done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape)
        self._set_seed(seed)

    def _randn(self, like: torch.Tensor, size: int) -> torch.Tensor:
        return torch.randn(*self.batch_size, size, dtype=like.dtype, **self._source(like))

    def _emit(self, state: torch.Tensor, step: torch.Tensor) -> TensorDict:
        reading = state @ self.H.mT + self.observation_std * self._randn(state, self.H.shape[0])
        observed = torch.rand(*self.batch_size, 1, **self._source(state)) >= self.missing
        reading = torch.where(observed, reading, torch.nan)
        entries = {"state": state, "observation": reading, "observed": observed, "step": step}
        truncated = step >= self.max_steps.unsqueeze(-1)
        entries.update(truncated=truncated, terminated=torch.zeros_like(truncated), done=truncated)
        return TensorDict(entries, self.batch_size, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        state = self.initial_std * self._randn(self.initial_std, self.F.shape[0])
        return self._emit(state, state.new_zeros(*self.batch_size, 1, dtype=torch.int64))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        state, action = tensordict["state"], tensordict["action"]
        noise = self.transition_std * self._randn(state, state.shape[-1])
        out = self._emit(state @ self.F.mT + action @ self.B.mT + noise, tensordict["step"] + 1)
        return out.set("reward", state.new_zeros(*self.batch_size, 1, dtype=self.reward_spec.dtype))
