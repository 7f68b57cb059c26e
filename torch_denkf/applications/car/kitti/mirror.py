"""Mirrors drives: swaps left and right."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase

__all__ = ["mirror_drive"]

_STATE_SIGNS = (1.0, -1.0, -1.0, 1.0, -1.0)  # x, y, θ, v, θ_dot
_TWO_VIEW_SIGNS = (-1.0, 1.0, -1.0, -1.0, 1.0, 1.0, 1.0, 1.0)  # left, up, around; right, down; symmetric entries


def mirror_drive(drive: TensorDictBase, *, width: int | None = None) -> TensorDict:
    """Mirrors a drive: flips images, and left and right of all entries.

    Training on drives and their mirror images doubles the data and removes a bias to one side (as Kloss, Martius & Bohg
    2021, arXiv:2012.14313, on KITTI).

    ==================== ==========================================================================================
    key                  change
    ==================== ==========================================================================================
    ``image, pixels``    flipped from left to right
    ``flow``             flipped, and the sign of its first channel, the motion to the right
    ``two_view``         signs of the turns to the left and around, and of the focus to the right
    ``state``            signs of y, θ and θ_dot
    ``calibration``      cx becomes ``width - 1 - cx``, as pixel centres are at whole numbers
    ==================== ==========================================================================================

    All other entries are unchanged, also ``road``, which is the correlation straight ahead.

    Args:
        drive: drive from :func:`torch_denkf.applications.car.read_kitti_drive`, or rows of
            :func:`torch_denkf.applications.car.kitti.frames.frames_at`; any batch size. All keys are optional.
        width: width of the images in pixels, for the calibration; by default that of ``image`` or ``pixels``.

    Returns:
        A shallow copy: changed entries are new, the others are shared.

    Raises:
        ValueError: if the state does not have five columns, or if there is a calibration without images and
            ``width`` is not given.

    Examples:
        >>> drive = TensorDict({"state": [[1.0, 2.0, 0.3, 4.0, 0.5]], "image": [[[[1, 2, 3]]]]}, [1])
        >>> mirrored = mirror_drive(drive)
        >>> mirrored["state"]
        tensor([[ 1.0000, -2.0000, -0.3000,  4.0000, -0.5000]])
        >>> mirrored["image"].flatten()
        tensor([3, 2, 1])
    """
    mirrored = drive.copy()
    for key in ("image", "pixels"):
        if key in drive:
            mirrored[key] = drive[key].flip(-1)
            width = drive[key].shape[-1] if width is None else width
    if "flow" in drive:
        flow = drive["flow"].flip(-1)
        flow[..., 0, :, :].neg_()
        mirrored["flow"] = flow
    if "two_view" in drive:
        mirrored["two_view"] = drive["two_view"] * drive["two_view"].new_tensor(_TWO_VIEW_SIGNS)
    if "state" in drive:
        state = drive["state"]
        if state.shape[-1] != len(_STATE_SIGNS):
            raise ValueError(f"'state' is (x, y, θ, v, θ_dot), got {state.shape[-1]} columns; mirror others by hand")
        mirrored["state"] = state * state.new_tensor(_STATE_SIGNS)
    if "calibration" in drive:
        if width is None:
            raise ValueError("'calibration' is in pixels of images that the drive no longer has; pass their width")
        calibration = drive["calibration"].clone()
        calibration[..., 2] = width - 1 - calibration[..., 2]
        mirrored["calibration"] = calibration
    return mirrored
