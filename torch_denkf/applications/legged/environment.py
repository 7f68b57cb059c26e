"""A legged robot in MuJoCo, with realistic sensors and their errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from xml.etree import ElementTree

import mujoco
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torch_denkf._checks import check_count, check_number
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.diagnosis import entry_of

__all__ = ["LeggedEnv", "LeggedErrors", "on_floor"]


@dataclass(frozen=True)
class LeggedErrors:
    """Errors of a robot's sensors; all are standard deviations, those of constant errors over episodes.

    Gyro and accelerometer are those of InvenSense's MPU-6050, a cheap sensor, after a calibration at another
    temperature. The joints' offsets are half a degree: encoders whose zero was set by hand, or legs that bend.

    Attributes:
        gyro: density of white noise, rad/s/sqrt(Hz).
        accelerometer: m/s^2/sqrt(Hz).
        gyro_bias: constant, rad/s.
        accelerometer_bias: constant, m/s^2.
        gyro_walk: of the bias, rad/s^2/sqrt(Hz).
        accelerometer_walk: m/s^3/sqrt(Hz).
        joint_offset: constant, rad.
        joint: white, rad.
        joint_rate: white, rad/s.

    Raises:
        ValueError: if a number is negative or not finite.
    """

    gyro: float = math.radians(0.005)
    accelerometer: float = 400e-6 * 9.81
    gyro_bias: float = math.radians(0.5)
    accelerometer_bias: float = 0.1
    gyro_walk: float = 5e-5
    accelerometer_walk: float = 1e-3
    joint_offset: float = math.radians(0.5)
    joint: float = math.radians(0.05)
    joint_rate: float = 0.02

    def __post_init__(self):
        for each in fields(self):
            check_number(each.name, getattr(self, each.name), least=0)


class LeggedEnv(EnvBase):
    """Simulates one robot in MuJoCo; emits the readings of a legged robot, and the true motion of its base.

    Emits ``"imu"`` ``[6]`` (gyro in rad/s, accelerometer in m/s^2, in the sensor's axes: means over the step),
    ``"joints"`` and ``"joint_rates"`` ``[J]``, ``"force"`` ``[F]`` that presses each foot, in N, and ``"contact"``
    ``[F]``; and as truth, of the base, ``("true", "orientation")`` ``[4]``, ``("true", "position")`` ``[3]`` in the
    world and ``("true", "velocity")`` ``[3]`` in its own axes. Takes an ``"action"``, the model's controls. An episode
    begins with half a second, which is not emitted, at the controls zero.

    Args:
        model: whose base has a free joint and whose ``imu`` has an accelerometer.
        feet: names of sites or bodies, whose bodies touch the floor.
        imu: name of the site of the sensor.
        dt: seconds of a step, a multiple of the model's.
        errors: of the sensors; ``None`` for :class:`LeggedErrors`.
        on: force in N above which a contact begins.
        off: force below which it ends.
        pushes: standard deviation in N of horizontal pushes of the base: one per second on average, for 0.1 s each.
        seed: of the errors and pushes.

    Raises:
        ValueError: if the model has no accelerometer at ``imu``, no free joint, or ``dt`` is no multiple of its step.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        feet: Sequence[str],
        imu: str,
        dt: float = 0.01,
        errors: LeggedErrors | None = None,
        on: float = 20.0,
        off: float = 10.0,
        pushes: float = 0.0,
        seed: int = 0,
    ):
        super().__init__(batch_size=[])
        self.errors = LeggedErrors() if errors is None else errors
        if not isinstance(self.errors, LeggedErrors):
            raise TypeError(f"errors must be LeggedErrors or None; got {errors!r}")
        kinematics = LegKinematics(model, feet, imu)
        self.dt, self.on, self.off, self.pushes = dt, on, off, pushes
        check_number("dt", dt, above=0)
        check_number("pushes", pushes, least=0)
        check_number("on", on)
        check_number("off", off, most=on, cure="It is not above the threshold on")
        check_count("seed", seed, least=0)
        self.model, self.data, self.substeps = model, mujoco.MjData(model), round(dt / model.opt.timestep)
        if abs(self.substeps * model.opt.timestep - dt) > 1e-9:
            raise ValueError(f"dt={dt} is no multiple of the model's time step, {model.opt.timestep} s.")
        if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError("The base needs a free joint, the first joint of the model.")
        self.base = int(model.jnt_bodyid[0])
        self.columns = [int(model.joint(name).qposadr[0]) for name in kinematics.joints]
        self.rows = [int(model.joint(name).dofadr[0]) for name in kinematics.joints]
        self.feet = [int(model.site_bodyid[model.site(f).id]) if _is_site(model, f) else model.body(f).id for f in feet]
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, kinematics.base[:4].double().numpy())
        self.to_sensor = axes.reshape(3, 3).T
        site = model.site(imu).id
        found = (model.sensor_type == mujoco.mjtSensor.mjSENS_ACCELEROMETER) & (model.sensor_objid == site)
        if not found.any():
            raise ValueError(f"The site {imu!r} has no accelerometer.")
        self.force_at = int(model.sensor_adr[found.argmax()])
        self._make_spec(len(self.columns), len(self.feet))
        self.set_seed(seed)

    def _make_spec(self, joints: int, feet: int) -> None:
        true = {"orientation": Unbounded(4), "position": Unbounded(3), "velocity": Unbounded(3)}
        sizes = {"imu": 6, "joints": joints, "joint_rates": joints, "force": feet}
        self.observation_spec = Composite(
            {key: Unbounded(size) for key, size in sizes.items()},
            contact=Binary(feet, shape=[feet], dtype=torch.bool),
            true=Composite(true),
        )
        limits = torch.as_tensor(self.model.actuator_ctrlrange, dtype=torch.float32)
        self.action_spec = Bounded(limits[:, 0], limits[:, 1])
        self.reward_spec = Unbounded(1)

    def _set_seed(self, seed: int | None) -> None:
        self.random = np.random.default_rng(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        mujoco.mj_resetData(self.model, self.data)
        six = [self.errors.gyro_bias] * 3 + [self.errors.accelerometer_bias] * 3
        self.bias = np.array(six) * self.random.standard_normal(6)
        self.offset = self.errors.joint_offset * self.random.standard_normal(len(self.columns))
        self.stands, self.pushed = np.zeros(len(self.feet), dtype=bool), 0
        for _ in range(round(0.5 / self.dt)):
            readings = self._move()
        return readings

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = entry_of(tensordict, "action", type(self).__name__)
        if action.shape != self.action_spec.shape:
            raise ValueError(f"'action' is {list(self.action_spec.shape)}; got {list(action.shape)}.")
        check_number("action", action)
        self.data.ctrl[:] = action.detach().numpy()
        if self.pushes:
            self._push()
        readings = self._move()
        done = torch.zeros(1, dtype=torch.bool)
        return readings.update({"reward": torch.zeros(1), "done": done, "terminated": done.clone()})

    def _move(self) -> TensorDict:
        """Simulates a step, and reads the sensors."""
        data, total = self.data, np.zeros(6)
        for _ in range(self.substeps):
            self._simulate()
            # The simulator has the rotation at the end of its step, but the force at its beginning.
            total[:3] += self.to_sensor @ data.qvel[3:6]
            total[3:] += data.sensordata[self.force_at : self.force_at + 3]
        force = self._forces()
        self.stands = (force > self.on) | (self.stands & (force > self.off))
        entries = self._with_errors(total / self.substeps)
        axes = np.empty(9)
        mujoco.mju_quat2Mat(axes, data.qpos[3:7])
        true = {"orientation": data.qpos[3:7], "position": data.qpos[:3]}
        true["velocity"] = axes.reshape(3, 3).T @ data.qvel[:3]
        entries |= {"force": force, "true": {key: _floats(value) for key, value in true.items()}}
        entries = {key: _floats(value) if isinstance(value, np.ndarray) else value for key, value in entries.items()}
        return TensorDict({**entries, "contact": torch.as_tensor(self.stands.copy())})

    def _push(self) -> None:
        """Begins or ends a force on the base."""
        force = self.data.xfrc_applied[self.base]
        self.pushed -= 1
        if self.pushed <= 0:
            force[:] = 0.0
            if self.random.random() < self.dt:
                force[:2], self.pushed = self.pushes * self.random.standard_normal(2), round(0.1 / self.dt)

    def _simulate(self) -> None:
        """Runs one step of the simulator."""
        mujoco.mj_step(self.model, self.data)

    def _with_errors(self, imu: np.ndarray) -> dict:
        e, draw, root = self.errors, self.random.standard_normal, math.sqrt(self.dt)
        self.bias = self.bias + root * np.array([e.gyro_walk] * 3 + [e.accelerometer_walk] * 3) * draw(6)
        white = np.array([e.gyro] * 3 + [e.accelerometer] * 3) / root * draw(6)
        joints = self.data.qpos[self.columns] + self.offset + e.joint * draw(len(self.columns))
        rates = self.data.qvel[self.rows] + e.joint_rate * draw(len(self.columns))
        return {"imu": imu + self.bias + white, "joints": joints, "joint_rates": rates}

    def _forces(self) -> np.ndarray:
        """Returns the contact force of each foot, in N."""
        found, six = np.zeros(len(self.feet)), np.empty(6)
        bodies = self.model.geom_bodyid[self.data.contact.geom]  # [contacts, 2]
        for place, body in enumerate(self.feet):
            for number in np.flatnonzero((bodies == body).any(1)):
                mujoco.mj_contactForce(self.model, self.data, number, six)
                found[place] += six[0]
        return found


def on_floor(robot: ElementTree.Element, assets: dict, friction: float, softness: float) -> mujoco.MjModel:
    """Returns the model of a dm_control robot on a floor, with settings for accurate sensors.

    Args:
        robot: its MJCF.
        assets: files that it includes.
        friction: friction coefficient of feet and floor.
        softness: time constant of the contact, in s.

    Raises:
        ValueError: if a number is not above zero.
    """
    check_number("friction", friction, above=0)
    check_number("softness", softness, above=0)
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(robot, encoding="unicode"), assets)
    model.opt.timestep = 0.0025
    model.opt.cone, model.opt.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 30.0  # feet that stand do not creep
    # With implicit damping the simulated accelerometer deviates from the motion by a third.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    model.geom_friction[:, 0], model.geom_solref[:, 0] = friction, softness
    return model


def _is_site(model: mujoco.MjModel, name: str) -> bool:
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name) >= 0


def _floats(value: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(value, dtype=torch.float32).clone()
