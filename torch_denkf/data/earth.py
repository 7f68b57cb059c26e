"""Conversion between degrees on the WGS-84 ellipsoid and metres in a local tangent plane (east, north, up)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

__all__ = ["to_degrees", "to_local"]

_A, _F = 6378137.0, 1 / 298.257223563  # semi-major axis of WGS-84 in m, and flattening
_E2 = _F * (2 - _F)


def to_local(places: np.ndarray, origin: Sequence[float]) -> np.ndarray:
    """Converts latitude, longitude and height to metres east, north and up of an origin.

    Args:
        places: latitude and longitude in degrees, and optionally the height above the ellipsoid in m, ``[*, 2 or 3]``.
        origin: origin of the local axes, in the same form.

    Returns:
        Metres in float64, in the shape of ``places``.

    Examples:
        >>> to_local(np.array([51.05, 13.80]), [51.04, 13.79]).round(2)
        array([ 701.22, 1112.54])
    """
    count, places, start = np.shape(places)[-1], _whole(places), _whole(origin)
    return ((_centred(places) - _centred(start)) @ _axes(start))[..., :count]


def to_degrees(metres: np.ndarray, origin: Sequence[float]) -> np.ndarray:
    """Converts metres east, north and up of an origin to latitude, longitude and height.

    Args:
        metres: east and north, and optionally up, ``[*, 2 or 3]``; without up, the points have the origin's height.
        origin: latitude and longitude in degrees of the local axes' origin, and optionally its height in m.

    Returns:
        Degrees and m in float64, in the shape of ``metres``.

    Examples:
        >>> to_degrees(to_local(np.array([51.05, 13.80]), [51.04, 13.79]), [51.04, 13.79]).round(7)
        array([51.05, 13.8 ])
    """
    count, metres, start = np.shape(metres)[-1], _whole(metres), _whole(origin)
    out = _geodetic(_centred(start) + metres @ _axes(start).T)
    for _ in range(3 if count == 2 else 0):  # the tangent plane rises above the origin's height
        metres[..., 2] += start[2] - out[..., 2]
        out = _geodetic(_centred(start) + metres @ _axes(start).T)
    return out[..., :count]


def _whole(values: np.ndarray | Sequence[float]) -> np.ndarray:
    """Returns a copy with a third component, zero if it is missing, ``[*, 3]``."""
    values = np.asarray(values, float)
    if values.shape[-1:] not in ((2,), (3,)):
        raise ValueError(
            f"A place has latitude, longitude and perhaps a height, [*, 2 or 3]; got {list(values.shape)}."
        )
    return np.concatenate([values, np.zeros((*values.shape[:-1], 3 - values.shape[-1]))], -1)


def _centred(places: np.ndarray) -> np.ndarray:
    """Converts degrees and height to metres from the centre of the earth, ``[*, 3]``."""
    (latitude, longitude), height = np.radians(places[..., :2]).T, places[..., 2].T
    normal = _A / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    across = (normal + height) * np.cos(latitude)
    along = ((1 - _E2) * normal + height) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), along]).T


def _geodetic(centred: np.ndarray) -> np.ndarray:
    """Converts metres from the centre of the earth to latitude, longitude and height."""
    x, y, z = centred.T
    across = np.hypot(x, y)
    latitude = np.arctan2(z, across * (1 - _E2))
    for _ in range(6):
        normal = _A / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + _E2 * normal * np.sin(latitude), across)
    sin, cos = np.sin(latitude), np.cos(latitude)
    height = across * cos + z * sin - _A * np.sqrt(1 - _E2 * sin**2)
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height]).T


def _axes(origin: np.ndarray) -> np.ndarray:
    """Returns the directions east, north and up at a place, as the columns of a matrix."""
    latitude, longitude = np.radians(origin[:2])
    (s, c), (t, k) = (np.sin(latitude), np.cos(latitude)), (np.sin(longitude), np.cos(longitude))
    return np.array([[-t, -s * k, c * k], [k, -s * t, c * t], [0.0, c, s]])
