"""The filter of dm_control's reacher: hidden joint velocities from noisy encoders."""

from __future__ import annotations

from dataclasses import dataclass

from torch_denkf._checks import check_number
from torch_denkf.filters import DEnKF
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, FromSensor, LearnedTransition, Select, StochasticMLP

__all__ = ["ReacherFilter", "ReacherSettings", "reacher"]


@dataclass(frozen=True)
class ReacherSettings:
    """Settings of a :class:`ReacherFilter`.

    Attributes:
        encoder_std: standard deviation of the encoders' noise, in rad.
        state_mean: mean of [q1 rad, q2 rad, w1 rad/s, w2 rad/s] over the training episodes.
        state_std: standard deviation, likewise.
        num_cells: hidden layers of the transition.
        ensemble_size: number of members, E.
    """

    encoder_std: float = 0.05
    state_mean: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    state_std: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    num_cells: tuple[int, ...] = (64, 64)
    ensemble_size: int = 32

    def __post_init__(self):
        check_number("encoder_std", self.encoder_std, above=0)


class ReacherFilter(DEnKF):
    """A DEnKF for the two joints of dm_control's reacher, built by :func:`reacher`.

    It reads ``"encoder"`` ``[*B, 2]``, noisy joint angles in rad, and ``"action"`` ``[*B, 2]``. The state is [q1 rad,
    q2 rad, w1 rad/s, w2 rad/s]; its dynamics are learned.

    Args:
        settings: sizes and constants.

    Attributes:
        builder: name of the function that builds it, in a saved folder.
        settings: sizes and constants.
    """

    builder = "reacher"

    def __init__(self, settings: ReacherSettings):
        s = settings
        super().__init__(
            transition=LearnedTransition(
                StochasticMLP(4 + 2, 4, s.num_cells, output_gain=0.1),
                loc=s.state_mean,
                scale=s.state_std,
                action_key="action",
            ),
            sensor=None,  # the encoders are read as they are
            observation=Select([0, 1]),
            noise=ConstantNoise([s.encoder_std, s.encoder_std], in_key="encoder"),
            analysis=EnsembleAnalysis("etkf", observation_key="encoder"),
            initial=FromSensor(
                [0, 1],
                mean=[0.0] * 4,
                std=[1.0, 1.0, 0.5, 0.5],
                observation_key="encoder",
                ensemble_size=s.ensemble_size,
            ),
        )
        self.settings = settings


def reacher(**settings) -> ReacherFilter:
    """Returns a DEnKF for dm_control's reacher, untrained.

    Args:
        **settings: those of :class:`ReacherSettings`.

    Raises:
        TypeError: on a name that is no setting.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"encoder": torch.zeros(3, 6, 2), "action": torch.zeros(3, 6, 2)}, [3, 6])
        >>> reacher(ensemble_size=8).sequence(data)["belief", "mean"].shape
        torch.Size([3, 6, 4])
    """
    return ReacherFilter(ReacherSettings(**settings))
