"""Yields the cases of each part of the measurement."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import torch
from tensordict import TensorDict

from benchmarks.gpu.case import WAYS, Case
from benchmarks.gpu.models import MODELS, frames, robot_filter, robot_readings
from benchmarks.speed import workload
from torch_denkf.filters import Filter


def sequence(filter: Filter, data: TensorDict, gradients: bool) -> Callable[[], object]:
    """Returns a call that runs a whole sequence, optionally with the gradients of a loss of its means."""
    parameters = [value for value in filter.parameters() if value.requires_grad]
    if gradients and not parameters:
        data = data.apply(lambda value: value.requires_grad_())
        parameters = list(data.values())

    def forward() -> object:
        with torch.no_grad():
            return filter.sequence(data.copy())

    def backward() -> object:
        return torch.autograd.grad(filter.sequence(data.copy())["belief", "mean"].square().sum(), parameters)

    return backward if gradients else forward


def loop(step: Callable[[TensorDict], object], row: TensorDict) -> Callable[[], object]:
    """Returns a call that runs one step, without gradients."""

    def call() -> object:
        with torch.no_grad():
            return step(row)

    return call


def of_filters(device: str, ways: tuple[str, ...], smoke: bool) -> Iterator[Case]:
    """Yields each kind of filter, dimension and batch size: a sequence, forward and with gradients."""
    steps = 2 if smoke else 20
    for batch in (2,) if smoke else (65536, 4096, 64, 1):
        for name, make in MODELS.items():
            for dims, gradients in ((5, False), (5, True)) if smoke else ((5, False), (5, True), (20, False)):
                if (batch in (1, 65536) and (dims, gradients) != (5, False)) or (batch == 64 and dims > 5):
                    continue
                for way in ways:
                    if way == "eager" and (batch == 1 or dims > 5):  # same times as 64 filters, and as 5 dimensions
                        continue

                    def call(make=make, dims=dims, batch=batch, gradients=gradients, way=way):
                        filter = make(dims).to(device).compile(**WAYS[way])
                        return sequence(filter, frames(dims, batch, steps, device), gradients)

                    yield Case(name, call, way, batch, steps, gradients, dims)


def of_paper(device: str, ways: tuple[str, ...], smoke: bool) -> Iterator[Case]:
    """Yields cases of the paper's networks (Table I, S = 5, O = 2, E = 32) and of cuthbert."""
    steps = 2 if smoke else 20
    for batch in (2,) if smoke else (64, 4096):
        for way in ways:

            def step(batch=batch, way=way):
                filter = workload.make_filter()
                row = workload.make_frames(batch, 1)[:, 0].set(("belief", "ensemble"), workload.start(filter, batch))
                return loop(filter.to(device).compile(**WAYS[way]).step, row.to(device))

            yield Case("DEnKF, Table I: a step", step, way, batch)
            for gradients in (False, True):

                def call(batch=batch, way=way, gradients=gradients):
                    filter = workload.make_filter().to(device).compile(**WAYS[way])
                    return sequence(filter, workload.make_frames(batch, steps).to(device), gradients)

                yield Case("DEnKF, Table I: a sequence", call, way, batch, steps, gradients)


def of_peers(device: str, ways: tuple[str, ...], smoke: bool) -> Iterator[Case]:
    """Yields the same work in other libraries, if installed: JAX compiles, torch-kf is eager torch."""
    os.environ["JAX_PLATFORMS"] = "cuda" if device == "cuda" else "cpu"
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    for batch in (2,) if smoke else (64, 4096):
        for gradients in (False, True):

            def cuthbert(batch=batch, gradients=gradients):
                from benchmarks.speed.against_cuthbert import cuthbert_sequence

                return cuthbert_sequence(batch, gradients)

            yield Case("cuthbert, EnKF, Table I: a sequence", cuthbert, "cuthbert", batch, workload.STEPS, gradients)
        for kind in ("EKF", "UKF"):

            def dynamax(batch=batch, kind=kind):
                from benchmarks.speed.against_dynamax import dynamax_sequence

                return dynamax_sequence(kind, batch)

            yield Case(f"dynamax, {kind}: a sequence", dynamax, "dynamax", batch, workload.STEPS + 1)

        def torch_kf(batch=batch):
            from torch_kf import GaussianState
            from torch_kf import KalmanFilter as Theirs

            eye = torch.eye(5)
            theirs = Theirs(0.95 * eye, eye[:2], 0.01 * eye, 0.25 * torch.eye(2)).to(torch.device(device))
            start = GaussianState(torch.zeros(batch, 5, 1, device=device), eye.to(device).expand(batch, 5, 5).clone())
            readings = torch.randn(20, batch, 2, 1, device=device)

            def run():
                state = start
                for reading in readings:
                    state = theirs.update(theirs.predict(state), reading)
                return state

            return run

        yield Case("torch-kf, Kalman filter: a sequence", torch_kf, "torch-kf", batch, 20)


def of_training(device: str, ways: tuple[str, ...], smoke: bool) -> Iterator[Case]:
    """Yields a training step of the KITTI preset on 64 sequences of 20 images, and one of its trunk alone."""
    from benchmarks.speed import training_step as preset

    batch, steps = (2, 3) if smoke else (preset.BATCH, preset.STEPS)

    def trunk():
        made = preset.make_filter(trunk_memory=preset.EVERYTHING).to(device)
        return preset.trunk_alone(made, preset.make_batch(batch, steps).to(device), chunked=False)

    yield Case("KITTI preset: its trunk alone", trunk, "eager", batch, steps, True)
    for way in ways:

        def call(way=way):
            filter = preset.make_filter(trunk_memory=preset.EVERYTHING).to(device).compile(**WAYS[way])
            return preset.training_step(filter, preset.make_batch(batch, steps).to(device))

        yield Case("KITTI preset: a training step", call, way, batch, steps, True)


def of_robots(device: str, ways: tuple[str, ...], smoke: bool) -> Iterator[Case]:
    """Yields a batch of legged robots, as large as in a simulator on the device."""
    for batch in (2,) if smoke else (4096,):
        for kind in ("EKF", "DEnKF"):
            for way in ways:

                def call(kind=kind, batch=batch, way=way):
                    filter = robot_filter(kind, 8 if smoke else 64).to(device)
                    row = filter.initialise(robot_readings(batch, device))
                    return loop(filter.compile(**WAYS[way]).step, row)

                yield Case(f"legged {kind}: a step", call, way, batch, 1, False, 28)


def of_environments(device: str, ways: tuple[str, ...], smoke: bool) -> Iterator[Case]:
    """Yields filters in torchrl's environments and policies, captured and compiled by torchrl."""
    from tensordict.nn import CudaGraphModule, TensorDictModule, TensorDictSequential
    from torchrl.collectors import Collector
    from torchrl.envs import InitTracker, TransformedEnv

    from torch_denkf.envs import LinearGaussianEnv
    from torch_denkf.transforms import DEnKFTransform

    batch, steps = (2, 2) if smoke else (4096, 20)

    def simulated() -> LinearGaussianEnv:
        motion, observation = 0.95 * torch.eye(5), torch.eye(2, 5)
        return LinearGaussianEnv(motion, observation, [0.1] * 5, [0.5] * 2, batch_size=[batch], device=device)

    def filtered(way: str) -> Filter:
        filter = MODELS["DEnKF, perturbed"](5, "observation").to(device)
        return filter.compile(**WAYS[way])

    def alone():
        env = simulated()
        return lambda: env.rollout(steps)

    yield Case("rollout without a filter", alone, "eager", batch, steps)
    for way in ways:

        def rollout(way=way):
            env = TransformedEnv(simulated(), DEnKFTransform(filtered(way)))
            return lambda: env.rollout(steps)

        yield Case("rollout with DEnKFTransform", rollout, way, batch, steps)

    def compiled():
        env = TransformedEnv(simulated(), DEnKFTransform(filtered("eager")), compile=True)
        return lambda: env.rollout(steps)

    if not smoke:
        yield Case("rollout, TransformedEnv(compile=True)", compiled, "torchrl", batch, steps)

    def captured():
        filter = workload.make_filter()
        row = workload.make_frames(64, 1)[:, 0].set(("belief", "ensemble"), workload.start(filter, 64)).to(device)
        return loop(CudaGraphModule(filter.to(device).step), row)

    yield Case("CudaGraphModule(filter.step)", captured, "torchrl", 64)
    for option in ("cudagraph_policy", "compile_policy")[: 1 if smoke else 2]:

        def collected(option=option):
            filter = filtered("eager")
            env = TransformedEnv(simulated(), InitTracker())
            env.append_transform(filter.make_tensordict_primer())
            still = TensorDictModule(lambda mean: torch.zeros_like(mean[..., :1]), [("belief", "mean")], ["action"])
            policy, frames = TensorDictSequential(filter, still), batch * steps
            collector = Collector(
                env, policy, frames_per_batch=frames, total_frames=10**12, device=device, **{option: True}
            )
            batches = iter(collector)
            return lambda: next(batches)

        yield Case(f"Collector({option}=True)", collected, "torchrl", batch, steps)


def of_analysis(device: str, ways: tuple[str, ...], smoke: bool) -> Iterator[Case]:
    """Yields an ensemble with many components, as in weather forecasting, and 40 members."""
    from torch_denkf.functional import analyse

    size = 100 if smoke else 10**6
    for scheme in ("sensor", "etkf"):

        def call(scheme=scheme):
            x = torch.randn(40, size, device=device)
            y = torch.randn(40, size, device=device) if scheme == "sensor" else torch.randn(size, device=device)
            variance = torch.ones(size, device=device)
            return lambda: analyse(x, x, y, variance, scheme=scheme)

        yield Case(f"analysis, {scheme}", call, "eager", 1, 1, False, size)


def of_equality(device: str, ways: tuple[str, ...], smoke: bool) -> Iterator[Case]:
    """Yields checks instead of times: a difference raises, and the row's note has the error."""

    def eager_of(name: str, data: TensorDict):
        torch.manual_seed(0)
        filter = MODELS[name](5).double()
        data = filter.draw_noise(data.double())
        filter.to(device)
        return filter, data.to(device)

    for name in MODELS:
        for way in (way for way in ways if way != "eager"):

            def same(name=name, way=way):
                filter, data = eager_of(name, frames(5, 3, 6, "cpu"))
                data["reading"].requires_grad_()
                out = []
                for options in (WAYS["eager"], WAYS[way]):
                    mean = filter.compile(**options).sequence(data.copy())["belief", "mean"]
                    out.append((mean.detach(), *torch.autograd.grad(mean.square().sum(), data["reading"])))
                for ours, theirs in zip(*out, strict=True):
                    torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
                return lambda: None

            yield Case(f"equals eager: {name}", same, way, 3, 6, True)

    for way in ways:

        def again(way=way):
            filter = MODELS["DEnKF, perturbed"](5).to(device).compile(**WAYS[way])
            data = frames(5, 3, 6, device)
            first, second = (filter.sequence(data.copy())["belief", "ensemble"].detach() for _ in range(2))
            if bool(torch.isclose(first, second).all(-1).any()):
                raise AssertionError("two runs drew the same members")
            return lambda: None

        yield Case("two runs draw different members", again, way, 3, 6)


PARTS: dict[str, Callable[[str, tuple[str, ...], bool], Iterator[Case]]] = {
    "equality": of_equality,
    "paper": of_paper,
    "training": of_training,
    "robots": of_robots,
    "peers": of_peers,
    "environments": of_environments,
    "analysis": of_analysis,
    "filters": of_filters,
}
#: Seconds that a part may take, of six minutes in all.
LIMITS: dict[str, int] = {
    "equality": 45,
    "paper": 45,
    "training": 30,
    "robots": 30,
    "peers": 60,
    "environments": 60,
    "analysis": 20,
    "filters": 85,
}
