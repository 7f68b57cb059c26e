"""A packaged step against the filter itself, with the same noise, over many steps."""

import shutil
import subprocess
import sys
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf.compilation import trace_below_autograd
from torch_denkf.deployment import export, export_step, load_step, onnx_model
from torch_denkf.filters import DEnKF
from torch_denkf.modules import AroundState, ConstantNoise, EnsembleAnalysis, LearnedTransition, Select, StochasticMLP

needs_compiler = pytest.mark.skipif(not (shutil.which("g++") or shutil.which("clang++")), reason="no C++ compiler")


def small_filter(action=False):
    torch.manual_seed(0)
    return DEnKF(
        LearnedTransition(StochasticMLP(6 if action else 3, 3, (16,)), action_key="action" if action else None),
        None,
        Select([0, 2]),
        ConstantNoise([0.1, 0.2], in_key="reading"),
        EnsembleAnalysis("perturbed", observation_key="reading"),
        initial=AroundState([0.1, 0.1, 0.1], ensemble_size=8),
    )


def frames(steps):
    generator = torch.Generator().manual_seed(1)
    return TensorDict(
        {
            "reading": torch.randn(steps, 2, generator=generator),
            "action": torch.randn(steps, 3, generator=generator),
            "observed": torch.rand(steps, 2, generator=generator) < 0.7,
        },
        [steps],
    )


@pytest.fixture(params=[False, pytest.param(True, marks=needs_compiler)], scope="module")
def package(request, tmp_path_factory):
    filter = small_filter(action=True)
    start = TensorDict({"state": torch.zeros(3)})
    example = filter.draw_noise(filter.initialise(start.update(frames(1)[0])))
    path = tmp_path_factory.mktemp("package") / "step.pt2"
    return filter, example, export_step(filter, example, path, out_keys=[("info", "nis")], compiled=request.param)


def test_many_steps_equal_the_filters(package):
    filter, example, path = package
    step, data = load_step(path), frames(30)
    eager, packaged = example.clone(), {name: example[tuple(name.split("."))] for name in load_step(path).inputs}
    torch.manual_seed(3)
    for row in data.unbind(0):
        noise = filter.draw_noise(row.clone())
        with torch.no_grad():
            eager = filter.step(noise.copy().update(eager.select(*filter.carry_keys)))
        new = {".".join(k) if isinstance(k, tuple) else k: v for k, v in noise.items(True, True)}
        packaged = step({**packaged, **new})
        # float32 over 30 steps of the same numbers, added up in another order by the compiler
        torch.testing.assert_close(packaged["belief.ensemble"], eager["belief", "ensemble"], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(packaged["belief.mean"], eager["belief", "mean"], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(packaged["info.nis"], eager["info", "nis"], rtol=1e-3, atol=1e-4)


def test_package_runs_without_tensordict_and_torchrl(package):
    _, _, path = package
    code = f"""
import sys, torch
from torch_denkf.deployment import load_step
step = load_step({str(path)!r})
entries = {{name: torch.zeros(shape, dtype=getattr(torch, dtype.split(".")[1]))
           for name, (shape, dtype) in step.inputs.items()}}
out = step(entries)
assert out["belief.mean"].shape == (3,), out
assert not {{"tensordict", "torchrl"}} & set(sys.modules)
print(sorted(step.carry))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "['belief.ensemble']"


def test_noise_drawn_inside_follows_the_seed_and_differs_from_step_to_step(tmp_path):
    filter = small_filter()
    example = TensorDict({"state": torch.zeros(3), "reading": torch.zeros(2)})
    step = load_step(export_step(filter, example, tmp_path / "step.pt2", compiled=False))
    assert set(step.inputs) == {"reading", "belief.ensemble"}
    entries = {"reading": torch.ones(2), "belief.ensemble": torch.zeros(8, 3)}

    def run(seed):
        torch.manual_seed(seed)
        return [step(entries)["belief.ensemble"] for _ in range(2)]

    first, again, other = run(0), run(0), run(1)
    assert first[0].equal(again[0])
    assert first[1].equal(again[1])
    assert not first[0].equal(first[1])
    assert not first[0].equal(other[0])


def exported(folder, name="step.pt2", **options):
    example = TensorDict({"state": torch.zeros(3), "reading": torch.zeros(2)})
    return export_step(small_filter(), example, folder / name, **options)


def no_model(folder):
    (folder / "a.onnx").write_bytes(b"no model")
    return load_step(folder / "a.onnx")


def others_program(folder):
    torch.export.save(torch.export.export(nn.Linear(1, 1), (torch.zeros(1),)), folder / "other.pt2")
    return load_step(folder / "other.pt2")


ERRORS = {
    "another format": (partial(exported, format="tflite"), ValueError, 'format is "pt2" or "onnx"'),
    "a suffix of another format": (partial(exported, format="onnx"), ValueError, r"ends in \.onnx"),
    "a file that is no model": (no_model, ValueError, r"a\.onnx is no ONNX model, or it is damaged"),
    "another program": (others_program, ValueError, "not one of export_step"),
}


@pytest.mark.parametrize(("call", "error", "match"), ERRORS.values(), ids=ERRORS)
def test_errors(call, error, match, tmp_path):
    if "onnx" in match.lower():
        pytest.importorskip("onnxruntime")
    with pytest.raises(error, match=match):
        call(tmp_path)


def test_packages_that_are_not_installed_are_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"torch_denkf\[onnx\]"):
        no_model(tmp_path)
    monkeypatch.setattr(onnx_model, "find_spec", lambda name: None if name == "onnxscript" else 1)
    with pytest.raises(ImportError, match=r"onnxscript.*torch_denkf\[onnx\]"):
        exported(tmp_path, "step.onnx", format="onnx")


class Wrong(nn.Module):
    """A step that reads half of each reading: right for readings of zero."""

    def __init__(self, step):
        super().__init__()
        self.step, self.place = step, step.in_keys.index("reading")

    def forward(self, *values):
        return self.step(*(value / 2 if place == self.place else value for place, value in enumerate(values)))


def test_a_package_that_is_wrong_is_not_written(tmp_path, monkeypatch):
    path, filter = tmp_path / "step.pt2", small_filter()
    path.write_bytes(b"an older one")
    example = filter.initialise(TensorDict({"state": torch.zeros(3), "reading": torch.zeros(2)}))
    filter.draw_noise(example)
    monkeypatch.setattr(export, "trace_below_autograd", lambda step, values: trace_below_autograd(Wrong(step), values))
    with pytest.raises(RuntimeError, match=r"package is wrong: \(.*No file is written"):
        export_step(filter, example, path, compiled=False)
    assert path.read_bytes() == b"an older one"
    monkeypatch.undo()
    export_step(filter, example, path, compiled=False)
