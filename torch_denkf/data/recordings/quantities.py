"""Recognises quantities by the names of a log's columns: positions, speeds, headings, turn rates."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

__all__ = ["SPEEDS", "find", "in_radians", "metres", "quantity", "speed_unit"]

#: Units of speed: factor from m/s, and pattern of their names.
SPEEDS = {"km/h": (3.6, r"km/?h|kph|kmph"), "mph": (2.23694, r"mph"), "knots": (1.94384, r"kn|kts?|knots?")}

_AXIS = r"(?:^|(?:.*[._ /])?(?:pose|pos|position|utm|map|gps|fix|translation)[._ /])(?:p|t|pos)?_?"
#: Patterns of column names, in lower case and without units, by quantity.
_NAMES = {
    "latitude": r".*latitude|.*\blat",
    "longitude": r".*longitude|.*\b(lon|lng|long)",
    "east": rf"east(ing)?|{_AXIS}x|.*p_rs_r_x",
    "north": rf"north(ing)?|{_AXIS}y|.*p_rs_r_y",
    "turn rate": r".*(yaw_?(rate|vel)|turn(_?rate)?|gyro(_?z)?|omega(_?z)?|\b[wg]z|angular(_velocity)?[._]z|w_rs_s_z)",
    "heading": r".*(heading|compass|yaw|theta|course|\bcog|track|psi)",
    "speed": r".*(speed|velocity|\bsog|\bvx|\bv|(twist[._])?linear[._]x|v_forward)",
    "acceleration": r".*(\bax|acc(el(eration)?)?_?x|linear_acceleration[._]x|a_rs_s_x)",
}
_DEGREES = 7.0  # rad, or rad/s: larger ones are in degrees


def quantity(name: str) -> str | None:
    """Returns the quantity that a column's name means; ``None`` if it is unknown.

    Examples:
        >>> quantity("twist.twist.angular.z"), quantity("yawrate"), quantity("Latitude (deg)"), quantity("hdop")
        ('turn rate', 'turn rate', 'latitude', None)
    """
    plain = re.sub(r"\s*[\[(].*", "", name).strip().lower()
    return next((what for what, pattern in _NAMES.items() if re.fullmatch(pattern, plain)), None)


def find(columns: Sequence[str], *wanted: str) -> list[int] | None:
    """Returns the indices of the first columns with the given quantities; ``None`` if one is missing."""
    found = [quantity(name) for name in columns]
    return [found.index(what) for what in wanted] if set(wanted) <= set(found) else None


def speed_unit(name: str, scale: float = 1.0) -> str | None:
    """Returns the unit of a speed by its column's name, or km/h by its scale; ``None`` for m/s.

    Examples:
        >>> speed_unit("SOG [kn]"), speed_unit("speed_kmh"), speed_unit("speed", 3.7), speed_unit("speed", 2.2)
        ('knots', 'km/h', 'km/h', None)
    """
    for unit, (_, pattern) in SPEEDS.items():
        if re.search(rf"(?<![a-z])({pattern})(?![a-z])", name.lower()):
            return unit
    return "km/h" if 3.1 < scale < 4.2 else None  # other units' scales are too near to 1, as noise reduces them


def metres(name: str) -> float:
    """Returns the metres of a position's unit by its column's name.

    Examples:
        >>> metres("x [km]"), metres("y (mm)"), metres("north")
        (1000.0, 0.001, 1.0)
    """
    unit = re.search(r"[\[(]\s*(km|cm|mm)\s*[\])]", name.lower())
    return {"km": 1e3, "cm": 1e-2, "mm": 1e-3}[unit[1]] if unit else 1.0


def in_radians(name: str, angles: np.ndarray) -> np.ndarray:
    """Returns headings or turn rates in rad, by the unit in the column's name; else large values are degrees.

    Examples:
        >>> in_radians("yaw_rate [deg/s]", np.array([1.0])).round(4), in_radians("yaw_rate", np.array([1.0]))
        (array([0.0175]), array([1.]))
    """
    if unit := re.search(r"(?<![a-z])(deg|degrees?|dps|rad|radians?)(?![a-z])|°", name.lower()):
        return angles if unit[0].startswith("rad") else np.radians(angles)
    return np.radians(angles) if np.abs(angles).max(initial=0.0) > _DEGREES else angles
