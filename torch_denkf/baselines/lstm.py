"""An LSTM as a filter: the baseline without models of motion, observation or noise."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase

from torch_denkf.baselines.lstm_cell import LSTMTransition, LSTMUpdate, with_memory
from torch_denkf.filters.base import Filter
from torch_denkf.filters.options import FilterOptions
from torch_denkf.filters.parts import check_moments
from torch_denkf.modules.kalman import MomentPrior
from torch_denkf.submodel import SubModel

__all__ = ["LSTMFilter"]


class LSTMFilter(Filter):
    """A recurrent network that reads a sensor's outputs and writes a Gaussian belief.

    Its belief is ``("belief", "mean")`` ``[*B, S]``, ``("belief", "cov")`` (diagonal unless ``motion`` is given) and
    ``("belief", "var")``, and its memory ``("belief", "hidden")`` and ``("belief", "cell")`` ``[*B, num_layers,
    hidden_size]``; resets, steps, sequences, masks and primer are those of every filter. Train it with
    :class:`~torch_denkf.objectives.GaussianLoss` and ``transition=0``: it has no forecast, and no innovation.

    Args:
        sensor: writes the encoding, or the reading, or both; ``None`` if the tensordict has them. For a fair
            comparison, use the *same* sensor as the other filter.
        features: size of the encoding at ``encoding_key``; 0 if the LSTM does not read it.
        state_dim: S.
        motion: a module that writes the belief from the last one, under ``"forecast"``, and the velocities that the
            LSTM estimates, ``("velocity", "mean")`` and ``("velocity", "cov")``; it has ``velocity_dim``, their number;
            e.g. :class:`~torch_denkf.applications.car.modules.unicycle_pose.UnicyclePose` for a car. ``None``: the LSTM
            estimates the whole state.
        initial: the belief at reset, a mean and a covariance, e.g. :class:`~torch_denkf.modules.GaussianAround`; by
            default ``N(loc, scale²)``, which is not possible with ``motion``.
        loc: mean of the LSTM's outputs, ``[S]``, or one per velocity with ``motion``; zero by default.
        scale: standard deviation of the outputs; one by default.
        hidden_size: of each layer.
        num_layers: number of layers.
        observation_dim: O, if the LSTM reads ``observation_key``.
        encoding_key: the sensor's encoding ``[*B, features]``; ``None`` for none.
        observation_key: readings ``[*B, O]``, or learned observations ``[*B, E, O]``, whose mean is used; read if
            ``observation_dim`` is given.
        control_keys: see :class:`Filter`; give the action's key in ``extra_keys``, too.
        init_key: see :class:`Filter`.
        update_at_reset: see :class:`Filter`; not with ``motion``: no motion leads to the first frame.
        **kwargs: passed on to :class:`~torch_denkf.baselines.lstm_cell.LSTMUpdate`: ``extra_keys`` and
            ``extra_features``, ``floor``, ``observation_loc``, ``observation_scale``, ``observed_key``; and
            ``variance_ceiling``, ``check_finite`` and ``prefix`` of :class:`Filter`.

    Raises:
        ValueError: if there is a ``motion`` and no ``initial``, or ``update_at_reset``.

    Reference:
        The LSTM baselines of Haarnoja et al. 2016, arXiv:1605.07148, and Kloss, Martius & Bohg 2021,
        arXiv:2012.14313.

    Example:
        >>> from tensordict import TensorDict
        >>> lstm = LSTMFilter(None, features=16, state_dim=3, encoding_key="features")
        >>> lstm.sequence(TensorDict({"features": torch.randn(4, 10, 16)}, [4, 10]))["belief", "mean"].shape
        torch.Size([4, 10, 3])
    """

    def __init__(
        self,
        sensor: TensorDictModuleBase | None,
        *,
        features: int = 0,
        state_dim: int,
        motion: SubModel | None = None,
        initial: TensorDictModuleBase | None = None,
        loc: Sequence[float] | torch.Tensor | None = None,
        scale: Sequence[float] | torch.Tensor | None = None,
        hidden_size: int = 128,
        num_layers: int = 1,
        observation_dim: int = 0,
        encoding_key: NestedKey = ("sensor", "encoding"),
        observation_key: NestedKey = ("sensor", "ensemble"),
        control_keys: Sequence[NestedKey] = ("action",),
        init_key: NestedKey = "is_init",
        update_at_reset: bool = False,
        **kwargs,
    ):
        if motion is not None and (initial is None or update_at_reset):
            raise ValueError(
                "With motion= the state is known at reset and not updated there: give initial=, such as "
                f"GaussianAround(...), and not update_at_reset; got initial={initial}, "
                f"update_at_reset={update_at_reset}."
            )
        options = {name: kwargs.pop(name) for name in FilterOptions.__annotations__ if name in kwargs}
        update = LSTMUpdate(
            state_dim if motion is None else motion.velocity_dim,
            features=features,
            observation_dim=observation_dim,
            hidden_size=hidden_size,
            num_layers=num_layers,
            loc=loc,
            scale=scale,
            encoding_key=encoding_key if features else None,
            observation_key=observation_key if observation_dim else None,
            belief_prefix="belief" if motion is None else "velocity",
            **kwargs,
        )
        if initial is None:
            initial = MomentPrior(update.loc, update.scale.square().diag())
        check_moments(type(self).__name__, initial)
        modules = OrderedDict(sensor=sensor) if sensor is not None else OrderedDict()
        modules.update(transition=LSTMTransition(), lstm=update)
        if motion is not None:
            modules["motion"] = motion
        super().__init__(
            modules,
            initial=with_memory(initial, hidden_size, num_layers=num_layers),
            control_keys=control_keys,
            init_key=init_key,
            update_at_reset=update_at_reset,
            **options,
        )
