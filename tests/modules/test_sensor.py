"""Oracle: a naive loop over the members, one forward each."""

import warnings

import pytest
import torch
from tensordict import TensorDict
from torch._dynamo.testing import CompileCounter

from torch_denkf.modules import ImageSensor, VectorSensor

SHAPE = (2, 9, 12)
BATCHES = [(), (3,), (2, 3)]
LAYERS = ["dropout", "flipout"]


def image_sensor(**kwargs):
    return ImageSensor(2, image_shape=SHAPE, ensemble_size=5, num_cells=(8, 6), rate=0.3, **kwargs)


def draw(sensor, batch):
    """Returns the noise that can be indexed by rows, whatever it is made of."""
    noise = sensor.draw_noise(batch)
    return noise if isinstance(noise, torch.Tensor) else TensorDict(noise, batch)


def naive(sensor, frames, noise):
    """Runs the whole network once for each frame and member."""
    out = []
    for index, frame in enumerate(frames):
        for member in range(sensor.ensemble_size):
            rows = noise[index, member] if isinstance(noise, torch.Tensor) else noise[index].clone()
            if not isinstance(rows, torch.Tensor):
                rows["signs"] = rows["signs"][member]
            code = sensor.module["trunk"](frame.unsqueeze(0)).squeeze(0)
            out.append(sensor.loc + sensor.scale * sensor.module["head"](code, rows))
    return torch.stack(out).reshape(len(frames), sensor.ensemble_size, -1)


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("batch", BATCHES)
def test_members_are_separate_forwards_of_one_trunk(float64, layer, batch):
    sensor = image_sensor(layer=layer, loc=[1.0, -1.0], scale=[2.0, 3.0])
    frames = torch.rand(*batch, *SHAPE)
    noise = draw(sensor, batch)
    calls = []
    sensor.module["trunk"].register_forward_hook(lambda module, args, out: calls.append(args[0].shape))
    out = sensor(TensorDict({"pixels": frames, ("noise", "self"): noise}, batch))["sensor", "ensemble"]
    count = frames[..., 0, 0, 0].numel()
    assert calls == [(count, *SHAPE)]  # once for all frames, and not once a member
    flat_noise = noise.reshape(count, *noise.shape[len(batch) :]) if layer == "dropout" else noise.reshape(count)
    expected = naive(sensor, frames.reshape(count, *SHAPE), flat_noise)
    # Convolutions of one frame and of many may round differently.
    torch.testing.assert_close(out.reshape(count, 5, 2), expected, rtol=0, atol=1e-12)
    assert not out[..., 0, :].equal(out[..., 1, :])  # members differ


def test_uint8_is_divided_by_255():
    sensor = image_sensor(layer="none")
    frames = torch.randint(0, 256, (3, *SHAPE), dtype=torch.uint8)
    outputs = [sensor(TensorDict({"pixels": x}, [3]))["sensor", "ensemble"] for x in (frames, frames.float() / 255)]
    assert outputs[0].equal(outputs[1])


@pytest.mark.parametrize("columns", [1, 2])
def test_unobserved_nan_frame_has_finite_output_and_gradients(columns):
    sensor = image_sensor()
    frames = torch.rand(3, *SHAPE)
    noise = draw(sensor, [3])
    broken = frames.clone()
    broken[1] = torch.nan
    observed = torch.tensor([True, False, True]).unsqueeze(-1).expand(3, columns)

    def run(pixels):
        td = TensorDict({"pixels": pixels, "observed": observed, ("noise", "self"): noise}, [3])
        out = sensor(td)["sensor", "ensemble"]
        return out, torch.autograd.grad(out.square().sum(), list(sensor.parameters()))

    out, grads = run(broken)
    zeroed = frames.clone()
    zeroed[1] = 0
    expected, expected_grads = run(zeroed)
    assert out.isfinite().all()
    assert out.equal(expected)
    assert all(g.isfinite().all() and g.equal(e) for g, e in zip(grads, expected_grads, strict=True))


@pytest.mark.parametrize("layer", LAYERS)
def test_encoding_is_the_mean_hidden_layer(float64, layer):
    sensor = image_sensor(layer=layer, encoding_key=("sensor", "code"))
    frames, noise = torch.rand(3, *SHAPE), draw(sensor, [3])
    td = sensor(TensorDict({"pixels": frames, ("noise", "self"): noise}, [3]))
    hidden = torch.stack(
        [
            sensor.module["head"](
                sensor.module["trunk"](frames),
                noise[:, e]
                if layer == "dropout"
                else {"signs": noise["signs"][:, e], "perturbation": noise["perturbation"][0]},
                with_hidden=True,
            )[1]
            for e in range(5)
        ]
    )
    assert td["sensor", "code"].shape == (3, 6)
    torch.testing.assert_close(td["sensor", "code"], hidden.mean(0), rtol=0, atol=1e-13)


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("batch", BATCHES)
def test_vector_sensor(float64, layer, batch):
    sensor = VectorSensor(
        4, 2, ensemble_size=5, num_cells=(8, 6), rate=0.5, layer=layer, loc=[1.0, 2.0], scale=[3.0, 4.0]
    )
    reading, noise = torch.randn(*batch, 4), draw(sensor, batch)
    out = sensor(TensorDict({"measurement": reading, ("noise", "self"): noise}, batch))["sensor", "ensemble"]
    expected = sensor.module["head"](reading.unsqueeze(-2).expand(*batch, 5, 4), noise)
    expected = torch.tensor([1.0, 2.0]) + torch.tensor([3.0, 4.0]) * expected
    torch.testing.assert_close(out, expected, rtol=0, atol=1e-13)
    assert not out[..., 0, :].equal(out[..., 1, :])  # members differ


def test_pixels_are_standardised_channel_by_channel():
    """(x - loc) / scale in front of the trunk: the same as a sensor without it on pixels standardised by hand."""
    loc, scale = torch.tensor([0.5, 0.0]), torch.tensor([0.2, 0.1])
    plain = ImageSensor(2, image_shape=(2, 12, 16), ensemble_size=4)
    standard = ImageSensor(2, image_shape=(2, 12, 16), ensemble_size=4, pixel_loc=loc, pixel_scale=scale)
    standard.module.load_state_dict(plain.module.state_dict())
    pixels, noise = torch.rand(3, 2, 12, 16), plain.draw_noise([3])
    by_hand = (pixels - loc[:, None, None]) / scale[:, None, None]
    outs = [
        sensor(TensorDict({"pixels": x, ("noise", "self"): noise}, [3]))["sensor", "ensemble"]
        for sensor, x in ((standard, pixels), (plain, by_hand))
    ]
    torch.testing.assert_close(*outs)


# ------------------------------------------------------------------------------------------------ the pixels' range


def gray_sensor(**kwargs):
    return ImageSensor(2, image_shape=(1, 8, 8), ensemble_size=3, num_cells=(4,), **kwargs)


def warnings_of(sensor, *frames):
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        for frame in frames:
            sensor(TensorDict({"pixels": frame}))
    return [str(one.message) for one in record]


def test_floating_point_pixels_up_to_255_are_said_once():
    bright = torch.rand(1, 8, 8) * 255
    (message,) = warnings_of(gray_sensor(), torch.zeros(1, 8, 8), bright, bright)  # specs are tried out on zeros
    assert "'pixels'" in message
    assert "uint8" in message


@pytest.mark.parametrize("case", ["uint8", "unit", "standardised", "in the units of the pixels", "compiled"])
def test_valid_pixels_do_not_warn(case):
    bright, options = torch.rand(1, 8, 8) * 255, {}
    pixels = {"uint8": bright.byte(), "unit": bright / 255, "standardised": torch.randn(1, 8, 8)}.get(case, bright)
    if case == "in the units of the pixels":
        options = {"pixel_loc": [127.0], "pixel_scale": [60.0]}
    sensor = gray_sensor(**options)
    if case == "compiled":  # and what was compiled is not compiled again after an eager look
        count = CompileCounter()
        compute = torch.compile(lambda x: sensor.compute(x, noise=None), backend=count, fullgraph=True)
        compute(pixels / 255)
        warnings_of(sensor, pixels / 255)
        compute(pixels / 255)
        assert count.frame_count == 1
        return
    assert not warnings_of(sensor, pixels, pixels)
