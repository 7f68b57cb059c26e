r"""A learned sensor for a car's motion from optical flow: :math:`\tilde y^i_t \sim s_\xi(\tilde y^i_t \mid y_t)`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey
from torch import nn

from torch_denkf._checks import check_count, check_number
from torch_denkf.applications.car.vision.expansion import focus_of_expansion
from torch_denkf.applications.car.vision.shapes import FLOW_SHAPE, ROAD_PITCHES, ROAD_SHAPE, ROAD_SHIFTS, TWO_VIEW_SHAPE
from torch_denkf.modules.sensor import StochasticSensor
from torch_denkf.modules.stochastic import StochasticMLP

__all__ = ["FlowSensor"]

_FLOW_UNIT, _TURN_UNIT = 0.1, 0.02  # flow in tangents and turn in rad, per frame: about a standard deviation on KITTI
_ROAD_LOC, _ROAD_SCALE = 0.9, 0.2  # mean and spread of the road's correlations
_PITCH_UNIT = 0.005  # rad: about the error of the direction of travel
_CORNER_CUES = 5  # see _MotionTrunk._corner_cues
_CORNER_TRUST = 2.0  # initial log odds of the corners' turn against the flow's


class _MotionTrunk(nn.Module):
    """Computes distance and turn between two frames by geometry, and features for their correction.

    A small convolutional network turns the road's correlations into a distribution over pitch and distance. The
    direction of travel is parallel to the road and thus gives the camera's pitch, which the correlations alone hardly
    determine. The turn is a learned mixture of the geometric fit, the median flow ahead (better on an empty motorway),
    and tracked corners, if they are an input.
    """

    distances: torch.Tensor
    pitches: torch.Tensor
    flow_grid: torch.Tensor
    road_grid: torch.Tensor

    def __init__(self, features: int, dropout: float, two_view: bool = False):
        super().__init__()
        channels, height, width = FLOW_SHAPE
        pitches, shifts = ROAD_SHAPE
        dtype = torch.get_default_dtype()
        self.flow = nn.Sequential(
            nn.Conv2d(channels + 2, 16, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(16, 24, 3, 2, 1),
            nn.ReLU(),
            nn.Conv2d(24, 32, 3, 2, 1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Dropout(dropout),
            nn.Linear(32 * -(-height // 8) * -(-width // 8), features),
            nn.ReLU(),
        )
        self.road = nn.Sequential(
            nn.Conv2d(3, 16, 3, 1, 1), nn.ReLU(), nn.Conv2d(16, 16, 3, 1, 1), nn.ReLU(), nn.Conv2d(16, 1, 3, 1, 1)
        )
        self.gate = nn.Linear(features + 2, 1)
        self.pitch_offset = nn.Parameter(torch.tensor(0.0))  # in _PITCH_UNIT
        self.log_pitch_std = nn.Parameter(torch.tensor(0.0))
        self.log_sharpness = nn.Parameter(torch.tensor(3.0))
        self.register_buffer("distances", torch.as_tensor(ROAD_SHIFTS, dtype=dtype))
        self.register_buffer("pitches", torch.as_tensor(ROAD_PITCHES / _PITCH_UNIT, dtype=dtype))
        self.register_buffer("flow_grid", _grid(height, width))
        self.register_buffer("road_grid", _grid(pitches, shifts))
        self.out_features = features + 7
        if two_view:
            self.corner_gate = nn.Linear(features + 2 + _CORNER_CUES, 1)
            nn.init.constant_(self.corner_gate.bias, _CORNER_TRUST)
            self.corner_pitch_offset = nn.Parameter(torch.tensor(0.0))
            self.log_corner_pitch_std = nn.Parameter(torch.tensor(0.0))
            self.out_features += _CORNER_CUES

    def forward(self, flow: torch.Tensor, road: torch.Tensor, two_view: torch.Tensor | None = None):
        count, expansion = len(flow), focus_of_expansion(flow)
        pitch, pitch_std = expansion.focus[:, 1] / _PITCH_UNIT, expansion.focus_std[:, 1] / _PITCH_UNIT
        scaled = torch.cat([flow[:, :2] / _FLOW_UNIT, flow[:, 2:]], 1)
        code = self.flow(torch.cat([scaled, self.flow_grid.expand(count, -1, -1, -1)], 1))
        table = ((road - _ROAD_LOC) / _ROAD_SCALE).unsqueeze(1)
        score = self.road(torch.cat([table, self.road_grid.expand(count, -1, -1, -1)], 1)).squeeze(1)
        off = (self.pitches - (pitch + self.pitch_offset).unsqueeze(-1)) / self.log_pitch_std.exp()
        score = score + self.log_sharpness.exp() * road - (off**2 / 2).unsqueeze(-1)
        if two_view is not None:
            seen = two_view[:, -1:] > 0
            down = two_view[:, 4:5] / _PITCH_UNIT
            off = (self.pitches - (down + self.corner_pitch_offset)) / self.log_corner_pitch_std.exp()
            score = score - torch.where(seen, off**2 / 2, 0.0).unsqueeze(-1)
        belief = score.flatten(1).softmax(1).view_as(score)
        of_distance, of_pitch = belief.sum(1), belief.sum(2) @ self.pitches
        moved = of_distance @ self.distances
        spread = ((of_distance @ self.distances**2 - moved**2).clamp_min(0) + 1e-6).sqrt()
        ahead, fitted, turn_std = _median_turn(flow), expansion.turn[:, 0], expansion.turn_std[:, 0]
        doubt = [(turn_std / _TURN_UNIT).log(), pitch_std.log()]
        trust = self.gate(torch.cat([code, torch.stack(doubt, 1)], 1)).squeeze(-1).sigmoid()
        turned, corners = torch.lerp(ahead, fitted, trust), []
        if two_view is not None:
            corners = self._corner_cues(two_view, turned, pitch)
            trust = self.corner_gate(torch.cat([code, torch.stack(doubt + corners, 1)], 1)).squeeze(-1).sigmoid()
            turned = torch.where(seen.squeeze(-1), torch.lerp(turned, two_view[:, 0], trust), turned)
        cues = [spread / 0.2, of_pitch, (road.amax((1, 2)) - _ROAD_LOC) / _ROAD_SCALE, turned / _TURN_UNIT]
        cues += [of_pitch - pitch, *doubt, *corners]
        return moved, turned, torch.cat([code, torch.stack(cues, 1)], 1)

    @staticmethod
    def _corner_cues(two_view: torch.Tensor, turned: torch.Tensor, pitch: torch.Tensor) -> list[torch.Tensor]:
        """Returns confidences of the corners' turn and pitch, and differences from the flow; 0 without corners."""
        left, *_, down, turn_std, pitch_std, inliers = two_view.unbind(1)
        seen = inliers > 0
        doubts = [(turn_std / _TURN_UNIT).clamp_min(1e-4).log() + 4, (pitch_std / _PITCH_UNIT).clamp_min(1e-4).log()]
        # Failed fits may be outliers: differences are bounded.
        apart = [((left - turned) / _TURN_UNIT).tanh(), (down / _PITCH_UNIT - pitch).div(4).tanh()]
        return [torch.where(seen, cue, 0.0) for cue in (*doubts, *apart)] + [inliers]


class FlowSensor(StochasticSensor):
    """Estimates speed and turn rate of a car from optical flow and road correlation, for each ensemble member.

    Geometry gives a first estimate: the distance with the best correlation of the road in two frames, at the camera's
    pitch from the flow's focus of expansion, and the turn from the same fit or from the median flow far ahead. A small
    network weights the distances, and a stochastic head corrects both estimates for each member. Inputs are in angles
    and metres, so that one sensor serves cameras with other intrinsics and resolutions, and transfers from rendered to
    real drives.

    Args:
        dt: time between frames in s.
        ensemble_size: E.
        features: size of the flow's code.
        num_cells: widths of the head's hidden layers.
        layer: ``"dropout"`` or ``"flipout"``, see :class:`StochasticMLP`.
        rate: drop probability of the head's hidden units.
        trunk_dropout: drop probability of the flow's code, in training mode only.
        in_keys: the flow ``[*B, 3, 25, 79]`` and the road's correlation ``[*B, 13, 69]``, any floating type, as
            :class:`~torch_denkf.applications.car.OpticalFlow` or ``with_motion`` writes them.
        out_key: learned observations (v m/s, θ_dot rad/s) ``[*B, E, 2]``.
        two_view_key: the motion of tracked corners ``[*B, 8]``
            (:func:`torch_denkf.applications.car.vision.epipolar.two_view_motion`), as an optional third input: its turn
            is two to three times more accurate than the flow's.
        encoding_key: key for the head's input, ``[*B, encoding_features]``, from which a noise model can recognise
            blurred frames. None does not write it.
        observed_key: optional observed mask ``[*B, 1]``; other frames are replaced by zeros.

    Raises:
        ValueError: if an input does not have the shape above.

    Source: Paper's sensor (section III, eq. 8) with another trunk; the plane of the road as in Geiger, Ziegler &
        Stiller 2011, "StereoScan", for monocular scale;
        :func:`torch_denkf.applications.car.vision.expansion.focus_of_expansion`.

    Example:
        >>> from tensordict import TensorDict
        >>> sensor = FlowSensor(dt=0.1, ensemble_size=8)
        >>> frames = TensorDict({"flow": torch.zeros(4, 3, 25, 79), "road": torch.zeros(4, 13, 69)}, [4])
        >>> sensor(frames)["sensor", "ensemble"].shape
        torch.Size([4, 8, 2])
    """

    observation_dim = 2

    def __init__(
        self,
        *,
        dt: float,
        ensemble_size: int = 32,
        features: int = 32,
        num_cells: Sequence[int] = (32, 32),
        layer: Literal["dropout", "flipout", "none"] = "dropout",
        rate: float = 0.1,
        trunk_dropout: float = 0.2,
        in_keys: tuple[NestedKey, NestedKey] = ("flow", "road"),
        two_view_key: NestedKey | None = None,
        out_key: NestedKey = ("sensor", "ensemble"),
        encoding_key: NestedKey | None = ("sensor", "encoding"),
        observed_key: NestedKey = "observed",
    ):
        check_number("dt", dt, above=0)
        check_count("ensemble_size", ensemble_size)
        check_count("features", features)
        check_number("trunk_dropout", trunk_dropout, least=0, below=1)
        trunk = _MotionTrunk(features, trunk_dropout, two_view_key is not None)
        head = StochasticMLP(trunk.out_features, 2, num_cells, layer=layer, rate=rate, output_gain=0.1)
        super().__init__(
            nn.ModuleDict({"trunk": trunk, "head": head}),
            [*in_keys, *([] if two_view_key is None else [two_view_key])],
            [out_key] if encoding_key is None else [out_key, encoding_key],
            optional_keys=[observed_key],
        )
        self.dt, self.ensemble_size, self.encoding_features = float(dt), ensemble_size, trunk.out_features

    def compute(self, *values, noise, batch_size):
        """Returns the learned observations of every member, and the encoding if ``encoding_key`` is set."""
        *inputs, observed = values
        inputs = [self._frames(value, index, observed, batch_size) for index, value in enumerate(inputs)]
        moved, turned, encoding = self.module["trunk"](*inputs)
        encoding = encoding.reshape(*batch_size, encoding.shape[-1])
        correction = self.module["head"](encoding.unsqueeze(-2), noise, sample=noise is not None)
        moved, turned = (value.reshape(*batch_size, 1) for value in (moved, turned))
        distance = moved * (1 + correction[..., 0].tanh())
        angle = turned + _TURN_UNIT * correction[..., 1]
        samples = (torch.stack([distance, angle], -1) / self.dt).expand(*batch_size, self.ensemble_size, 2)
        return (samples, encoding) if len(self.out_keys) > 1 else samples

    def _frames(self, value: torch.Tensor, index: int, observed: torch.Tensor | None, batch_size) -> torch.Tensor:
        """Returns an input as ``[N, *event]``; zeros where nothing was observed."""
        expected = (FLOW_SHAPE, ROAD_SHAPE, TWO_VIEW_SHAPE)[index]
        if tuple(value.shape) != (*batch_size, *expected):
            raise ValueError(
                f"FlowSensor reads {self.in_keys[index]!r} of shape [*B, {', '.join(map(str, expected))}], got "
                f"{list(value.shape)} in a batch {list(batch_size)}. OpticalFlow and with_motion write it."
            )
        value = value.to(self.module["trunk"].distances.dtype)
        if observed is not None:
            # An unobserved frame may be NaN, which would make gradients NaN even with a mask.
            seen = observed.any(-1).reshape(*batch_size, *(1,) * len(expected))
            value = torch.where(seen, value, 0.0)
        return value.reshape(batch_size.numel(), *expected)


def _grid(height: int, width: int) -> torch.Tensor:
    """Returns the coordinates of cells: two channels from -1 to 1, ``[1, 2, height, width]``."""
    rows, columns = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    return torch.stack([columns, rows]).unsqueeze(0)


def _median_turn(flow: torch.Tensor) -> torch.Tensor:
    """Estimates the turn to the left from a batch of coarse flows, as ``median_turn`` of ``vision/flow.py`` does."""
    height, width = flow.shape[-2:]
    side = int(0.375 * width)  # a symmetric region, in which the flow of expansion cancels
    ahead = flow[:, 0, int(0.33 * height) : int(0.5 * height), side : width - side].flatten(1)
    middle = ahead.shape[1] // 2
    ordered = ahead.sort(1).values  # torch's median would take the lower of two middle values
    return (ordered[:, (ahead.shape[1] - 1) // 2] + ordered[:, middle]) / 2
