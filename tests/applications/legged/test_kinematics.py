"""Chains of joints in torch against MuJoCo's."""

import mujoco
import numpy as np
import pytest
import torch
from dm_control.suite import common, quadruped

from tests.real_data import SHARED
from torch_denkf.applications.legged import QUADRUPED
from torch_denkf.applications.legged.icub import ICUB as NAMES
from torch_denkf.applications.legged.icub import icub_model
from torch_denkf.applications.legged.kinematics import LegKinematics

ICUB = SHARED / "icub"
#: Hinges away from the body's origin, a slide, turned bodies, two joints on a body, legs of unequal length.
ODD = """
<mujoco><worldbody><body name="base" pos="1 2 3" euler="10 20 30"><freejoint/><geom size=".1"/>
  <body name="mount" pos=".1 .2 .3" euler="40 0 5"><geom size=".1"/>
    <site name="imu" pos=".1 0 .2" euler="0 90 20"/></body>
  <body pos=".3 0 0" euler="0 0 30"><joint name="a" axis="0 1 1" pos=".1 .2 0" ref="20"/>
    <joint name="b" axis="1 0 0"/><geom size=".1"/>
    <body pos="0 .1 -.4" euler="5 6 7"><joint name="c" type="slide" axis="0 1 -2" pos=".1 0 0" ref=".1"/>
      <geom size=".1"/>
      <site name="left" pos="0 .1 -.2"/></body></body>
  <body name="right" pos="-.3 0 0" euler="0 50 0"><joint name="d" axis="0 0 1" pos="0 .2 0"/><geom size=".1"/></body>
</body></worldbody></mujoco>
"""


def model_of(name):
    if name == "odd":
        return mujoco.MjModel.from_xml_string(ODD), ["left", "right"], "imu"
    if name == "quadruped":
        return (
            mujoco.MjModel.from_xml_string(quadruped.make_model().decode(), common.ASSETS),
            QUADRUPED["feet"],
            "torso",
        )
    if not ICUB.exists():
        pytest.skip(f"{ICUB} is missing")
    return icub_model(ICUB), NAMES["feet"], NAMES["imu"]


def of_mujoco(model, data, feet, imu):
    """Returns positions of the feet in the sensor's axes."""

    def frame(name):
        if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name) >= 0:
            return data.site(name).xpos, data.site(name).xmat.reshape(3, 3)
        return data.body(name).xpos, data.body(name).xmat.reshape(3, 3)

    mujoco.mj_kinematics(model, data)
    place, axes = frame(imu)
    return np.stack([(frame(foot)[0] - place) @ axes for foot in feet])


@pytest.mark.parametrize("name", ["odd", "quadruped", "icub"])
def test_feet_are_where_mujoco_says(name, float64):
    model, feet, imu = model_of(name)
    kinematics, data, random = LegKinematics(model, feet, imu), mujoco.MjData(model), np.random.default_rng(0)
    columns = [model.joint(joint).qposadr[0] for joint in kinematics.joints]
    rows, expected = [], []
    for _ in range(20):
        data.qpos[columns] = random.uniform(-1, 1, len(columns))
        rows.append(data.qpos[columns].copy())
        expected.append(of_mujoco(model, data, feet, imu))
    angles = torch.tensor(np.stack(rows))
    found = kinematics(angles.view(4, 5, -1)).view(20, len(feet), 3)
    assert (found - torch.tensor(np.stack(expected))).abs().max() < 1e-6
    rates = torch.randn(20, len(columns))
    _, moved = torch.func.jvp(kinematics, (angles,), (rates,))
    assert (kinematics.velocities(angles, rates) - moved).abs().max() < 1e-9


def test_joints_come_in_the_order_that_is_named(float64):
    model, feet, imu = model_of("odd")
    plain, other = LegKinematics(model, feet, imu), LegKinematics(model, feet, imu, joints=["more", "d", "c", "b", "a"])
    angles = torch.randn(7, 4)
    turned = torch.cat([torch.randn(7, 1), angles.flip(-1)], -1)
    assert torch.equal(plain(angles), other(turned))
    assert torch.equal(plain.velocities(angles, angles), other.velocities(turned, turned))


def test_missing_names_raise():
    model, feet, imu = model_of("odd")
    with pytest.raises(KeyError, match=r"no site or body 'toe'. Its sites: \['imu', 'left'\]"):
        LegKinematics(model, ["toe"], imu)
    with pytest.raises(KeyError, match="'c' moves 'left'"):
        LegKinematics(model, feet, imu, joints=["a", "b", "d"])
    with pytest.raises(ValueError, match=r"Joints \['d'\] move 'right'"):
        LegKinematics(model, ["left"], "right")
