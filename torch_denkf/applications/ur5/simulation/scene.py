"""The UR5 table as a MuJoCo model: names, the state that is read from it, and one control step."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from torch_denkf.applications.ur5.simulation.names import CONTROL_STEP

__all__ = ["ARM_JOINTS", "CONTROL_STEP", "FULL_OPENING", "UR5Scene"]

ASSET = Path(__file__).with_name("assets") / "ur5_table.xml"
ARM_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
FULL_OPENING = 0.8  # rad: J7 of an open gripper, 85 mm between the fingers
FINGER_TRAVEL = 0.0425  # m, each finger's
JOINT_SPEED = np.pi * CONTROL_STEP  # rad a step: a UR5's joints turn 180 degrees a second
GRIPPER_SPEED = 0.12  # rad a step: full stroke in half a second
SUBSTEPS, CHUNKS = 20, 4  # the targets are interpolated between control steps, as a UR5's servoj does


class UR5Scene:
    """Model and data of the table, with the indices that the environment reads and sets.

    Attributes:
        model: ``mujoco.MjModel``.
        data: ``mujoco.MjData`` of the simulation.
        scratch: ``mujoco.MjData`` for kinematics and pictures; the simulation never sees it.
        offset: rad ``[6]``, the joint's true angle less the commanded one.
        target: rad ``[7]``, the commanded joints and opening at the last control step.
    """

    def __init__(self, offscreen: tuple[int, int] = (224, 224)):
        self.model = mujoco.MjModel.from_xml_path(str(ASSET))
        self.model.vis.global_.offheight, self.model.vis.global_.offwidth = offscreen
        self.data, self.scratch = mujoco.MjData(self.model), mujoco.MjData(self.model)
        joint = self.model.joint
        self.arm_qpos = np.array([joint(name).qposadr[0] for name in ARM_JOINTS])
        self.arm_dofs = np.array([joint(name).dofadr[0] for name in ARM_JOINTS])
        self.finger_qpos = np.array([joint(name).qposadr[0] for name in ("finger_left", "finger_right")])
        self.object_qpos = slice(joint("object").qposadr[0], joint("object").qposadr[0] + 7)
        self.object_geom, self.goal_geom = self.model.geom("object").id, self.model.geom("goal").id
        self.object_body = self.model.body("object").id
        self.pinch, self.centre = self.model.site("pinch").id, self.model.site("table_centre").id
        self.offset, self.target = np.zeros(6), np.zeros(7)
        self.poses: list[np.ndarray] = []

    # ------------------------------------------------------------------------------------------------ what is there

    def state(self, data: mujoco.MjData | None = None) -> np.ndarray:
        """Returns ten numbers: J1..J6 in rad, the opening J7 in rad, the pinch point from the table's centre in m."""
        data = self.data if data is None else data
        opening = data.qpos[self.finger_qpos].mean() * (FULL_OPENING / FINGER_TRAVEL)
        tool = data.site_xpos[self.pinch] - data.site_xpos[self.centre]
        return np.concatenate([data.qpos[self.arm_qpos], [opening], tool])

    def object_position(self) -> np.ndarray:
        """Returns the object's centre from the table's centre, m ``[3]``."""
        return self.data.xpos[self.object_body] - self.data.site_xpos[self.centre]

    def object_upright(self) -> float:
        """Returns the cosine of the angle between the object's axis and the vertical."""
        return float(self.data.xmat[self.object_body, 8])

    def pose_with(self, joints: np.ndarray) -> np.ndarray:
        """Returns the present ``qpos`` with other joints ``[7]`` (rad)."""
        qpos = self.data.qpos.copy()
        qpos[self.arm_qpos] = joints[:6]
        qpos[self.finger_qpos] = np.clip(joints[6] / FULL_OPENING, 0, 1) * FINGER_TRAVEL
        return qpos

    def posed(self, qpos: np.ndarray) -> mujoco.MjData:
        """Returns the scratch data in this pose, for kinematics and pictures."""
        self.scratch.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.scratch)
        return self.scratch

    # -------------------------------------------------------------------------------------------------- what is set

    def shape_object(self, kind: str, half_size: np.ndarray, colour: np.ndarray) -> None:
        """Makes the object a box (half sizes) or a cylinder (radius, radius, half height), in place."""
        model, geom, mass = self.model, self.object_geom, 0.1
        x, y, z = half_size
        if kind == "box":
            model.geom_type[geom], model.geom_size[geom] = mujoco.mjtGeom.mjGEOM_BOX, half_size
            radius, inertia = (
                np.linalg.norm(half_size),
                mass / 3 * np.array([y * y + z * z, x * x + z * z, x * x + y * y]),
            )
        else:
            model.geom_type[geom], model.geom_size[geom] = mujoco.mjtGeom.mjGEOM_CYLINDER, [x, z, 0.0]
            side = mass * (x * x / 4 + z * z / 3)
            radius, inertia = np.hypot(x, z), np.array([side, side, mass * x * x / 2])
        model.geom_rbound[geom], model.geom_aabb[geom] = radius, [0, 0, 0, *half_size]
        model.geom_rgba[geom, :3] = colour
        model.body_mass[self.object_body], model.body_inertia[self.object_body] = mass, inertia

    def show_goal(self, position: np.ndarray | None) -> None:
        """Puts the goal's disc on the table, or hides it."""
        self.model.geom_rgba[self.goal_geom, 3] = 0.0 if position is None else 1.0
        if position is not None:
            self.model.geom_pos[self.goal_geom, :2] = position[:2]

    def forget(self) -> None:
        """Keeps nothing of the last episode, controls and warm start included.

        Also where inverse kinematics are solved: they would start from where the fingers were, and end at a difference
        in the last bit, which contacts make larger.
        """
        for data in (self.data, self.scratch):
            mujoco.mj_resetData(self.model, data)

    def reset(self, joints: np.ndarray, position: np.ndarray, rotation: np.ndarray, settle: int = 0) -> None:
        """Resets the scene, at rest, with these joints ``[7]`` and the object there (quaternion).

        Args:
            joints: rad, true ones; the commands are theirs less the offset.
            position: of the object, m.
            rotation: of the object, a quaternion w, x, y, z.
            settle: simulation steps without gravity, in which the fingers close on what is between them.
        """
        self.forget()
        self.data.qpos[:] = self.pose_with(joints)
        self.data.qpos[self.object_qpos] = np.concatenate([position, rotation])
        self.target = np.concatenate([joints[:6] - self.offset, joints[6:7]])
        self.data.ctrl[:] = self._controls(self.target)
        if settle:
            gravity = self.model.opt.gravity.copy()
            self.model.opt.gravity[:] = 0.0
            self.target[6] = 0.0
            self.data.ctrl[:] = self._controls(self.target)
            mujoco.mj_step(self.model, self.data, settle)
            self.model.opt.gravity[:] = gravity
            self.data.qvel[:] = 0.0
            self.data.time = 0.0
        mujoco.mj_forward(self.model, self.data)
        self.poses = [self.data.qpos.copy()] * CHUNKS

    def step(self, action: np.ndarray) -> None:
        """Runs one control step of 0.08 s to the commanded joints and opening ``[7]``, at a UR5's speed at most."""
        low, high = self.target.copy(), self.target.copy()
        low[:6] -= JOINT_SPEED
        high[:6] += JOINT_SPEED
        low[6] -= GRIPPER_SPEED
        high[6] += GRIPPER_SPEED
        before, self.target = self.target, np.clip(action, low, high)
        self.target[6] = np.clip(self.target[6], 0.0, FULL_OPENING)
        self.poses = []
        for chunk in range(1, CHUNKS + 1):
            self.data.ctrl[:] = self._controls(before + (self.target - before) * (chunk / CHUNKS))
            mujoco.mj_step(self.model, self.data, SUBSTEPS // CHUNKS)
            self.poses.append(self.data.qpos.copy())
        mujoco.mj_kinematics(self.model, self.data)  # mj_step leaves the positions of one substep before

    def _controls(self, target: np.ndarray) -> np.ndarray:
        # A closed gripper presses: its target lies 4 mm behind the point where the fingers meet.
        travel = target[6] / FULL_OPENING * (FINGER_TRAVEL + 0.004) - 0.004
        return np.concatenate([target[:6] + self.offset, [travel]])
