"""Metadata of torch_denkf; the build backend and the tools are configured in pyproject.toml."""

import re
from pathlib import Path

from setuptools import find_packages, setup

ROOT = Path(__file__).parent
# Read, not imported: an import would need torch.
VERSION = re.search(r'^__version__ = "(.+)"$', (ROOT / "torch_denkf" / "__init__.py").read_text(), re.MULTILINE)[1]

setup(
    name="torch_denkf",
    version=VERSION,
    description="Differentiable Bayesian filters for robots as TorchRL parts",
    long_description=(ROOT / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="MIT",
    license_files=["LICENSE"],
    keywords=["Bayesian filter", "ensemble Kalman filter", "state estimation", "robotics", "TorchRL"],
    classifiers=[
        "Development Status :: 3 - Alpha",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        "Programming Language :: Python :: 3.11",
        "Programming Language :: Python :: 3.12",
        "Topic :: Scientific/Engineering :: Artificial Intelligence",
        "Typing :: Typed",
    ],
    python_requires=">=3.11",  # labmaze, which dm-control needs, has no wheel for 3.13
    packages=find_packages(include=["torch_denkf", "torch_denkf.*"]),
    package_data={
        "torch_denkf": ["py.typed", "**/*.pyi"],
        "torch_denkf.applications.ur5": ["simulation/assets/*.xml", "weights/*/*"],
        "torch_denkf.applications.car": ["weights/*/*"],
        "torch_denkf.applications.imu": ["weights/*/*"],
        "torch_denkf.applications.legged": ["weights/*/*"],
        "torch_denkf.applications.reacher": ["weights/*/*"],
    },
    entry_points={"console_scripts": ["denkf = torch_denkf.cli.main:main"]},
    install_requires=[
        "torch>=2.13",
        "torchrl>=0.14.1",
        "tensordict>=0.14.3",
        # dm-control 1.0.50 fails with mujoco 4: MjModel lost flex_vertedge.
        "mujoco>=3.17,<4",
        "dm-control>=1.0.50",
        "opencv-python-headless>=4.10",
        "numpy",
        "safetensors>=0.4",  # weights that are data only
        "lazy_loader>=0.4",  # `import torch_denkf` stays cheap
        "tqdm>=4.60",
        "tyro>=1.0",  # the options of `denkf`: a megabyte, imported when one of its commands runs
    ],
    extras_require={
        # Parquet files, and AV1 videos, which OpenCV's wheels do not decode: 280 MB, for LeRobot and own recordings.
        "lerobot": ["pyarrow>=15", "av>=14"],
        # ROS 1, ROS 2 and MCAP bags, read without ROS, and YAML of robot_localization: 10 MB.
        "ros": ["rosbags>=0.11", "pyyaml"],
        # torch_denkf.plots, and the GIF files of its videos.
        "plots": ["matplotlib", "pillow"],
        "examples": ["matplotlib", "tensorboard"],
        # Steps as ONNX models, export_step(format="onnx"): 150 MB. Their user needs onnxruntime and numpy alone.
        "onnx": ["onnx>=1.23", "onnxscript>=0.7.2", "onnxruntime>=1.32"],
        # Collection over machines, torchrl's RayCollector, in examples/many_machines.py alone: 75 MB.
        "ray": ["ray>=2.40"],
        # The peers of `make bench`, in the versions that benchmarks/speed/results/speed.md was made with.
        "bench": [
            "matplotlib",
            "pandas>=3.0",  # tables of the studies
            "vqf==2.1.2",  # the peers of benchmarks/broad
            "ahrs==0.4.0",
            "filterpy==2.0.0",
            "dapper==1.7.1",
            "cuthbert==0.1.1",
            "dynamax==1.0.3",
            "jax==0.10.2",
        ],
        # The site: `make docs`.
        "docs": [
            "sphinx>=9.0",
            "myst-parser>=5.2",
            "sphinx-gallery>=0.22",
            "furo>=2025.12",
            "sphinx-copybutton>=0.5.2",
            "sphinx-design>=0.8",  # the cards of the front page
            "matplotlib",
        ],
        "test": [
            "evo",
            "rosbags>=0.11",
            "pyyaml",
            "pyarrow>=15",
            "av>=14",
            "onnx>=1.23",
            "onnxscript>=0.7.2",
            "onnxruntime>=1.32",
            "hypothesis",
            "pandas>=3.0",  # tables of the studies
            "pytest",
            "pytest-xdist",
            "ruff",
            "mypy",
            "import-linter",
            "build",
            "wheel",
            "pre-commit",
        ],
    },
)
