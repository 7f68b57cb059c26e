"""A filter's step on a robot: exported into one file, loaded without the training code, run at 1 kHz and timed.

    python examples/deploy.py
    python examples/deploy.py --onnx    # an ONNX model, which onnxruntime runs, from C++ as well

The filter estimates the angles and the speeds of two joints from their encoders (12 bits per turn, and noise);
differences of such encoders over a millisecond are useless. First this process exports the step. Then another process,
which imports only torch, reads the file and runs it every millisecond on simulated encoders.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from torch import nn

from torch_denkf.deployment import load_step

DT, MEMBERS = 1e-3, 32
COUNT, NOISE, JERK = 2 * math.pi / 4096, 0.002, 400.0  # rad; rad; rad/s^3
TRUTH = (1.2, 2.0), (1.1, 0.6), (0.0, 1.0)  # amplitude in rad, frequency in Hz, phase in rad of each joint


class Coasting(nn.Module):
    """Changes of [angle, speed, acceleration] of two joints in a millisecond."""

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        """Returns the changes ``[*, E, 6]`` of states ``[*, E, 6]``: angles, speeds, accelerations."""
        speed, acceleration = state[..., 2:4], state[..., 4:]
        still = torch.zeros_like(acceleration)
        return torch.cat([DT * speed + DT**2 / 2 * acceleration, DT * acceleration, still], -1)


def export(path: Path, compiled: bool) -> float:
    """Writes the file; returns the milliseconds of the same step in this process, eagerly."""
    from tensordict import TensorDict

    from torch_denkf import DEnKF, export_step
    from torch_denkf.modules import (
        AroundState,
        ConstantNoise,
        EnsembleAnalysis,
        LearnedTransition,
        NoisyTransition,
        Select,
    )

    # The accelerations are random walks.
    walk = ConstantNoise(
        [0.03 * JERK * math.sqrt(DT)] * 2, in_key=("belief", "ensemble"), out_key=("forecast", "noise")
    )
    filter = DEnKF(
        NoisyTransition(LearnedTransition(Coasting()), walk, dims=[4, 5]),
        None,
        Select([0, 1]),
        ConstantNoise([math.hypot(NOISE, COUNT / math.sqrt(12))] * 2, in_key="encoder"),
        EnsembleAnalysis("sakov", observation_key="encoder"),
        initial=AroundState([0.01, 0.01, 5.0, 5.0, 50.0, 50.0], ensemble_size=MEMBERS),
    )
    example = filter.initialise(TensorDict({"encoder": torch.zeros(2), "state": torch.zeros(6)}))
    export_step(filter, example, path, compiled=compiled, format="onnx" if path.suffix == ".onnx" else "pt2")
    seconds = []
    with torch.no_grad():
        for _ in range(300):
            row = example.copy()
            begun = time.perf_counter()
            filter.step(row)
            seconds.append(time.perf_counter() - begun)
    return 1e3 * sorted(seconds)[len(seconds) // 2]


def joints(now: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns true angles and speeds ``[2]`` at a time in s."""
    amplitude, frequency, phase = (torch.tensor(value) for value in TRUTH)
    angle, rate = 2 * math.pi * frequency * now + phase, 2 * math.pi * frequency
    return amplitude * angle.sin(), amplitude * rate * angle.cos()


def draw(shapes: dict[str, tuple[int, ...]]) -> dict[str, torch.Tensor]:
    """Returns standard normal draws of some shapes, by name."""
    return {name: torch.randn(shape) for name, shape in shapes.items()}


def run(path: Path, seconds: float) -> None:
    """Runs the robot's loop: a step every millisecond, if this computer is fast enough."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    step, count = load_step(path), int(seconds / DT)
    frames = [joints(tick * DT) for tick in range(count)]
    readings = [((angle + NOISE * torch.randn(2)) / COUNT).round() * COUNT for angle, _ in frames]
    spread = torch.tensor([0.01, 0.01, 5.0, 5.0, 50.0, 50.0])
    state = {"belief.ensemble": torch.cat([readings[0], torch.zeros(4)]) + spread * torch.randn(MEMBERS, 6)}
    # An ONNX model draws no random numbers; its inputs include the noise.
    noises = {name: shape for name, (shape, _) in step.inputs.items() if name.startswith("noise.")}
    means, latencies, late = [], [], 0
    with torch.inference_mode():
        for _ in range(50):  # the first calls fill caches
            step({**state, **draw(noises), "encoder": readings[0]})
        tick = time.perf_counter()
        for reading in readings:
            while (begun := time.perf_counter()) < tick:
                pass
            out = step({**state, **draw(noises), "encoder": reading})
            state = {name: out[name] for name in step.carry}
            means.append(out["belief.mean"])
            done = time.perf_counter()
            latencies.append(1e3 * (done - begun))
            late += done > tick + DT
            tick = max(tick + DT, done)
    assert "tensordict" not in sys.modules  # nothing of the training code was needed
    settled = slice(count // 5, None)
    speeds = torch.stack([speed for _, speed in frames])[settled]
    angles = torch.stack(readings)
    pace = torch.zeros_like(angles)
    pace[20:] = (angles[20:] - angles[:-20]) / (20 * DT)
    quantiles = torch.quantile(torch.tensor(latencies), torch.tensor([0.5, 0.95, 0.99, 1.0])).tolist()
    print(
        "latency of a step, ms: "
        + ", ".join(f"{n} {q:.3f}" for n, q in zip(("p50", "p95", "p99", "max"), quantiles, strict=True))
    )
    print(f"{late} of {count} steps were done after their millisecond")
    print("speeds, RMSE rad/s:")
    for name, estimate in (
        ("difference of two readings, 1 ms", torch.diff(angles, dim=0, prepend=angles[:1]) / DT),
        ("difference over 20 ms", pace),
        ("DEnKF", torch.stack(means)[:, 2:4]),
    ):
        print(f"  {name:33s} {(estimate[settled] - speeds).square().mean().sqrt():.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="the file to write; by default in a temporary folder")
    parser.add_argument("--onnx", action="store_true", help="write an ONNX model; needs torch_denkf[onnx]")
    parser.add_argument("--seconds", type=float, default=5.0, help="to run at 1 kHz")
    parser.add_argument("--not-compiled", action="store_true", help="write the graph alone: needs no C++ compiler")
    parser.add_argument("--run", type=Path, metavar="FILE", help="only run a file that was exported before")
    parser.add_argument("--smoke", action="store_true", help="a short run of everything, not compiled")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.run:
        run(args.run, args.seconds)
        return
    with tempfile.TemporaryDirectory() as folder:
        path = args.out or Path(folder) / ("step.onnx" if args.onnx else "step.pt2")
        begun = time.perf_counter()
        eager = export(path, compiled=not (args.smoke or args.not_compiled))
        print(f"exported {path.name} in {time.perf_counter() - begun:.0f} s, {path.stat().st_size / 1e3:.0f} kB")
        print(f"the same step, eager, in this process: p50 {eager:.3f} ms")
        seconds = 0.2 if args.smoke else args.seconds
        subprocess.run([sys.executable, __file__, "--run", str(path), "--seconds", str(seconds)], check=True)


if __name__ == "__main__":
    main()
