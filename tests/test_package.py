"""The package as a user gets it: what a wheel holds, and what an import costs."""

import ast
import json
import os
import re
import subprocess
import sys
import zipfile
from importlib import import_module
from pathlib import Path

import pytest

import torch_denkf
from tests.pretrained import beliefs

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Built from a copy: setuptools writes build/ and *.egg-info next to the sources."""
    source = tmp_path_factory.mktemp("source")
    files = ["setup.py", "pyproject.toml", "README.md", "LICENSE", "torch_denkf", "modules", "tests", "benchmarks"]
    names = [name for name in [*files, "examples"] if (ROOT / name).exists()]
    pack = subprocess.Popen(["tar", "-C", ROOT, "-c", "--exclude=__pycache__", *names], stdout=subprocess.PIPE)
    subprocess.run(["tar", "-C", source, "-x"], stdin=pack.stdout, check=True)
    assert pack.wait() == 0
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", out, source]
    subprocess.run(command, check=True, capture_output=True, cwd=out)
    (path,) = out.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        yield archive


# All that needs the wheel is in one test, so that pytest-xdist builds it in one process alone.
def test_the_wheel_holds_the_package_alone(wheel, tmp_path):
    names = wheel.namelist()
    top = {name.split("/")[0] for name in names}
    (info,) = (name for name in top if name.endswith(".dist-info"))
    assert top == {"torch_denkf", info}
    package = ROOT / "torch_denkf"
    kinds = ("*.py", "*.pyi", "*.xml", "py.typed", "weights/*/*")
    sources = {str(path.relative_to(ROOT)) for kind in kinds for path in package.rglob(kind)}
    assert "torch_denkf/py.typed" in sources, "without it no type checker reads the annotations"
    assert {name for name in names if name.startswith("torch_denkf/")} == sources
    assert any(name.startswith(info) and name.endswith("LICENSE") for name in names)
    metadata = wheel.read(f"{info}/METADATA").decode()
    assert "License-Expression: MIT" in metadata or "License: MIT" in metadata
    assert "License-File: LICENSE" in metadata
    for pin in ("torch>=2.13", "torchrl>=0.14.1", "tensordict>=0.14.3", "mujoco<4,>=3.17"):
        assert f"Requires-Dist: {pin}\n" in metadata
    assert "Requires-Python: >=3.11\n" in metadata
    assert f"Version: {torch_denkf.__version__}\n" in metadata
    assert "Name: torch_denkf" in metadata or "Name: torch-denkf" in metadata
    check_trained_filters(wheel, tmp_path)


def check_trained_filters(wheel, folder):
    """Pretrained filters are small, and give the same belief from the wheel in a fresh process."""
    weights = [each for each in wheel.infolist() if "/weights/" in each.filename]
    assert sum(each.file_size for each in weights) <= 1.5e6
    names = torch_denkf.available()
    assert names == ["car-odometry", "imu", "quadruped", "reacher", "ur5-table"]
    files = {f"{name}/{file}" for name in names for file in ("card.md", "config.json", "weights.safetensors")}
    assert {each.filename.split("/weights/")[1] for each in weights} == files
    wheel.extractall(folder)
    script = ROOT / "tests" / "pretrained" / "beliefs.py"
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    done = subprocess.run(
        [sys.executable, script], env=environment, cwd=folder, capture_output=True, text=True, check=True
    )
    found = json.loads(done.stdout)
    assert found.pop("package") == str(folder / "torch_denkf")
    for name, values in beliefs.all_beliefs().items():
        assert found[name] == pytest.approx(values, rel=1e-4, abs=1e-5), name


#: Packages of the core; the files at the package's top belong to it, except the one that looks up robots.
CORE = ("functional", "metrics", "modules", "filters", "smoothers", "transforms", "objectives")
ROBOTS = {
    name
    for robot in ("car", "imu", "legged", "reacher", "ur5")
    for name in import_module(f"torch_denkf.applications.{robot}").__all__
    if name[0].isupper()
}


def docstrings(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
            yield ast.get_docstring(node) or ""


def test_no_docstring_of_the_core_names_an_application():
    package = ROOT / "torch_denkf"
    assert {"UnicycleTransition", "FlowSensor"} <= ROBOTS
    core = [path for room in CORE for path in (package / room).rglob("*.py")]
    core += [path for path in package.glob("*.py") if path.name != "_registered.py"]
    found = {
        (str(path.relative_to(package)), word)
        for path in core
        for text in docstrings(path)
        for word in re.findall(r"\w+", text)
        if word == "applications" or word in ROBOTS
    }
    assert not found


def test_no_docstring_names_a_study():
    found = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "torch_denkf").rglob("*.py")
        for text in docstrings(path)
        if re.search(r"\bbenchmarks[/.]", text)
    }
    assert not found


def test_docstrings_open_with_a_verb_and_the_term():
    riddle = re.compile(r"(What|Where|Whether|Which|How|Of|Those|Likewise|The same)\b")
    paths = (ROOT / "torch_denkf").rglob("*.py")
    assert not {(path.name, text.splitlines()[0]) for path in paths for text in docstrings(path) if riddle.match(text)}


IMPORTS = """
import json, sys

found, heavy = {}, {"mujoco", "dm_control", "cv2", "matplotlib", "PIL", "rerun", "torchrl"}

def look(*packages):
    before = set(sys.modules)
    for package in packages:
        __import__(f"torch_denkf.{package}")
    found[packages[0]] = sorted(heavy & {name.partition(".")[0] for name in set(sys.modules) - before})

look("functional", "metrics")
import tensordict
look("plots")
import torchrl.envs  # which itself imports mujoco where it is installed
look(*"applications.car modules filters smoothers transforms objectives training data envs pretrained".split())
print(json.dumps(found))
"""


def test_import_time():
    done = subprocess.run([sys.executable, "-c", IMPORTS], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert found["functional"] == found["plots"] == []
    assert set(found["applications.car"]) <= {"cv2", "PIL", "torchrl"}, "data sets and their environments read images"


def test_every_public_name_is_there():
    packages = [path.parent.relative_to(ROOT) for path in (ROOT / "torch_denkf").rglob("__init__.py")]
    for name in (".".join(package.parts) for package in packages):
        package = import_module(name)
        for public in getattr(package, "__all__", ()):
            assert hasattr(package, public), f"{name}.{public}"
