"""Transform that computes the optical flow of a camera's images."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from torch_denkf._arguments import Checked
from torch_denkf._checks import check_number
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.applications.car.vision.motion import grey_picture, image_motion
from torch_denkf.applications.car.vision.shapes import FLOW_SHAPE, ROAD_SHAPE
from torch_denkf.diagnosis import entry_of
from torch_denkf.modules.tensors import as_floating

__all__ = ["OpticalFlow"]


class OpticalFlow(Checked, Transform):
    """Adds the inputs of :class:`torch_denkf.applications.car.FlowSensor`, from a frame and its difference to the last.

    It is stateless: the frame before is the frame minus the difference, the outputs of
    :class:`torch_denkf.applications.car.KITTIReplayEnv`. :func:`torch_denkf.applications.car.with_motion` computes the
    same once for a recorded drive.

    Args:
        calibration: (fx, fy, cx, cy) of the camera, in pixels of the images.
        height: height of the camera over the road, in m.
        in_key: frames and differences ``[*B, 2C, H, W]``, float in [0, 1] and [-1, 1]; C is 1 or 3.
        out_keys: keys of the flow ``[*B, 3, 25, 79]`` and the road's correlation ``[*B, 13, 69]``, float32.
        observed_key: optional mask ``[*B, 1]``; both are zero if it is False.

    Raises:
        KeyError: if there are no pixels.
        ValueError: if their shape is not that of a frame and its difference.

    Example:
        >>> from tensordict import TensorDict
        >>> flow = OpticalFlow((87.0, 86.5, 73.4, 24.8))
        >>> flow(TensorDict({"pixels": torch.zeros(6, 50, 150)}))["flow"].shape
        torch.Size([3, 25, 79])
    """

    def __init__(
        self,
        calibration: Sequence[float] | torch.Tensor,
        *,
        height: float = KITTI_HEIGHT,
        in_key: NestedKey = "pixels",
        out_keys: Sequence[NestedKey] = ("flow", "road"),
        observed_key: NestedKey = "observed",
    ):
        super().__init__(in_keys=[in_key], out_keys=list(out_keys))
        self.calibration = tuple(as_floating(calibration, "calibration").reshape(-1).tolist())
        if len(self.calibration) != 4:
            raise ValueError(f"calibration is (fx, fy, cx, cy) in pixels; got {calibration!r}.")
        for name, value, above in zip(("fx", "fy", "cx", "cy"), self.calibration, (0, 0, None, None), strict=True):
            check_number(f"calibration, {name},", value, above=above)
        check_number("height", height, above=0, cure="It is that of the camera over the road, in m")
        self.height, self.observed_key = height, observed_key

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        pixels = entry_of(next_tensordict, self.in_keys[0], "OpticalFlow", "Set in_key=.")
        batch = next_tensordict.batch_size
        if pixels.ndim != len(batch) + 3 or pixels.shape[-3] not in (2, 6):
            raise ValueError(
                f"OpticalFlow reads a frame and its difference, [*B, 2C, H, W] with C = 1 or 3; {self.in_keys[0]!r} "
                f"has shape {list(pixels.shape)} in a batch {list(batch)}."
            )
        observed = next_tensordict.get(self.observed_key, None)
        observed = torch.ones(*batch, 1, dtype=torch.bool) if observed is None else observed.any(-1, keepdim=True)
        flow = torch.zeros(batch.numel(), *FLOW_SHAPE)
        road = torch.zeros(batch.numel(), *ROAD_SHAPE)
        frames = pixels.reshape(-1, *pixels.shape[-3:]).cpu()
        for row in observed.reshape(-1).nonzero().flatten().tolist():
            frame, difference = frames[row].chunk(2)
            arrays = image_motion(_grey(frame - difference), _grey(frame), self.calibration, height=self.height)
            flow[row], road[row] = (torch.from_numpy(array) for array in arrays)
        for key, value in zip(self.out_keys, (flow, road), strict=True):
            next_tensordict.set(key, value.reshape(*batch, *value.shape[1:]).to(pixels.device))
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds the flow to data, e.g. to a sample of a replay buffer."""
        return self._call(tensordict)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds both entries."""
        for key, shape in zip(self.out_keys, (FLOW_SHAPE, ROAD_SHAPE), strict=True):
            shape = (*observation_spec.shape, *shape)
            observation_spec[key] = Unbounded(shape=shape, dtype=torch.float32, device=observation_spec.device)
        return observation_spec


def _grey(image: torch.Tensor):
    return grey_picture((image * 255).round_().clamp_(0, 255).to(torch.uint8).numpy())
