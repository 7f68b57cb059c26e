"""A simulated UR5 at a table: pick, push and put-down, with a camera in front of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torch_denkf._arguments import Checked

if TYPE_CHECKING:
    from torch_denkf.applications.ur5.simulation.camera import Camera
    from torch_denkf.applications.ur5.simulation.render import Renderer

__all__ = ["UR5TableEnv"]

STEPS = 350
GRIPPER_RANGE = 0.8  # rad


class UR5TableEnv(Checked, EnvBase):
    """A UR5 with a two-finger gripper that picks, pushes or puts down an object, in MuJoCo, 0.08 s a step.

    Emits, at reset and at each step:

    ===================== =========== =============================================================================
    key                   shape       content
    ===================== =========== =============================================================================
    ``pixels``            [3,H,W]     float32 in [0, 1] (or uint8), from in front of the table; unless
                                      ``from_pixels=False``
    ``observed``          [1]         bool, next to ``pixels``: this step was drawn (see ``render_at``); what was not
                                      is zero
    ``state``             [10]        float32, the truth: J1..J6 rad; J7, the gripper's opening, from 0 (shut) to
                                      0.8 rad (85 mm); x, y, z m of the point between the finger tips, from the
                                      centre of the table's top (x away from the base, z up)
    ``success``           [1]         bool: the task is done at this moment
    ``expert``/``action`` [7]         float32, privileged: what :class:`UR5Expert` does next
    ``expert``/``object`` [3]         float32, privileged: the object's centre, m from the table's centre
    ``expert``/``goal``   [3]         float32, privileged: where its centre has to go (pick: at least as high)
    ===================== =========== =============================================================================

    The reward is one where ``success`` holds. The action ``[7]`` is the target of the six joints (rad) and the opening
    (rad) at the step's end; joint rates are limited as in a UR5 (180 degrees per second), and the fingers open or close
    in half a second. Episodes are truncated after ``max_steps``. Random actions (``rollout`` without a policy) stay
    near the current pose.

    Each reset samples the object (box or cylinder, size, colour, position, rotation), the goal, the home pose, the tilt
    of the tool (0.3 rad; straight down, wrist 2 would never move) and the expert's pace, all from the environment's own
    generator: after ``set_seed(n)`` the same actions give the same episodes bit for bit (pixels on the same machine and
    OpenGL library), with and without pixels.

    Success. Pick: the object hangs 8 cm above the table. Push: it stands within 3 cm of the goal. Put-down: that too,
    and the gripper is 7 cm away.

    **Domains.** ``"sim"`` is a clean simulation. ``"real_like"`` is a *stand-in* for a real laboratory, because no real
    arm is at hand: other textures, light, camera pose and lens (barrel distortion), motion blur, sensor noise, a frame
    that is one step late, joints with friction that stand up to 0.9 degrees from where they were commanded. It shows
    whether a filter survives a change of domain; it does not show how it would do on a particular real robot.

    Images need OpenGL, which is opened at the first image: EGL if neither ``MUJOCO_GL`` nor a display is set (Debian
    packages libegl1 and libgl1-mesa-dri), or ``MUJOCO_GL=osmesa`` (libosmesa6). ``close()`` frees it. In a ParallelEnv,
    spawn the workers (torchrl's default); with forked ones OpenGL hangs.

    Args:
        task: ``"pick"``, ``"push"`` or ``"put_down"``.
        domain: ``"sim"`` or ``"real_like"``.
        size: (H, W) of the pixels.
        from_pixels: whether to emit pixels.
        pixels_dtype: ``torch.float32``, in [0, 1], or ``torch.uint8``.
        render_at: the steps to render (0 is the reset), for data sets with few frames of many episodes: all if None,
            those in a collection, or a number of random ones, sampled at each reset. Also an attribute.
        max_steps: length of an episode. The expert needs 320 to 345 steps.
        seed: by default drawn from torch's generator.
        device: of all outputs.

    Raises:
        ValueError: for an unknown task, domain or type of pixels.
        ImportError: if mujoco is not installed.
        RuntimeError: at the first picture, if there is no OpenGL library; the message names the packages.

    Examples:
        >>> from torch_denkf.applications.ur5.envs.expert import UR5Expert
        >>> env = UR5TableEnv("pick", from_pixels=False, seed=0)
        >>> rollout = env.rollout(350, UR5Expert(env))
        >>> rollout["next", "state"].shape, rollout["next", "success"][-1].item()
        (torch.Size([350, 10]), True)
    """

    def __init__(
        self,
        task: Literal["pick", "push", "put_down"] = "pick",
        domain: Literal["sim", "real_like"] = "sim",
        *,
        size: tuple[int, int] = (224, 224),
        from_pixels: bool = True,
        pixels_dtype: torch.dtype = torch.float32,
        render_at: int | Iterable[int] | None = None,
        max_steps: int = STEPS,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ):
        # These need mujoco, which importing this package must not.
        from torch_denkf.applications.ur5.simulation import domains, tasks
        from torch_denkf.applications.ur5.simulation import scene as scenes

        if task not in tasks.TASKS:
            raise ValueError(f"unknown task {task!r}; there are {', '.join(tasks.TASKS)}")
        if domain not in domains.DOMAINS:
            raise ValueError(f"unknown domain {domain!r}; there are {', '.join(domains.DOMAINS)}")
        if pixels_dtype not in (torch.float32, torch.uint8):
            raise ValueError(f"pixels are torch.float32 or torch.uint8, not {pixels_dtype}")
        super().__init__(batch_size=torch.Size([]), device=device)
        height, width = size
        self.task, self.domain, self.size, self.max_steps = task, domain, (height, width), max_steps
        self.from_pixels, self.pixels_dtype, self.render_at = from_pixels, pixels_dtype, render_at
        self._tasks, self._domains, self._look = tasks, domains, domains.DOMAINS[domain]
        self._scene = scenes.UR5Scene(self.size)
        domains.apply_domain(self._scene, self._look)
        self._camera: Camera | None = None
        self._renderer: Renderer | None = None
        self._set_specs()
        self._set_seed(int(torch.randint(2**31, ())) if seed is None else seed)

    def _set_specs(self) -> None:
        flag = Binary(shape=(1,), dtype=torch.bool)
        low, high = torch.full((7,), -2 * torch.pi), torch.full((7,), 2 * torch.pi)
        low[6], high[6] = 0.0, GRIPPER_RANGE
        seen = {}
        if self.from_pixels:
            top = 255 if self.pixels_dtype == torch.uint8 else 1.0
            seen["pixels"] = Bounded(0, top, (3, *self.size), dtype=self.pixels_dtype)
            seen["observed"] = flag.clone()
        self.observation_spec = Composite(
            **seen,
            state=Unbounded((10,)),
            success=flag.clone(),
            expert=Composite(action=Unbounded((7,)), object=Unbounded((3,)), goal=Unbounded((3,))),
        )
        self.action_spec = Bounded(low, high, (7,), dtype=torch.float32)
        self.reward_spec = Unbounded((1,))
        self.full_done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone())

    def _set_seed(self, seed: int | None) -> None:
        self.rng = np.random.default_rng(0 if seed is None else seed)

    # ------------------------------------------------------------------------------------------------- the episode

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        # Streams of their own: pixels and the choice of frames leave the episode as it is.
        streams = np.random.SeedSequence(int(self.rng.integers(2**63))).spawn(3)
        draws, self._noise, frames = (np.random.default_rng(stream) for stream in streams)
        scene = self._scene
        scene.forget()
        self._episode = episode = self._tasks.draw_episode(scene, self.task, draws, STEPS)
        scene.shape_object(episode.kind, episode.half_size, episode.colour)
        scene.show_goal(None if self.task == "pick" else episode.goal)
        settle = 75 if self.task == "put_down" else 0  # 0.3 s in which the fingers close
        scene.reset(episode.joints, episode.position, episode.rotation, settle)
        self._domains.light_of_episode(scene, self._look, 1 + self._look.flicker * self._noise.standard_normal())
        self._now = 0
        self._shots = deque([self._exposure()] * (1 + self._look.delay), maxlen=1 + self._look.delay)
        self._drawn: set[int] | None
        if isinstance(self.render_at, int):
            count = min(self.render_at, self.max_steps + 1)
            self._drawn = {int(step) for step in frames.choice(self.max_steps + 1, count, replace=False)}
        else:
            self._drawn = None if self.render_at is None else set(self.render_at)
        return self._emit()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self._scene.step(tensordict["action"].cpu().double().numpy())
        self._now += 1
        self._shots.append(self._exposure())
        out = self._emit()
        return out.set("reward", out["success"].float())

    def _emit(self) -> TensorDict:
        scene, episode = self._scene, self._episode
        success = torch.tensor([self._tasks.succeeded(scene, self.task, episode)])
        truncated = torch.tensor([self._now >= self.max_steps])
        expert = {
            "action": _float32(episode.path[min(self._now, STEPS - 1)]),
            "object": _float32(scene.object_position()),
            "goal": _float32(episode.goal),
        }
        out = {
            "state": _float32(scene.state()),
            "success": success,
            "expert": TensorDict(expert),
            "done": truncated,
            "truncated": truncated.clone(),
            "terminated": torch.zeros_like(truncated),
        }
        if self.from_pixels:
            observed = self._drawn is None or self._now in self._drawn
            out["pixels"] = self._frame() if observed else torch.zeros(3, *self.size, dtype=self.pixels_dtype)
            out["observed"] = torch.tensor([observed])
        return TensorDict(out, device=self.device)

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Writes a random action within 3 degrees of the last action, from torch's generator."""
        near = torch.from_numpy(self._scene.target).float() + 0.05 * (2 * torch.rand(7) - 1)
        tensordict = TensorDict(device=self.device) if tensordict is None else tensordict
        return tensordict.set("action", self.action_spec.project(near.to(self.action_spec.device)))

    # ------------------------------------------------------------------------------------------------ the pictures

    def render_state(self, state: Tensor, *, ghosts: Tensor | None = None, scenery: bool = True) -> Tensor:
        """Renders the arm at a state, e.g. a belief's mean, with the object at its current position.

        The domain's textures, light, camera and lens apply, its blur, noise and delay do not.

        Args:
            state: ``[*N, S]``; the first seven are J1..J7 in rad, the others are ignored.
            ghosts: ``[*N, G, S]``, e.g. an ensemble's members: G further arms, translucent and orange.
            scenery: ``False`` omits object and goal, which are not part of a belief about the arm.

        Returns:
            ``[*N, 3, H, W]``, in the format of ``pixels``.

        Raises:
            ValueError: if the shapes of ``state`` and ``ghosts`` do not fit, or there are some hundred ghosts.
        """
        if ghosts is None:
            ghosts = state.new_zeros(*state.shape[:-1], 0, state.shape[-1])
        elif ghosts.ndim != state.ndim + 1 or ghosts.shape[:-2] != state.shape[:-1] or ghosts.shape[-1] < 7:
            raise ValueError(
                f"ghosts are [*N, G, S] next to a state [*N, S], not {list(ghosts.shape)} next to {list(state.shape)}"
            )
        rows = state.detach().cpu().double().reshape(-1, state.shape[-1]).numpy()
        members = ghosts.detach().cpu().double().reshape(len(rows), *ghosts.shape[-2:]).numpy()
        (camera, renderer), pose_with = self._open(), self._scene.pose_with
        pictures = [
            camera.lens(self._draw(renderer, pose_with(row[:7]), [pose_with(g[:7]) for g in group], scenery))
            for row, group in zip(rows, members, strict=True)
        ]
        return torch.stack(list(map(self._tensor, pictures))).reshape(*state.shape[:-1], 3, *self.size).to(state.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Frees the renderer; it is opened again for the next image."""
        renderer, self._renderer = self.__dict__.get("_renderer"), None
        if renderer is not None:
            renderer.close()
        super().close(raise_if_closed=raise_if_closed)

    def _exposure(self) -> list[np.ndarray]:
        return self._scene.poses[-self._look.exposures :]

    def _frame(self) -> Tensor:
        camera, renderer = self._open()
        return self._tensor(camera.expose([self._draw(renderer, pose) for pose in self._shots[0]], self._noise))

    def _open(self) -> tuple[Camera, Renderer]:
        if self._camera is None or self._renderer is None:
            from torch_denkf.applications.ur5.simulation.camera import Camera
            from torch_denkf.applications.ur5.simulation.render import GHOSTS, SCENERY, Renderer

            model = self._scene.model
            model.geom_group[model.body_rootid[model.geom_bodyid] == model.body("base").id] = GHOSTS
            model.geom_group[[self._scene.object_geom, self._scene.goal_geom]] = SCENERY

            self._camera = Camera(self.size, self._look.distortion, self._look.noise)
            self._renderer = Renderer(model, self.size)
            self.is_closed = False  # for EnvBase.__del__
        return self._camera, self._renderer

    def _draw(
        self, renderer: Renderer, pose: np.ndarray, ghosts: Iterable[np.ndarray] = (), scenery: bool = True
    ) -> np.ndarray:
        from torch_denkf.applications.ur5.simulation.render import GHOSTS, PLAIN, SCENERY

        groups = (PLAIN, GHOSTS, SCENERY) if scenery else (PLAIN, GHOSTS)
        posed = self._scene.posed
        return renderer.draw(posed(pose), (posed(ghost) for ghost in ghosts), groups)

    def _tensor(self, picture: np.ndarray) -> Tensor:
        planes = picture.transpose(2, 0, 1)
        if self.pixels_dtype == torch.uint8:
            return torch.from_numpy(np.ascontiguousarray(planes))
        return torch.from_numpy(np.divide(planes, np.float32(255), out=np.empty(planes.shape, np.float32)))


def _float32(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(values, dtype=np.float32))
