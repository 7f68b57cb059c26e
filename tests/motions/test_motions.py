"""Tests all motions: precision, batches, Jacobians, one graph, shapes that are named; and their noise."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from tests.motions.steps_for_tests import MOTIONS, frame, random_points, step
from torch_denkf.functional.manifolds import SE2, SE3, SO3
from torch_denkf.motions import AttitudeMotion, ConstantTwist, InertialMotion, PlanarMotion
from torch_denkf.motions.motion import integrated, walked

every_motion = pytest.mark.parametrize("make", MOTIONS.values(), ids=MOTIONS)


@every_motion
@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_each_element_moves_by_itself_and_each_member_too(float64, make, batch):
    motion = make()
    state, entries = random_points(motion.space, *batch, 4), frame(motion, *batch)
    moved = step(motion, state, **entries)
    assert moved.shape == state.shape
    for index in torch.cartesian_prod(*map(torch.arange, (*batch, 4))).reshape(-1, len(batch) + 1).tolist():
        own = {key: value[tuple(index[:-1])] for key, value in entries.items()}
        assert_close(step(motion, state[tuple(index)].unsqueeze(0), **own)[0], moved[tuple(index)], rtol=0, atol=1e-13)


@every_motion
def test_a_step_of_an_entry_is_that_of_a_number(float64, make):
    state, entries = random_points(make().space, 2, 4), frame(make(), 2)
    seconds = torch.tensor([[0.1], [0.3]])
    moved = step(make("dt"), state, **entries, dt=seconds)
    for row, dt in enumerate(seconds.flatten().tolist()):
        own = {key: value[row] for key, value in entries.items()}
        assert_close(moved[row], step(make(dt), state[row], **own), rtol=0, atol=1e-14)


@every_motion
def test_two_halves_are_one_step(float64, make):
    """Rates are constant over both: a first half and a second one lead where the whole leads."""
    if make is MOTIONS["wheels"]:
        make = PlanarMotion  # a speed that changes is constant in no half
    whole, half = make(0.8), make(0.4)
    state, entries = random_points(whole.space, 20, 4), frame(whole, 20)
    twice = step(half, step(half, state, **entries), **entries)
    assert_close(
        whole.space.minus(twice, step(whole, state, **entries)),
        torch.zeros(20, 4, whole.space.tangent_dim),
        rtol=0,
        atol=1e-12,
    )


@every_motion
def test_no_time_changes_nothing(float64, make):
    motion = make(0)
    state = random_points(motion.space, 5, 4)
    assert_close(step(motion, state, **frame(motion, 5)), state, rtol=0, atol=1e-15)


@every_motion
@pytest.mark.parametrize("still", [True, False], ids=["at rest", "moving"])
def test_the_jacobian_is_that_of_differences(float64, make, still):
    motion, h = make(), 1e-6
    space, dim = motion.space, motion.space.tangent_dim
    state = space.neutral(torch.zeros(())) if still else random_points(space)
    entries = frame(motion, still=still)
    moved = step(motion, state.unsqueeze(0), **entries)

    def error(tangent):
        return space.minus(step(motion, space.plus(state, tangent).unsqueeze(0), **entries), moved)[0]

    jacobian = torch.func.jacrev(error)(torch.zeros(dim))
    assert jacobian.isfinite().all()
    columns = [(error(h * unit) - error(-h * unit)) / (2 * h) for unit in torch.eye(dim)]
    assert_close(jacobian, torch.stack(columns, -1), rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("make", "argument"),
    [
        (lambda: ConstantTwist(SO3(), 0.1), "space of ConstantTwist"),
        (lambda: ConstantTwist(SE2(), -0.1), "dt must be"),
        (lambda: ConstantTwist(SE2(), 0.1, twist_noise=[1.0, 2.0]), "twist_noise"),
        (lambda: InertialMotion(0.1, gyro_walk=-1.0), "gyro_walk"),
        (lambda: InertialMotion(0.1, gyro_key="gyro"), "accelerometer_key"),
        (lambda: AttitudeMotion(0.1, gyro_noise=math.nan), "gyro_noise"),
        (lambda: PlanarMotion(0.1, damping=-1.0), "damping"),
        (lambda: InertialMotion("dt").process_noise, "given no noise"),
        (lambda: InertialMotion(0.1).process_noise, "given no noise"),
    ],
)
def test_invalid_arguments_raise(make, argument):
    with pytest.raises((TypeError, ValueError), match=argument):
        make()


def test_noise_of_a_second_is_the_density_whatever_the_step():
    """Random walks: what 100 steps add up to, and 400."""
    options = {
        "gyro_noise": 1e-3,
        "accelerometer_noise": [1e-2, 2e-2, 3e-2],
        "gyro_walk": 1e-5,
        "accelerometer_walk": 1e-4,
    }
    for steps in (100, 400):
        noise = torch.tensor(InertialMotion(1 / steps, **options).process_noise, dtype=torch.float64) * steps**0.5
        assert_close(noise[:3], torch.full((3,), 1e-3).double())
        assert_close(noise[3:6], torch.tensor([1e-2, 2e-2, 3e-2]).double())
        assert_close(noise[9:12], torch.full((3,), 1e-5).double())
        assert_close(noise[12:], torch.full((3,), 1e-4).double())
    attitude = AttitudeMotion(0.01, gyro_noise=1e-3, gyro_walk=1e-5).process_noise
    assert attitude == pytest.approx([1e-4] * 3 + [1e-6] * 3)
    assert ConstantTwist(SE3(), "dt", twist_noise=0.3).noise_of_step(3.0)[6:] == pytest.approx([0.3 * 3**0.5] * 6)


@pytest.mark.parametrize(
    "make", [lambda dt: ConstantTwist(SE3(), dt, twist_noise=0.3), lambda dt: PlanarMotion(dt, speed_noise=0.2)]
)
def test_noise_of_steps_that_differ(float64, make):
    """A module writes what ``noise_of_step`` says of each step; a step of no length adds none."""
    steps = torch.tensor([[0.0], [0.01], [3.0]])
    found = make("dt").process_noise(TensorDict({"dt": steps, ("belief", "mean"): torch.zeros(3, 1)}, [3]))[
        "forecast", "noise"
    ]
    expected = torch.tensor([make(1.0).noise_of_step(dt) for dt in steps.flatten().tolist()])
    assert_close(found, expected.square())


@pytest.mark.parametrize("make", [InertialMotion, PlanarMotion], ids=["inertial", "wheels"])
def test_noise_added_step_by_step_is_that_of_the_sensors(float64, make):
    """White noise on readings, or white acceleration, leaves 2,000 members as spread after 100 steps as is claimed."""
    steps, dt, members = 100, 0.01, 2000
    if make is InertialMotion:
        motion = make(dt, gyro_noise=1e-2, accelerometer_noise=0.1, gyro_walk=1e-3, accelerometer_walk=1e-2)
    else:
        motion = make(dt, speed_noise=0.1, turn_noise=0.05, bias_noise=1e-3, scale_noise=1e-3)
    space, noise = motion.space, torch.tensor(motion.process_noise)
    start = (
        space.neutral(torch.zeros(())) if make is InertialMotion else torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    )
    added, drawn = start.expand(members, -1), start.expand(members, -1)
    for _ in range(steps):
        added = space.perturb(step(motion, added, **_level(motion)), noise, torch.randn(members, space.tangent_dim))
        if make is InertialMotion:
            white = torch.tensor([1e-2] * 3 + [0.1] * 3) / dt**0.5
            walks = torch.cat([torch.zeros(9), noise[9:]])
            rows = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 9.81]) + white * torch.randn(members, 6)
            drawn = step(motion, drawn.unsqueeze(1), imu=rows).squeeze(1)
        else:  # half of a step's noise in front of its move, half behind
            walks = torch.cat([torch.zeros(3), noise[3:]])
            drawn = step(motion, space.perturb(drawn, walks / 2**0.5, torch.randn(members, 7)))
            walks = walks / 2**0.5
        drawn = space.perturb(drawn, walks, torch.randn(members, space.tangent_dim))
    end = start if make is InertialMotion else step(make(steps * dt), start.unsqueeze(0))[0]
    spread = [space.minus(members, end).square().mean(0).sqrt() for members in (added, drawn)]
    assert_close(spread[0], spread[1], rtol=0.12, atol=1e-9)  # each is known to 1.6 %; what is neglected falls with dt


def test_noises_of_a_step_are_those_of_a_walk_and_of_its_integral():
    """Variances of n small steps of a walk, and of where it stands in the middle of each, times their length."""
    n, dt, density = 4000, 0.5, [0.3, 2.0]
    small = dt / n
    left = dt - small * (torch.arange(n, dtype=torch.float64) + 0.5)  # of a step's length, behind each small step
    for each, walk, integral in zip(density, walked(density, dt), integrated(density, dt), strict=True):
        assert walk == pytest.approx(each * (n * small) ** 0.5)
        assert integral == pytest.approx(each * (small * left.square().sum().item()) ** 0.5, rel=1e-6)


def _level(motion):
    return {"imu": torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 9.81])} if isinstance(motion, InertialMotion) else {}
