"""Forward kinematics of a robot's feet."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import torch
from torch import Tensor, nn

from torch_denkf.functional.manifolds import SE3, SO3, quaternion_product, rotate

__all__ = ["LegKinematics"]

_OBJECTS = {"site": mujoco.mjtObj.mjOBJ_SITE, "body": mujoco.mjtObj.mjOBJ_BODY}
_FREE, _HINGE, _SLIDE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("FREE", "HINGE", "SLIDE"))


class LegKinematics(nn.Module):
    """Positions and velocities of feet in an inertial sensor's axes, by joint angles, for any batch.

    The kinematic chain of each foot is extracted from the model once; chains are padded to one length and computed in
    parallel. The result is that of ``mujoco.mj_kinematics``, and differentiable. The sensor must be fixed to the base.

    Args:
        model: a ``mujoco.MjModel``, from MJCF or URDF.
        feet: names of sites or bodies, F.
        imu: name of the site or body that is the reference frame of the positions.
        joints: names of the joints in the order in which angles are given, J; ``None`` for all hinges and slides in the
            model's order. Joints outside of the legs are allowed.

    Attributes:
        base: pose of the sensor in the base's frame ``[7]``, a point of ``SE3``, in m.

    Raises:
        KeyError: if the model has no such site, body or joint, or ``joints`` lacks one that moves a foot.
        TypeError: if the model is none, or a name is no string.
        ValueError: if a joint moves the sensor on the base, or a foot does not hang on the base.

    Example:
        >>> leg = '''<mujoco><worldbody><body name="base"><freejoint/><geom size=".1"/><site name="imu"/>
        ...   <body><joint name="knee" axis="0 1 0"/><geom size=".1"/><site name="foot" pos="0 0 -1"/></body>
        ... </body></worldbody></mujoco>'''
        >>> kinematics = LegKinematics(mujoco.MjModel.from_xml_string(leg), ["foot"], "imu")
        >>> kinematics(torch.tensor([torch.pi / 2])).round(decimals=4) + 0.0
        tensor([[-1.,  0.,  0.]])
    """

    base: Tensor
    fixed: Tensor
    hinge: Tensor
    slide: Tensor
    zero: Tensor
    column: Tensor

    def __init__(self, model: mujoco.MjModel, feet: Sequence[str], imu: str, *, joints: Sequence[str] | None = None):
        super().__init__()
        if not isinstance(model, mujoco.MjModel):
            raise TypeError(f"model is a mujoco.MjModel; got {type(model).__name__}.")
        check_names("feet", feet)
        check_names("imu", [imu])
        if joints is not None:
            check_names("joints", joints)
        self.feet, self.joints = list(feet), _joint_names(model) if joints is None else list(joints)
        sensor_body, sensor = _frame(model, "imu", imu)
        root = sensor_body
        while model.body_parentid[root] and not _moving_joints(model, root):
            sensor, root = SE3().compose(_pose(model, root), sensor), model.body_parentid[root]
        if _moving_joints(model, root):
            raise ValueError(f"Joints {_moving_joints(model, root)} move {imu!r}: name a site or body on the base.")
        chains = [self._chain(model, name, root, SE3().inverse(sensor)) for name in self.feet]
        length = max(len(steps) for _, steps in chains)
        still = (SE3().neutral().double(), torch.zeros(3).double(), torch.zeros(3).double(), 0.0, 0)
        rows = [[*steps, *[still] * (length - len(steps))] for _, steps in chains]
        fixed = torch.stack(
            [torch.stack([first, *(step[0] for step in row)]) for (first, _), row in zip(chains, rows, strict=True)]
        )
        self._keep("base", sensor)
        self._keep("fixed", fixed)  # [F, K + 1, 7]
        for place, name in enumerate(("hinge", "slide"), 1):  # the axis, or zero; [F, K, 3]
            self._keep(name, torch.stack([torch.stack([step[place] for step in row]) for row in rows]))
        self._keep("zero", torch.tensor([[step[3] for step in row] for row in rows]))
        self.register_buffer("column", torch.tensor([[step[4] for step in row] for row in rows]), persistent=False)

    def forward(self, positions: Tensor) -> Tensor:
        """Returns positions ``[*, F, 3]`` in m, by angles ``[*, J]`` in rad (slides in m)."""
        return self._along(positions)[0]

    def velocities(self, positions: Tensor, rates: Tensor) -> Tensor:
        """Returns velocities ``[*, F, 3]`` in m/s as seen from the base, by angles and rates ``[*, J]``."""
        return self.moving(positions, rates)[1]

    def moving(self, positions: Tensor, rates: Tensor) -> tuple[Tensor, Tensor]:
        """Returns positions and velocities, in one pass."""
        end, jacobian = self._with_jacobian(positions)
        return end, (jacobian * rates[..., self.column].unsqueeze(-1)).sum(-2)

    def jacobian(self, positions: Tensor) -> Tensor:
        """Returns derivatives ``[*, F, K, 3]`` of positions by the K joints of each foot, zero where it has fewer."""
        return self._with_jacobian(positions)[1]

    def _with_jacobian(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        end, axes, slides, places = self._along(positions)
        lever = end.unsqueeze(-2) - places
        return end, torch.linalg.cross(axes, lever) + slides

    def _along(self, positions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns the feet, and the rotation axis, slide direction and position of each joint."""
        moved = positions[..., self.column] - self.zero
        length = self.zero.shape[-1]
        turn = self.fixed[:, 0, :4].expand(*moved.shape[:-1], 4)
        place = self.fixed[:, 0, 4:].expand(*moved.shape[:-1], 3)
        axes, slides, places = [], [], []
        for joint in range(length):
            by = moved[..., joint : joint + 1]
            axes.append(rotate(turn, self.hinge[:, joint]))
            slides.append(rotate(turn, self.slide[:, joint]))
            places.append(place)
            place = place + by * slides[-1]
            turn = quaternion_product(turn, SO3().exp(by * self.hinge[:, joint]))
            place = place + rotate(turn, self.fixed[:, joint + 1, 4:])
            turn = quaternion_product(turn, self.fixed[:, joint + 1, :4].expand_as(turn))
        if not length:
            empty = place.new_zeros(*place.shape[:-1], 0, 3)
            return place, empty, empty, empty
        return place, torch.stack(axes, -2), torch.stack(slides, -2), torch.stack(places, -2)

    def _chain(self, model, name, root, to_sensor):
        """Returns a fixed pose, then joints: the pose behind each, its axes, its zero and its column."""
        body, behind = _frame(model, "feet", name)
        steps: list[tuple] = []
        while body != root:
            if not body:
                raise ValueError(f"{name!r} does not hang on the base {model.body(root).name!r}.")
            for joint in reversed(_moving_joints(model, body)):
                number = model.joint(joint).id
                if joint not in self.joints:
                    raise KeyError(f"{joint!r} moves {name!r}, and is not among joints={self.joints}.")
                kind, axis = model.jnt_type[number], torch.from_numpy(model.jnt_axis[number].copy())
                if kind not in (_HINGE, _SLIDE):
                    raise ValueError(f"{joint!r} is neither a hinge nor a slide.")
                anchor = torch.cat(
                    [torch.tensor([1.0, 0, 0, 0]).double(), torch.from_numpy(model.jnt_pos[number].copy())]
                )
                axes = [axis if kind == which else torch.zeros_like(axis) for which in (_HINGE, _SLIDE)]
                zero = float(model.qpos0[model.jnt_qposadr[number]])
                steps.insert(0, (SE3().compose(SE3().inverse(anchor), behind), *axes, zero, self.joints.index(joint)))
                behind = anchor
            behind, body = SE3().compose(_pose(model, body), behind), model.body_parentid[body]
        return SE3().compose(to_sensor, behind), steps

    def _keep(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value.to(torch.get_default_dtype()), persistent=False)


def check_names(argument: str, names: Sequence[str]) -> None:
    """Raises unless an argument is a list of names, each once.

    Raises:
        TypeError: if it is something else.
        ValueError: if it is empty, or a name comes twice.
    """
    if not isinstance(names, (list, tuple)) or not all(isinstance(name, str) and name for name in names):
        raise TypeError(f"{argument} takes names, strings; got {names!r}.")
    if not names or len(set(names)) < len(names):
        raise ValueError(f"{argument} takes one name or more, each once; got {list(names)}.")


def _frame(model: mujoco.MjModel, argument: str, name: str) -> tuple[int, Tensor]:
    """Returns the body of a site or body, and its pose in that body's frame ``[7]``."""
    for kind, number in _OBJECTS.items():
        found = mujoco.mj_name2id(model, number, name)
        if found >= 0 and kind == "site":
            return int(model.site_bodyid[found]), _point(model.site_quat[found], model.site_pos[found])
        if found >= 0:
            return found, SE3().neutral().double()
    sites = [model.site(place).name for place in range(model.nsite)]
    bodies = [model.body(place).name for place in range(model.nbody)]
    raise KeyError(f"{argument}: the model has no site or body {name!r}. Its sites: {sites}; its bodies: {bodies}.")


def _pose(model: mujoco.MjModel, body: int) -> Tensor:
    """Returns the pose of a body in its parent's frame, at joint positions of zero."""
    return _point(model.body_quat[body], model.body_pos[body])


def _point(quaternion, position) -> Tensor:
    return torch.cat([torch.from_numpy(quaternion.copy()), torch.from_numpy(position.copy())])


def _moving_joints(model: mujoco.MjModel, body: int) -> list[str]:
    """Returns the names of a body's joints, without free joints."""
    first = model.body_jntadr[body]
    joints = range(first, first + model.body_jntnum[body])
    return [model.joint(joint).name for joint in joints if model.jnt_type[joint] != _FREE]


def _joint_names(model: mujoco.MjModel) -> list[str]:
    return [model.joint(joint).name for joint in range(model.njnt) if model.jnt_type[joint] in (_HINGE, _SLIDE)]
