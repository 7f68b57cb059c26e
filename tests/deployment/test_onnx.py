"""An ONNX model of a step gives the eager step's numbers, with masks, actions and noise, and without torch."""

import subprocess
import sys

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.deployment.test_equals_eager import bend, members, parts
from tests.filters.factories import linear_kalman, toy_denkf, toy_frames
from tests.filters.gaussian_for_tests import CONTROL, learned_filter, learned_frames, linear_frames
from tests.filters.test_contract import fused, readings
from torch_denkf.deployment import export_step, load_step
from torch_denkf.filters import DEnKF, KalmanFilter
from torch_denkf.modules import EnsembleAnalysis, LearnedTransition

pytest.importorskip("onnxruntime")


def one_number(**options):
    """Returns a number that walks at random with variance 1, read with variance 1."""
    one = torch.eye(1)
    return KalmanFilter(one, one, process_noise_cov=one, noise_cov=one, mean=torch.zeros(1), cov=one, **options)


def perturbed():
    analysis = EnsembleAnalysis("perturbed", observation_key="reading")
    return DEnKF(**parts(bend), analysis=analysis, initial=members(), process_noise=[0.1] * 3)


def of_readings(*batch):
    frames = readings(*batch, width=2)
    return frames.update({"reading": frames["observation"]})


FILTERS = {
    "Kalman filter": (lambda: linear_kalman(control=torch.tensor(CONTROL)), linear_frames),
    "EKF": (lambda: learned_filter("EKF"), learned_frames),
    "DEnKF of four networks": (toy_denkf, toy_frames),
    "DEnKF with flipout": (lambda: toy_denkf(layer="flipout", sensor_layer="flipout"), toy_frames),
    "DEnKF with perturbed readings": (perturbed, of_readings),
    "Kalman filter of two sensors, one of them late": (lambda: fused("Kalman", late=True), of_readings),
}


def dotted(tensordict):
    return dict(tensordict.flatten_keys(".").items())


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if "flipout" in name else name for name in FILTERS]
)
def test_steps_are_the_filters(name, tmp_path):
    make, frames = FILTERS[name]
    filter = make()
    data = frames((8,)) if frames is toy_frames else frames(8)
    data = data.exclude("is_init")
    step = load_step(export_step(filter, data[0], tmp_path / "step.onnx", format="onnx", out_keys=[("info", "nis")]))
    row, missing = filter.initialise(data[0].copy()), 0
    with torch.no_grad():
        for frame in data:
            row = filter.draw_noise(row.select(*filter.carry_keys).update(frame))
            found, given = step(dotted(row)), row
            row = filter.step(row.copy())
            missing += not given["observed"].all()
            for key, value in found.items():
                expected = row[tuple(key.split("."))]
                torch.testing.assert_close(value, expected, rtol=1e-4, atol=1e-5, msg=lambda m, k=key: f"{k}: {m}")
    assert missing
    assert "DEnKF" not in name or any(key.startswith("noise.transition") for key in step.inputs)


def test_a_step_by_hand_without_torch(tmp_path):
    """The forecast's variance is 2, so the gain 2/3; a reading that is hidden leaves the forecast."""
    filter = one_number()
    example = TensorDict({"observation": torch.zeros(1), "observed": torch.ones(1, dtype=torch.bool)})
    path = export_step(filter, example, tmp_path / "step.onnx", format="onnx")
    program = f"""
import json, sys
import numpy as np
import onnxruntime

session = onnxruntime.InferenceSession({str(path)!r})
names = json.loads(session.get_modelmeta().custom_metadata_map["torch_denkf"])
belief = {{"belief.mean": np.zeros(1, np.float32), "belief.cov": np.ones((1, 1), np.float32)}}
for value, seen in ((1, True), (7, False), (np.nan, False)):
    frame = {{"observation": np.array([value], np.float32), "observed": np.array([seen])}}
    out = dict(zip(names["outputs"], session.run(None, belief | frame)))
    belief = {{name: out[name] for name in names["carry"]}}
    print(*(float(out[name].squeeze()) for name in ("belief.mean", "belief.cov")))
assert "torch" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    found = np.array([line.split() for line in done.stdout.splitlines()], float)
    np.testing.assert_allclose(found, [[2 / 3, 2 / 3], [2 / 3, 5 / 3], [2 / 3, 8 / 3]], rtol=1e-6)


def test_operators_missing_in_onnx_are_named(tmp_path):
    path, frame = tmp_path / "step.onnx", TensorDict({"reading": torch.zeros(2)})
    etkf = DEnKF(**parts(bend), analysis=EnsembleAnalysis("etkf", observation_key="reading"), initial=members())
    with pytest.raises(RuntimeError, match=r'aten\._linalg_eigh.* choose "perturbed".*format="pt2"'):
        export_step(etkf, frame, path, format="onnx")
    eye = torch.eye(13)
    wide = KalmanFilter(eye, eye, process_noise_cov=eye, noise_cov=eye, mean=torch.zeros(13), cov=eye)
    with pytest.raises(RuntimeError, match=r"aten\.linalg_cholesky_ex.* up to 12 .*FusedSensor"):
        export_step(wide, TensorDict({"observation": torch.zeros(13)}), path, format="onnx")
    restless = DEnKF(
        **{**parts(bend), "transition": LearnedTransition(lambda x: x + torch.randn_like(x))},
        initial=members(),
        analysis=perturbed().module["analysis"],
    )
    with pytest.raises(RuntimeError, match=r"aten\.randn_like.*process_noise"):
        export_step(restless, frame, path, format="onnx")
    assert not path.exists()
