"""``denkf info``: what is installed, and what is missing."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from torch_denkf.cli.command import Command, say

__all__ = ["Info"]

_PACKAGES = ("torch_denkf", "torch", "torchrl", "tensordict", "mujoco", "dm_control", "opencv-python-headless")
#: Optional extras by name: the modules that they bring, and what for.
_EXTRAS = {
    "plots": (("matplotlib", "PIL"), "pictures"),
    "examples": (("matplotlib", "tensorboard"), "the example programs"),
    "lerobot": (("pyarrow", "av"), "LeRobot recordings"),
    "ros": (("rosbags", "yaml"), "ROS bags and settings"),
    "onnx": (("onnx", "onnxscript", "onnxruntime"), "steps as ONNX models"),
    "ray": (("ray",), "collection over machines"),
}
_DRAW = """
import mujoco
from torch_denkf.applications.ur5.simulation.render import Renderer
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><camera name='front'/></worldbody></mujoco>")
Renderer(model, (8, 8)).close()
"""


def _version(package: str) -> str:
    for name in (package, f"{package}-nightly"):
        with suppress(PackageNotFoundError):
            return version(name)
    import torch_denkf

    return torch_denkf.__version__ if package == "torch_denkf" else "missing"


def _devices() -> str:
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    gpus = (
        [torch.cuda.get_device_name(n) for n in range(torch.cuda.device_count())] if torch.cuda.is_available() else []
    )
    return ", ".join([f"{cores} CPU cores, {torch.get_num_threads()} torch threads", *(gpus or ["no GPU"])])


def _opengl() -> str:
    # In a process of its own: a driver that is broken can end the process.
    try:
        done = subprocess.run([sys.executable, "-c", _DRAW], capture_output=True, text=True, timeout=60, check=False)
    except subprocess.TimeoutExpired:
        return "no: MuJoCo did not draw within 60 s"
    lines = done.stderr.strip().splitlines()
    return "yes, MuJoCo can draw" if done.returncode == 0 else f"no: {lines[-1] if lines else done.returncode}"


def _compiler() -> str:
    from torch_denkf.compilation import need_compiler

    try:
        need_compiler()
    except (ImportError, RuntimeError) as error:
        return f"no: {' '.join(str(error).split())}"
    return "yes, torch.compile works on the CPU"


def _cache() -> str:
    from torch_denkf.data.cache import usual_folder

    folder = usual_folder()
    if not folder.is_dir():
        return f"{folder} (not there yet)"
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    return f"{folder}, {size / 1e6:.1f} MB; may be deleted at any time: denkf cache"


def _extra(name: str) -> str:
    modules, what = _EXTRAS[name]
    missing = [module for module in modules if find_spec(module) is None]
    if not missing:
        return f"yes, {what}"
    return f'no {", ".join(missing)}, for {what}: pip install "torch_denkf[{name}]"'


@dataclass
class Info(Command):
    """Versions, devices, OpenGL, cache, C++ compiler, optional extras."""

    name, example = "info", "denkf info"

    def run(self) -> None:
        """Looks at everything and says it."""
        lines = {package: _version(package) for package in _PACKAGES}
        lines |= {"Python": f"{platform.python_version()}, {platform.platform()}", "devices": _devices()}
        lines |= {"OpenGL": _opengl(), "C++ compiler": _compiler(), "cache": _cache()}
        lines |= {f"extra {name}": _extra(name) for name in _EXTRAS}
        import torch_denkf

        lines["installed in"] = str(Path(torch_denkf.__file__).parent)
        for name, text in lines.items():
            say(f"{name:<24}{text}")
