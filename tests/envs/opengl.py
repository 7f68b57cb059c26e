"""Skips what needs pictures where MuJoCo finds no OpenGL, and says why."""

from __future__ import annotations

from functools import cache

import pytest

mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed: pip install 'mujoco>=3.17,<4'")


@cache
def why_not() -> str | None:
    from torch_denkf.applications.ur5.simulation.render import Renderer

    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><camera name='front'/></worldbody></mujoco>")
    try:
        Renderer(model, (8, 8)).close()
    except RuntimeError as error:
        return str(error)
    return None


def needs_opengl() -> None:
    if why_not() is not None:
        pytest.skip(why_not())
