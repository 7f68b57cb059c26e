"""Tracking frame by frame equals filtering the whole drive; cameras that do not fit are noticed."""

import warnings

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torch_denkf.applications.car import read_kitti_drive, track, with_motion
from torch_denkf.applications.car.kitti.gaps import bridge_gaps
from torch_denkf.applications.car.kitti.render import render_drives
from torch_denkf.applications.car.odometry.filter import car_filter
from torch_denkf.pretrained import from_pretrained


def frames_of(drive):
    return [
        image[0].numpy() if valid else None for image, valid in zip(drive["image"], drive["frame_valid"], strict=True)
    ]


def calibration_of(drive):
    return drive["calibration"][0].tolist()


def recorded(car):
    """Returns the filter, and a list that gets the noise of each of its steps."""
    noises, plain = [], car.draw_noise

    def draw(frame, **kwargs):
        out = plain(frame, **kwargs)
        noises.append(out["noise"].clone())
        return out

    object.__setattr__(car, "draw_noise", draw)
    return noises


@pytest.mark.parametrize("lost", [[], [5, 6, 11]])
def test_tracking_equals_filtering_the_whole_drive(lost, checkpoint, drive):
    car = from_pretrained(checkpoint)
    drive["frame_valid"][lost] = False
    noises, state = recorded(car), torch.get_rng_state()
    beliefs = list(track(car, frames_of(drive), calibration_of(drive), seed=7))
    assert torch.equal(state, torch.get_rng_state()), "the global generator is the caller's"
    assert [belief.frame for belief in beliefs] == list(range(16))
    assert [belief.observed for belief in beliefs] == [n > 0 and n not in lost for n in range(16)]

    # The same readings, noise and start, as one sequence. The noises: first reading, start, then a step each.
    motion = with_motion(bridge_gaps(drive), cache=None, two_view=True)
    steps, read = motion["steps"], ("flow", "road", "two_view")
    sequence = TensorDict({key: motion[key].float() for key in read}, [16])
    sequence["observed"], sequence["steps"] = steps > 0, steps
    sequence["noise"] = torch.stack([noises[1], *noises[2:]])
    first = TensorDict({**{key: sequence[key][1] for key in read}, "noise": {"self": noises[0]["sensor"]}})
    sequence["start"] = torch.zeros(16, 5)
    sequence["start"][:, 3:] = car.sensor(first)["sensor", "ensemble"].mean(0).detach()
    with torch.no_grad():
        expected = car.sequence(sequence)["belief"]
    for key in ("mean", "var", "ensemble"):
        actual = torch.stack([getattr(belief, key) for belief in beliefs])
        torch.testing.assert_close(actual, expected[key], rtol=1e-4, atol=1e-4)
    assert beliefs[-1].mean[0] > 1.0, "it moves"


def test_a_faster_camera_is_read_every_third_frame(checkpoint, drive):
    car, calibration = from_pretrained(checkpoint), calibration_of(drive)
    images = frames_of(drive)
    slow = list(track(car, images[:8], calibration, fps=10))
    fast = list(track(car, (images[n // 3] for n in range(22)), calibration, fps=30))
    assert [belief.frame for belief in fast] == [0, 3, 6, 9, 12, 15, 18, 21]
    for one, other in zip(slow, fast, strict=True):
        assert one.time == pytest.approx(other.time)
        assert torch.equal(one.mean, other.mean)
    # The path is geometry; velocities follow the clock: frames 0.1 s apart, a filter of 0.103 s.
    exact = list(track(car, images[:8], calibration))
    torch.testing.assert_close(slow[-1].mean[:3], exact[-1].mean[:3])
    torch.testing.assert_close(slow[-1].mean[3:], 1.03 * exact[-1].mean[3:])
    torch.testing.assert_close(slow[-1].var[3:], 1.03**2 * exact[-1].var[3:])


def test_times_with_a_gap_count_as_missing_frames(checkpoint, drive):
    car, images, calibration = from_pretrained(checkpoint), frames_of(drive), calibration_of(drive)
    kept = [n for n in range(16) if n not in (5, 6)]
    given = list(track(car, [images[n] for n in kept], calibration, times=[5.0 + 0.103 * n for n in kept]))
    marked = list(track(car, [image if n in kept else None for n, image in enumerate(images)], calibration))
    assert given[0].time == 5.0
    assert torch.equal(given[-1].mean, marked[-1].mean)
    far = [0.103 * n + (20 if n > 8 else 0) for n in range(16)]
    with pytest.raises(ValueError, match="steps without a frame before frame 9; track what comes after the gap apart"):
        list(track(car, images, calibration, times=far))


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """Returns a drive with traffic, 45 frames of 50 x 150."""
    folder = tmp_path_factory.mktemp("moving")
    render_drives(folder, names=["m"], frames=45, camera="image_0")
    return read_kitti_drive(folder, "m", colour=False, cache=None)


def messages(drive, factor=1.0, **options):
    calibration = calibration_of(drive)
    calibration[:2] = [factor * value for value in calibration[:2]]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        list(track(car_filter(ensemble_size=4), frames_of(drive), calibration, **options))
    return [str(warning.message) for warning in caught if warning.category is UserWarning]


@pytest.mark.slow
def test_a_camera_that_does_not_fit_is_noticed(moving):
    assert messages(moving) == []
    (message,) = messages(moving, 1.5)
    assert "show 29 degrees to the sides" in message
    assert "the focal lengths are too long for these images" in message
    (message,) = messages(moving, pitch=0.1)
    assert "the camera looks" in message
    suggested = float(message.split("Pass pitch=")[1].split(",")[0])
    assert abs(suggested) < 0.03, "the camera is level"
    assert messages(moving, pitch=suggested) == []
    (message,) = messages(moving, height=4.5)
    assert "m between two frames, where the sensor's range ends" in message


@pytest.mark.parametrize("blank", [0, 255, (20, 20, 240)])
def test_a_frame_of_one_colour_is_missing(blank, checkpoint, drive):
    """It shows nothing, whatever its colour; a few pixels in it, or a little noise, are no street."""
    car, good = from_pretrained(checkpoint), calibration_of(drive)
    images = [np.repeat(image[..., None], 3, -1) for image in frames_of(drive)[:6]]
    covered = np.full_like(images[3], blank)
    covered[5, 5] = 128
    covered = (covered + np.random.default_rng(0).integers(0, 2, covered.shape)).clip(0, 255).astype(np.uint8)
    if blank == 255:
        covered[:] = 255
    expected = list(track(car, [*images[:3], None, *images[4:]], good))
    found = list(track(car, [*images[:3], covered, *images[4:]], good))
    assert [belief.observed for belief in found] == [False, True, True, False, True, True]
    for belief, other in zip(found, expected, strict=True):
        assert belief.mean.equal(other.mean)
    whole = list(track(car, [*images[:3], covered, *images[4:]], good, black_level=None))
    assert [belief.observed for belief in whole] == [False, True, True, True, True, True]
    with pytest.raises(ValueError, match=r"no two frames .* black or of one colour all over do not count"):
        list(track(car, [covered] * 4, good))
