"""Oracles: tables and flows whose reading is known by hand, a loop over members, and rendered drives."""

import cv2
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.applications.car.vision.drives_for_tests import rendered_motion
from torch_denkf.applications.car import FlowSensor
from torch_denkf.applications.car.vision.expansion import focus_of_expansion
from torch_denkf.applications.car.vision.shapes import FLOW_SHAPE, ROAD_PITCHES, ROAD_SHAPE, ROAD_SHIFTS

cv2.setNumThreads(1)
DT = 0.1
LAYERS = ["dropout", "flipout"]


def make(**kwargs):
    return FlowSensor(dt=DT, **{"ensemble_size": 5, "num_cells": (8, 6), "rate": 0.3, **kwargs}).eval()


def draw_noise(sensor, batch, **options):
    """Returns the noise that can be indexed by rows, whatever it is made of."""
    noise = sensor.draw_noise(batch, **options)
    return noise if isinstance(noise, torch.Tensor) else TensorDict(noise, batch)


def random_frames(*batch):
    flow = 0.1 * torch.randn(*batch, *FLOW_SHAPE)
    flow[..., 2, :, :].abs_().clamp_max_(1)
    return TensorDict({"flow": flow, "road": 0.5 + 0.4 * torch.rand(*batch, *ROAD_SHAPE)}, batch)


def known_frame(pitch, distance, turn):
    """Returns a table with one peak, and a flow with the same ``turn`` everywhere ahead."""
    flow, road = 0.1 * torch.randn(FLOW_SHAPE), torch.zeros(ROAD_SHAPE)
    flow[0, 8:12, 28:51] = turn
    road[np.abs(ROAD_PITCHES - pitch).argmin(), np.abs(ROAD_SHIFTS - distance).argmin()] = 1.0
    return TensorDict({"flow": flow, "road": road})


def known_travel(pitch, length=0.1):
    """Returns the flow of a camera whose pitch over the direction of travel is ``pitch``."""
    rows, columns = ((torch.arange(n) + 0.5) / n * 2 - 1 for n in (25, 79))
    down, right = torch.meshgrid(rows * 0.2708 - pitch, columns * 0.8625, indexing="ij")
    return torch.stack([right, down, torch.zeros(25, 79)]) * length * torch.rand(25, 79)


def only_the_road(sensor):
    """Neither the direction of travel nor the turn that comes with it counts; nor does any network."""
    trunk = sensor.module["trunk"]
    silence(trunk.road, trunk.gate, sensor.module["head"])
    with torch.no_grad():
        trunk.log_pitch_std.fill_(20.0)
        trunk.gate.bias.fill_(-40.0)
    return sensor


def silence(*modules):
    with torch.no_grad():
        for module in modules:
            for parameter in module.parameters():
                parameter.zero_()


@pytest.mark.parametrize(("pitch", "distance", "turn"), [(0.01, 1.5, 0.03), (-0.04, -0.15, -0.01), (-0.005, 0.0, 0.0)])
def test_geometry_reads_a_known_frame(float64, pitch, distance, turn):
    sensor = only_the_road(make())
    out = sensor(known_frame(pitch, distance, turn))
    # The peak's share: e^(e^3) = 5e8 against the 896 other cells, which lie at most 3.4 m away.
    share = 896 / np.exp(np.exp(3.0))
    expected = torch.tensor([distance, turn]) / DT
    torch.testing.assert_close(out["sensor", "ensemble"], expected.expand(5, 2), rtol=0, atol=3.4 * share / DT)
    spread, angle, certain, turned, *_ = out["sensor", "encoding"][-7:].tolist()
    assert spread == pytest.approx(1e-3 / 0.2, rel=3.4**2 * share / 1e-6)  # the root of the floor of its square
    assert angle == pytest.approx(pitch / 0.005, abs=1e-4)
    assert certain == pytest.approx((1 - 0.9) / 0.2)
    assert turned == pytest.approx(turn / 0.02)


def test_doubt_between_two_distances(float64):
    """Two equal peaks: their mean, and half their difference as the spread; the direction of travel decides."""
    sensor = only_the_road(make(layer="none"))
    trunk = sensor.module["trunk"]
    frame = known_frame(0.01, 1.0, 0.0)
    frame["road"][4, np.abs(ROAD_SHIFTS - 2.0).argmin()] = 1.0
    out = sensor(frame)
    assert out["sensor", "ensemble"][0, 0].item() == pytest.approx(1.5 / DT, abs=1e-4)
    assert out["sensor", "encoding"][-7].item() == pytest.approx((0.25 + 1e-6) ** 0.5 / 0.2, abs=1e-4)
    assert out["sensor", "encoding"][-6].item() == pytest.approx((0.01 + ROAD_PITCHES[4]) / 2 / 0.005, abs=1e-5)
    with torch.no_grad():
        trunk.log_pitch_std.fill_(0.0)
    for pitch, distance in ((0.01, 1.0), (ROAD_PITCHES[4], 2.0)):
        frame["flow"] = known_travel(pitch)
        # The other row is 6 of the 0.005 rad away: 18 nats.
        assert sensor(frame)["sensor", "ensemble"][0, 0].item() == pytest.approx(distance / DT, abs=1e-2)


def test_turn_is_the_median_flow_ahead_or_that_of_the_fit():
    sensor, motion = only_the_road(make(layer="none")), rendered_motion("road9")

    def turn(motion):
        return sensor(motion.select("flow", "road"))["sensor", "ensemble"][:, 0, 1].detach().numpy() * DT

    turned, flow = turn(motion), motion["flow"].float().numpy()
    # Rows from 33 to 50 % of the height and as many columns to both sides of the middle one.
    expected = np.median(flow[:, 0, 8:12, 29:50].reshape(len(flow), -1), axis=1)
    np.testing.assert_allclose(turned, expected, rtol=0, atol=1e-7)
    mirrored = motion.select("flow", "road").clone()
    mirrored["flow"] = mirrored["flow"].flip(-1)
    mirrored["flow"][:, 0] *= -1
    np.testing.assert_allclose(turn(mirrored), -turned, rtol=0, atol=1e-7)
    assert np.abs(turned).max() > 0.03
    with torch.no_grad():
        sensor.module["trunk"].gate.bias.fill_(40.0)
    fitted = focus_of_expansion(motion["flow"]).turn[:, 0].numpy()
    np.testing.assert_allclose(turn(motion), fitted, rtol=0, atol=1e-7)
    truth = motion["state"][:, 4].numpy() * 0.103
    assert np.abs(fitted - truth).mean() < np.abs(turned - truth).mean(), "and closer to the truth"


@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_members_are_separate_corrections_of_one_reading(float64, layer, batch):
    sensor = make(layer=layer)
    frames, noise = random_frames(*batch), draw_noise(sensor, batch)
    calls = []
    hook = sensor.module["trunk"].register_forward_hook(lambda module, args, out: calls.append(len(args[0])))
    out = sensor(frames.copy().set(("noise", "self"), noise))
    hook.remove()
    assert calls == [out.batch_size.numel()]  # once for all frames, and not once a member
    flat, results = frames.reshape(-1), []
    flat_noise = noise.reshape(len(flat), *noise.shape[len(batch) :]) if layer == "dropout" else noise.reshape(-1)
    for row in range(len(flat)):
        moved, turned, encoding = sensor.module["trunk"](flat["flow"][row, None], flat["road"][row, None])
        for member in range(5):
            if layer == "dropout":
                draw = flat_noise[row, member]
            else:
                draw = flat_noise[row].clone()
                draw["signs"] = draw["signs"][member]
            first, second = sensor.module["head"](encoding[0], draw)
            results.append(torch.stack([moved[0] * (1 + first.tanh()), turned[0] + 0.02 * second]) / DT)
    expected = torch.stack(results).reshape(*batch, 5, 2)
    torch.testing.assert_close(out["sensor", "ensemble"], expected, rtol=0, atol=1e-11)
    assert out["sensor", "encoding"].shape == (*batch, sensor.encoding_features)
    assert not expected[..., 0, :].equal(expected[..., 1, :])  # members differ


@pytest.mark.parametrize("columns", [1, 2])
def test_unobserved_nan_rows_poison_nothing(columns):
    sensor, frames = make(), random_frames(3)
    noise = draw_noise(sensor, [3])
    observed = torch.tensor([True, False, True]).unsqueeze(-1).expand(3, columns)

    def run(value):
        td = TensorDict({"observed": observed, ("noise", "self"): noise}, [3])
        for key in ("flow", "road"):
            td[key] = frames[key].clone()
            td[key][1] = value
        out = sensor(td)["sensor", "ensemble"]
        assert td["flow"][1, 0, 0, 0].isnan() == (value != value)  # what was handed in is left alone
        return out, torch.autograd.grad(out.square().sum(), list(sensor.parameters()))

    (out, grads), (expected, expected_grads) = run(torch.nan), run(0.0)
    assert out.isfinite().all()
    assert out.equal(expected)
    assert all(g.isfinite().all() and g.equal(e) for g, e in zip(grads, expected_grads, strict=True))
    # The others are read as if they were alone.
    alone = frames[[0, 2]].set(("noise", "self"), noise[[0, 2]])
    torch.testing.assert_close(out[[0, 2]], sensor(alone)["sensor", "ensemble"])


def test_corners_determine_turn_and_pitch(float64):
    sensor = only_the_road(make(two_view_key="two_view"))
    trunk = sensor.module["trunk"]
    silence(trunk.corner_gate)
    with torch.no_grad():
        trunk.corner_gate.bias.fill_(40.0)
        trunk.log_sharpness.fill_(-20.0)  # the road says nothing, so the pitch is that of the corners
        trunk.log_corner_pitch_std.fill_(-2.0)
    frame = known_frame(0.0, 1.0, 0.03)
    frame["two_view"] = torch.tensor([0.05, 0.0, 0.0, 0.0, -0.02, 1e-3, 1e-3, 0.9])
    out = sensor(frame)
    torch.testing.assert_close(out["sensor", "ensemble"][:, 1], torch.full((5,), 0.05 / DT))
    encoding = out["sensor", "encoding"][-12:].tolist()  # seven cues of the flow and the road, five of the corners
    assert encoding[1] == pytest.approx(-0.02 / 0.005, abs=1e-6)
    assert encoding[-1] == pytest.approx(0.9)
    frame["two_view"] = torch.zeros(8)
    out = sensor(frame)
    torch.testing.assert_close(out["sensor", "ensemble"][:, 1], torch.full((5,), 0.03 / DT))
    assert not out["sensor", "encoding"][-5:].any()
