"""Chunks, recomputation and bfloat16 against the trunk that takes all frames at once."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf.modules import ImageSensor
from torch_denkf.modules._trunk import activation_bytes

SHAPE = (2, 9, 12)
FRAMES = 7


def image_sensor(**kwargs):
    torch.manual_seed(0)
    return ImageSensor(2, image_shape=SHAPE, ensemble_size=5, num_cells=(8, 6), rate=0.3, **kwargs)


def frame_bytes():
    return activation_bytes(image_sensor().module["trunk"], torch.zeros(1, *SHAPE))


def trunk_calls(sensor):
    calls = []
    sensor.module["trunk"].register_forward_pre_hook(lambda module, args: calls.append(len(args[0])))
    return calls


def run(sensor, frames, observed=None):
    """Returns samples and the parameters' gradients of their squares, with a fixed seed."""
    torch.manual_seed(1)
    td = TensorDict({"pixels": frames}, [FRAMES])
    if observed is not None:
        td["observed"] = observed
    samples = sensor(td)["sensor", "ensemble"]
    samples.square().sum().backward()
    return samples.detach(), [parameter.grad for parameter in sensor.parameters()]


@pytest.mark.parametrize("recompute", [False, True])
@pytest.mark.parametrize("at_once", [1, 3, 7])
@pytest.mark.parametrize("kind", ["float", "uint8", "masked"])
def test_chunks_give_the_samples_and_gradients_of_all_at_once(float64, recompute, at_once, kind):
    frames, observed = torch.rand(FRAMES, *SHAPE), None
    if kind == "uint8":
        frames = (255 * frames).to(torch.uint8)
    if kind == "masked":
        observed = torch.tensor([[True], [False], [True], [True], [False], [True], [True]])
        frames[~observed.squeeze(-1)] = torch.nan
    options = {"pixel_loc": [0.4, 0.5], "pixel_scale": [0.2, 0.3]}
    expected, expected_gradients = run(image_sensor(**options), frames, observed)
    sensor = image_sensor(trunk_memory=at_once * frame_bytes(), recompute=recompute, **options)
    calls = trunk_calls(sensor)
    samples, gradients = run(sensor, frames, observed)
    forward = [at_once] * (FRAMES // at_once) + [FRAMES % at_once] * (FRAMES % at_once > 0)
    assert calls[: len(forward)] == forward
    assert len(calls) == len(forward) * (1 + recompute)
    # Convolutions of few frames and of many may round differently.
    torch.testing.assert_close(samples, expected, rtol=0, atol=1e-12)
    for found, wanted in zip(gradients, expected_gradients, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-10, atol=1e-10)


def test_recomputation_keeps_the_frames_and_features_alone():
    frames = torch.rand(FRAMES, *SHAPE)
    kept = {}
    for recompute in (False, True):
        sensor = image_sensor(trunk_memory=2 * frame_bytes(), recompute=recompute)
        code = None

        def keep_size(tensor, kept=kept, recompute=recompute):
            storage = tensor.untyped_storage()
            kept.setdefault(recompute, {})[storage.data_ptr()] = storage.nbytes()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(keep_size, lambda tensor: tensor):
            code = sensor._features(frames, None)
        assert code.requires_grad
    parameters = sum(parameter.nbytes for parameter in image_sensor().module["trunk"].parameters())
    assert sum(kept[True].values()) <= frames.nbytes
    # Without it at least the ReLUs' results of all frames are kept: half of what the trunk computes.
    assert sum(kept[False].values()) > FRAMES * frame_bytes() / 2 - parameters


def test_bfloat16_is_used_and_is_close():
    frames = torch.rand(FRAMES, *SHAPE)
    plain, half = image_sensor(), image_sensor(trunk_dtype=torch.bfloat16)
    types = []
    half.module["trunk"][0].register_forward_hook(lambda module, args, out: types.append(out.dtype))
    expected, expected_gradients = run(plain, frames)
    samples, gradients = run(half, frames)
    assert types == [torch.bfloat16]
    assert samples.dtype == torch.float32
    # Eight bits of mantissa: 2^-9 a rounding, a few of them in a row.
    assert (samples - expected).norm() / expected.norm() < 0.02
    for found, wanted in zip(gradients, expected_gradients, strict=True):
        assert found.dtype == torch.float32
        assert (found - wanted).norm() <= 0.05 * wanted.norm() + 1e-6


def test_a_batch_norm_sees_all_frames():
    trunk = nn.Sequential(nn.Conv2d(2, 4, 3), nn.BatchNorm2d(4), nn.Flatten())
    sensor = image_sensor(trunk=trunk)
    calls = trunk_calls(sensor)
    frames = torch.zeros(1, *SHAPE).expand(10_000, *SHAPE)  # 34 MB of results
    with torch.no_grad():
        sensor(TensorDict({"pixels": frames}, [10_000]))
    assert calls == [10_000]
