"""Optical flow and road correlation of a whole drive, computed once."""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase

from torch_denkf._checks import check_number
from torch_denkf.applications.car.kitti.gaps import after_gap, steps_at
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.applications.car.vision.epipolar import two_view_motion
from torch_denkf.applications.car.vision.motion import grey_picture, image_motion
from torch_denkf.applications.car.vision.shapes import FLOW_SHAPE, ROAD_SHAPE, TWO_VIEW_SHAPE
from torch_denkf.applications.car.vision.signs import PICTURE_SIGNS, picture_signs, static_region
from torch_denkf.data.cache import cache_folder, cached

__all__ = ["with_motion"]

_FORMAT = 2  # part of the cache's key: raise it when the stored content changes


def with_motion(
    drive: TensorDictBase,
    *,
    height: float = KITTI_HEIGHT,
    cache: str | Path | bool | None = True,
    keep_images: bool = True,
    two_view: bool = False,
    signs: bool = False,
    repair: bool = False,
) -> TensorDict:
    """Adds the inputs of the flow sensor to a drive: the motion of each image since the one before.

    ========= =============== =========================================================================================
    key       shape           content
    ========= =============== =========================================================================================
    ``flow``  [N, 3, 25, 79]  float16: coarse optical flow and its mismatch, see ``vision.flow.coarse_flow``
    ``road``  [N, 13, 69]     float16: see ``vision.road.road_correlation``
    ``signs`` [N, 4]          with ``signs=True``, float32: see ``vision.picture_signs``
    ========= =============== =========================================================================================

    With ``two_view`` also ``"two_view"`` ``[N, 8]``, float32: see
    :func:`torch_denkf.applications.car.vision.epipolar.two_view_motion`.

    All are zero in rows whose image, or the one before, is missing; after ``kitti.gaps.bridge_gaps`` the one before is
    the last existing one. They cost 9 ms per frame at 50 x 150 pixels and 25 ms at 125 x 414, and are cached under a
    hash of the images.

    Args:
        drive: drive from :func:`torch_denkf.applications.car.read_kitti_drive`, batch size ``[N]``; colour images are
            converted to grey.
        height: height of the camera over the road, in m.
        cache: as in :func:`torch_denkf.applications.car.read_kitti_drive`.
        keep_images: False leaves the images out of the result, which saves memory.
        two_view: also track corners, for a sensor that reads them; 12 ms per frame at 125 x 414 pixels.
        signs: whether to add the images' signs of a failing camera.
        repair: whether to extrapolate the flow over static occlusions, such as dirt or a box, see
            ``vision.signs.static_region``.

    Returns:
        A shallow copy of the drive, with these entries.

    Raises:
        KeyError: if the drive lacks images, their mask or the calibration.
        OSError: if the cache cannot be written.

    Examples:
        >>> from torch_denkf.applications.car.kitti.drive import read_kitti_drive
        >>> from torch_denkf.applications.car.kitti.render import write_drives
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> drive = read_kitti_drive(folder, *write_drives(folder, ["town"], frames=5), cache=None)
        >>> with_motion(drive, cache=None)["road"].shape
        torch.Size([5, 13, 69])
    """
    check_number("height", height, above=0, cure="It is that of the camera over the road, in m")
    missing = {"image", "frame_valid", "calibration"} - set(drive.keys())
    if missing:
        raise KeyError(
            f"the drive lacks {sorted(missing)}; pass what torch_denkf.applications.car.read_kitti_drive returns"
        )

    def compute() -> TensorDict:
        return _compute(drive, height, signs, repair, two_view)

    directory = cache_folder(cache)
    if directory is None:
        motion = compute()
    else:
        options = f" {signs} {repair}" if signs or repair else ""
        options += " two_view" * two_view + " seen" * (two_view and repair)
        key = f"{_FORMAT} {height} {tuple(drive['image'].shape)}{options}"
        digest = hashlib.blake2b(key.encode(), digest_size=10)
        for key in ("image", "frame_valid", "calibration", *(("steps",) if "steps" in drive else ())):
            digest.update(drive[key].contiguous().numpy().data)
        after = after_gap(drive)
        if after is not None:
            digest.update(after.contiguous().numpy().data)
        motion = cached(directory / f"motion-{digest.hexdigest()}", compute)
    drive = drive.copy() if keep_images else drive.exclude("image")
    return drive.update({key: motion[key] for key in ("flow", "road", "signs", "two_view") if key in motion})


def _compute(drive: TensorDictBase, height: float, signs: bool, repair: bool, two_view: bool) -> TensorDict:
    rows = drive.batch_size[0]
    flow = torch.zeros(rows, *FLOW_SHAPE, dtype=torch.float16)
    road = torch.zeros(rows, *ROAD_SHAPE, dtype=torch.float16)
    motion = {"flow": flow, "road": road}
    if signs:
        motion["signs"] = torch.zeros(rows, len(PICTURE_SIGNS))
    if two_view:
        motion["two_view"] = torch.zeros(rows, *TWO_VIEW_SHAPE)
    steps, calibration = steps_at(drive, torch.arange(rows)).squeeze(-1).tolist(), drive["calibration"].tolist()
    for row in range(rows):
        if steps[row]:
            previous, current = (grey_picture(drive["image"][at].numpy()) for at in (row - steps[row], row))
            static = static_region(previous, current) if repair else None
            hidden = {} if static is None or not static.any() else {"hidden": static}
            arrays = image_motion(previous, current, calibration[row], height=height, **hidden)
            flow[row], road[row] = (torch.from_numpy(array).half() for array in arrays)
            if signs:
                motion["signs"][row] = torch.from_numpy(picture_signs(previous, current))
            if two_view:
                motion["two_view"][row] = torch.from_numpy(
                    two_view_motion(previous, current, calibration[row], **hidden)
                )
    return TensorDict(motion, batch_size=[rows])
