"""Oracles: counts and pictures by hand, OpenCV's box filter, the binomial distribution."""

import cv2
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import TransformedEnv, check_env_specs

from tests.functional.checks import assert_raises
from tests.transforms.envs_for_tests import Changed, base_env
from torch_denkf.envs import BlackFrames, Blur, Brightness, OccludingBox, SaltAndPepper

ALL = [SaltAndPepper, Blur, Brightness, BlackFrames, OccludingBox]


class Striped(Changed):
    """Adds a striped picture to each frame, whose brightness counts the steps."""

    def __init__(self, dtype):
        super().__init__(self.paint)
        self.dtype, self.white = dtype, 255 if dtype == torch.uint8 else 1

    def paint(self, td):
        value = ((td["step"] + 1).float() / 10 * self.white)[..., None, None] * torch.tensor([1.0, 0.5] * 6)
        return td.set("pixels", value.expand(*td.batch_size, 3, 8, 12).to(self.dtype))

    def transform_observation_spec(self, observation_spec):
        shape = (*observation_spec.shape, 3, 8, 12)
        observation_spec["pixels"] = Bounded(0, self.white, shape, dtype=self.dtype)
        return observation_spec


def pictures_env(dtype=torch.uint8, batch=()):
    """Ends rows after three and after four steps."""
    return TransformedEnv(base_env(batch_size=batch, max_steps=[3, 4] if batch else 3), Striped(dtype))


def rng(seed=0):
    return torch.Generator().manual_seed(seed)


def pictures(*batch, size=(3, 10, 30), seed=0):
    return torch.randint(1, 255, (*batch, *size), dtype=torch.uint8, generator=rng(seed))


def disturb(transform, image, batch=None):
    return transform(TensorDict({"pixels": image}, image.shape[:-3] if batch is None else batch))["pixels"]


def test_salt_and_pepper_counts_of_the_paper():
    image = torch.full((1, 375, 1242), 100, dtype=torch.uint8)
    out = disturb(SaltAndPepper(generator=rng()), image)
    assert ((out == 255).sum(), (out == 0).sum(), (out == 100).sum()) == (9000, 9000, 1242 * 375 - 18000)


def test_salt_and_pepper_hits_all_channels_and_is_spread_evenly():
    image = pictures(4000, size=(2, 4, 5))
    out = disturb(SaltAndPepper(0.15, generator=rng()), image)
    white, black = out == 255, out == 0
    assert (white.sum((-1, -2)) == 3).all()  # 0.15 x 20
    assert (black.sum((-1, -2)) == 3).all()
    assert white[:, 0].equal(white[:, 1])
    assert black[:, 0].equal(black[:, 1])
    untouched = ~(white | black)
    assert out[untouched].equal(image[untouched])
    for kind in (white, black):  # each place is hit by 600 frames of 4000, binomially
        hits = kind[:, 0].sum(0)
        assert ((hits - 600).abs() < 5 * (4000 * 0.15 * 0.85) ** 0.5).all()


def test_blur_of_impulses_by_hand():
    image = torch.zeros(1, 7, 9, dtype=torch.float64)
    image[0, 3, 4] = 1.0
    expected = torch.zeros(1, 7, 9, dtype=torch.float64)
    expected[0, 2:5, 2:7] = 1 / 15
    torch.testing.assert_close(disturb(Blur((3, 5)), image), expected)
    corner = torch.zeros(1, 7, 9)
    corner[0, 0, 0] = 1.0
    out = disturb(Blur(3), corner)  # 4, 6 and 9 pixels of the box are inside
    torch.testing.assert_close(out[0, :3, :3], torch.tensor([[1 / 4, 1 / 6, 0], [1 / 6, 1 / 9, 0], [0, 0, 0]]))


@pytest.mark.parametrize(("width", "side"), [(40, 3), (150, 3), (332, 5), (414, 5), (640, 7), (1242, 15)])
def test_blur_follows_the_width(width, side):
    image = torch.zeros(1, 1, 31, width)
    image[..., 15, width // 2] = 1.0
    out = disturb(Blur(), image)
    assert (out > 0).sum() == side * side
    torch.testing.assert_close(out.max().item(), 1 / side**2)


def test_brightness_draws_for_each_frame_within_its_bounds():
    image = torch.tensor([0.25, 0.75], dtype=torch.float64).expand(20_000, 1, 1, 2)
    out = disturb(Brightness((0.6, 1.0), (0.0, 0.2), generator=rng()), image)[:, 0, 0]
    gain = (out[:, 1] - out[:, 0]) / 0.5
    offset = out[:, 0] - 0.25 * gain
    for value, low, high in ((gain, 0.6, 1.0), (offset, 0.0, 0.2)):
        assert low <= value.min() + 1e-12
        assert value.max() <= high + 1e-12
        sigma = (high - low) / 12**0.5
        assert abs(value.mean() - (low + high) / 2) < 5 * sigma / 20_000**0.5
        assert abs(value.std() / sigma - 1) < 0.03
    assert abs(torch.corrcoef(torch.stack([gain, offset]))[0, 1]) < 5 / 20_000**0.5
    assert_raises(ValueError, r"gain is \(lowest, highest\)", Brightness, (1.0, 0.5))
    assert_raises(ValueError, "cannot be negative", Brightness, (-1.0, 0.5))


def test_box_of_the_paper():
    image = torch.full((1, 375, 1242), 7, dtype=torch.uint8)
    expected = image.clone()
    expected[:, 100:250, 500:650] = 0
    assert disturb(OccludingBox(), image).equal(expected)


def test_random_boxes_are_whole_and_everywhere():
    image = torch.ones(6000, 1, 4, 5)
    covered = disturb(OccludingBox((0.5, 0.4), None, generator=rng()), image)[:, 0] == 0
    assert (covered.sum((-1, -2)) == 4).all()  # 2 x 2
    rows, columns = covered.any(-1), covered.any(-2)
    assert (rows.sum(-1) == 2).all()
    assert (columns.sum(-1) == 2).all()
    first = rows.int().argmax(-1) * 4 + columns.int().argmax(-1)  # 3 x 4 places
    counts = torch.bincount(first, minlength=12)
    assert len(counts) == 12
    assert ((counts - 500).abs() < 5 * (6000 / 12 * 11 / 12) ** 0.5).all()


def test_black_frames_are_not_masked():
    image = pictures(20_000, size=(1, 1, 2))
    out = BlackFrames(0.3, generator=rng())(
        TensorDict({"pixels": image, "observed": torch.ones(20_000, 1).bool()}, [20_000])
    )
    black = (out["pixels"] == 0).flatten(1).all(-1)
    assert abs(black.sum() - 6000) < 5 * (20_000 * 0.3 * 0.7) ** 0.5
    assert out["pixels"][~black].equal(image[~black])
    assert out["observed"].all()


@pytest.mark.parametrize("kind", ALL)
def test_common_properties(kind):
    image = pictures(2, 3, size=(3, 10, 30))
    before = image.clone()
    td = TensorDict({"pixels": image}, [2])
    out = kind(p=1.0, generator=rng(1))(td)["pixels"]
    assert (out.dtype, out.shape) == (image.dtype, image.shape)
    assert td["pixels"] is image  # the argument keeps its entry,
    assert image.equal(before)  # and that its values
    assert not out.equal(image)
    # Same seed, same frames, whatever the batch dimensions; torch's own generator is left alone.
    state = torch.get_rng_state()
    assert disturb(kind(p=1.0, generator=rng(1)), image.flatten(0, 1)).equal(out.flatten(0, 1))
    assert torch.get_rng_state().equal(state)
    single = disturb(kind(p=1.0, generator=rng(1)), image[0, 0])
    assert single.shape == (3, 10, 30)
    # Floating images show the same, in their own dtype.
    half = 0.5 / 255  # the uint8 result is rounded
    for dtype, atol in (
        (torch.float64, half + 1e-6),
        (torch.float32, half + 1e-6),
        (torch.float16, half + 2.5 * 2**-12),  # its values are rounded too: before, times at most 1.5, and after
    ):
        floating = disturb(kind(p=1.0, generator=rng(1)), (image.double() / 255).to(dtype))
        assert floating.dtype == dtype
        assert floating.min() >= 0
        assert floating.max() <= 1
        torch.testing.assert_close(floating.double(), out.double() / 255, atol=atol, rtol=0)


@pytest.mark.parametrize("kind", ALL)
def test_chance_of_each_frame(kind):
    image = pictures(4000, size=(1, 4, 8))
    hit = (disturb(kind(p=0.25, generator=rng()), image) != image).flatten(1).any(-1)
    assert abs(hit.sum() - 1000) < 5 * (4000 * 0.25 * 0.75) ** 0.5
    assert disturb(kind(p=0.0), image).equal(image)
    assert_raises(ValueError, r"in \[0, 1\]; got 1\.5", kind, p=1.5)


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize(("dtype", "batch"), [(torch.uint8, ()), (torch.float32, (2,))])
def test_in_an_environment(kind, dtype, batch):
    base = pictures_env(dtype, batch)
    env = TransformedEnv(base, kind(p=1.0))
    check_env_specs(env)
    assert env.observation_spec == base.observation_spec
    plain, rollout = base.rollout(3), env.rollout(3)
    assert rollout["step"].equal(plain["step"])
    for shown, before in ((rollout, plain), (rollout["next"], plain["next"])):  # resets and steps
        assert (shown["pixels"] != before["pixels"]).flatten(-3).any(-1).all()


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
@pytest.mark.parametrize("fill", ["blur", "noise"])
def test_image_behind_an_occluding_box(dtype, fill):
    """Blur is OpenCV's box filter; noise is uniform between black and white; around the box nothing changes."""
    image, white = pictures(2, size=(3, 32, 32)), 255 if dtype == torch.uint8 else 1.0
    image = image if dtype == torch.uint8 else image.float() / 255
    out = disturb(OccludingBox((0.5, 0.5), (0.25, 0.5), fill=fill, generator=rng()), image)
    assert out.dtype == dtype
    inside, changed = (..., slice(8, 24), slice(16, 32)), out != image
    assert changed[inside].float().mean() > 0.9
    changed[inside] = False
    assert not changed.any()
    values = out[inside].double() / white
    if fill == "noise":  # 4,608 numbers: their mean and standard deviation are known to 0.004
        assert values.mean().item() == pytest.approx(0.5, abs=0.02)
        assert values.std().item() == pytest.approx(12**-0.5, abs=0.02)
        assert 0 <= values.min() <= values.max() <= 1
    else:  # away from the right border, which OpenCV mirrors
        expected = torch.tensor(cv2.blur(image[0, 0].double().numpy() / white, (9, 9)))[8:24, 16:24]
        assert (values[0, 0, :, :8] - expected).abs().max() < (1 / 255 if dtype == torch.uint8 else 1e-5)
    with pytest.raises(ValueError, match="fill is"):
        OccludingBox(fill="white")
