"""The filter of the UR5 table: joints, gripper and tool from one camera's images and the joints' targets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from torch_denkf.filters import DEnKF
from torch_denkf.modules import (
    DiagonalNoise,
    EnsembleAnalysis,
    GaussianPrior,
    ImageSensor,
    KeypointTrunk,
    LearnedTransition,
    Select,
    StochasticMLP,
)

__all__ = ["UR5TableFilter", "UR5TableSettings", "ur5_table"]

STATE, JOINTS = 10, 7  # J1..J6 rad, the gripper's opening rad, x, y, z m; the action is the targets of the first seven
_STEP = 0.05  # rad: a usual way of a joint in a step


@dataclass(frozen=True)
class UR5TableSettings:
    """Settings of a :class:`UR5TableFilter`.

    Attributes:
        pixels: height and width of the images.
        state_mean: mean of the state over the training demos, ``[10]``.
        state_std: standard deviation of the state over them, ``[10]``.
        pixel_mean: mean of red, green and blue over them, in [0, 1].
        pixel_std: standard deviation of them.
        sensor_std: error of the sensor before the filter is trained, ``[10]``.
        channels: of the sensor's convolutions.
        keypoints: number of channels of the spatial soft-argmax.
        features: width of the trunk's output.
        pooled: rows and columns of the coarse view.
        num_cells: hidden layers of the sensor's head and of the transition.
        ensemble_size: number of members, E.
        inflation: factor on the belief's spread in each step, chosen on validation demos.
        threshold: of localisation by significance, in standard deviations; ``None`` for none.
    """

    pixels: int = 64
    state_mean: tuple[float, ...] = (0.0,) * STATE
    state_std: tuple[float, ...] = (1.0,) * STATE
    pixel_mean: tuple[float, ...] = (0.5,) * 3
    pixel_std: tuple[float, ...] = (0.25,) * 3
    sensor_std: tuple[float, ...] = (0.1,) * JOINTS + (0.02,) * 3
    channels: tuple[int, ...] = (16, 32, 48, 64)
    keypoints: int = 32
    features: int = 96
    pooled: int = 4
    num_cells: tuple[int, ...] = (64, 64)
    ensemble_size: int = 64
    inflation: float = 1.0
    threshold: float | None = None


class UR5TableFilter(DEnKF):
    """A DEnKF for :class:`torch_denkf.applications.ur5.UR5TableEnv`, built by :func:`ur5_table`.

    It reads ``"pixels"`` ``[*B, 3, 64, 64]`` and ``"action"`` ``[*B, 7]``, the joints' targets in rad. The state is
    that of the environment: J1..J6 rad, the gripper's opening rad, x, y, z m. Motion and kinematics are learned.

    Args:
        settings: sizes and constants.

    Attributes:
        builder: name of the function that builds it, in a saved folder.
    """

    builder = "ur5-table"

    def __init__(self, settings: UR5TableSettings):
        s = settings
        sensor = ImageSensor(
            STATE,
            image_shape=(3, s.pixels, s.pixels),
            ensemble_size=s.ensemble_size,
            trunk=KeypointTrunk(3, s.channels, s.keypoints, s.features, s.pooled),
            num_cells=s.num_cells,
            layer="flipout",
            loc=s.state_mean,
            scale=s.state_std,
            pixel_loc=s.pixel_mean,
            pixel_scale=s.pixel_std,
            encoding_key=("sensor", "encoding"),
        )
        analysis = EnsembleAnalysis("sensor")
        if s.threshold is not None:
            analysis = EnsembleAnalysis("sensor", localisation="significance", threshold=s.threshold)
        analysis.inflation = s.inflation
        super().__init__(
            transition=_ArmTransition(s),
            sensor=sensor,
            observation=Select(range(STATE)),
            noise=DiagonalNoise(STATE, r=s.sensor_std, in_features=s.num_cells[-1], in_key=("sensor", "encoding")),
            analysis=analysis,
            initial=GaussianPrior(s.state_mean, s.state_std, ensemble_size=s.ensemble_size),
            update_at_reset=True,
        )
        self._settings = settings

    @property
    def settings(self) -> UR5TableSettings:
        """Returns the settings, with the current inflation."""
        return replace(self._settings, inflation=self.inflation)

    @property
    def inflation(self) -> float:
        """Returns the factor on the belief's spread in each step."""
        return self["analysis"].inflation

    @inflation.setter
    def inflation(self, factor: float) -> None:
        self["analysis"].inflation = factor


class _ArmTransition(LearnedTransition):
    """Transition with each joint's distance to its target as input, instead of the target."""

    def __init__(self, settings: UR5TableSettings):
        s = settings
        scale = [_STEP] * JOINTS + [0.02] * 3  # of changes
        super().__init__(
            StochasticMLP(STATE + JOINTS, STATE, s.num_cells, layer="flipout", output_gain=0.1),
            loc=s.state_mean,
            scale=s.state_std,
            action_key="action",
        )
        self.register_buffer("change", torch.tensor(scale))

    def compute(self, state, action=None, dt=None, *, noise):
        """Returns the forecast ensemble: joints approach their targets, plus the network's output."""
        way = action.to(state.dtype).unsqueeze(-2) - state[..., :JOINTS]
        features = torch.cat([(state - self.loc) / self.scale, (way / _STEP).clamp(-4, 4)], -1)
        return state + self.change * self._run(features, noise)


def ur5_table(**settings) -> UR5TableFilter:
    """Returns a DEnKF for the UR5 table, untrained.

    Args:
        **settings: those of :class:`UR5TableSettings`.

    Raises:
        TypeError: on a name that is no setting.

    Example:
        >>> from tensordict import TensorDict
        >>> demo = TensorDict({"pixels": torch.zeros(5, 3, 64, 64), "action": torch.zeros(5, 7)}, [5])
        >>> ur5_table(ensemble_size=8).sequence(demo)["belief", "mean"].shape
        torch.Size([5, 10])
    """
    return UR5TableFilter(UR5TableSettings(**settings))
