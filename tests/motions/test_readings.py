"""Oracles: matrices, complex numbers, MuJoCo's magnetometer, differences."""

import mujoco
import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from tests.motions.steps_for_tests import INERTIAL, observe, random_points
from torch_denkf.functional.manifolds import SE2, SE3, SE23, SO3, Circle, Euclidean, Product, rotation_matrix
from torch_denkf.motions import Gravity, Magnetic, PoseOf, PositionInBody, RangeBearing

LANDMARKS = [[1.0, 2.0, 3.0], [-4.0, 5.0, 6.0]]
FLAT = Product(Euclidean(2), SE2(), Euclidean(1))
DEEP = Product(Euclidean(2), SE3())
READINGS = {
    "gravity": lambda: Gravity(INERTIAL),
    "field": lambda: Magnetic(DEEP, [0.2, 0.1, -0.4], part=1),
    "pose": lambda: PoseOf(FLAT, part=1),
    "landmarks": lambda: PositionInBody(INERTIAL, LANDMARKS),
    "landmarks in the plane": lambda: PositionInBody(FLAT, [3.0, 4.0], part=1),
    "range and bearing": lambda: RangeBearing(FLAT, [3.0, 4.0], part=1),
}
every_reading = pytest.mark.parametrize("make", READINGS.values(), ids=READINGS)


def test_directions_are_rows_of_the_rotation(float64):
    for space, part, begin in ((SO3(), 0, 0), (SE3(), 0, 0), (SE23(), 0, 0), (DEEP, 1, 2)):
        state = random_points(space, 5, 4)
        turn = rotation_matrix(state[..., begin : begin + 4])
        assert_close(observe(Gravity(space, part=part), state), 9.81 * turn[..., 2, :])
        field = torch.randn(3)
        expected = (turn.mT @ field.unsqueeze(-1)).squeeze(-1)
        assert_close(observe(Magnetic(space, field, part=part), state), expected)


def test_landmarks_in_space(float64):
    for space, part, begin in ((SE3(), 0, 0), (INERTIAL, 0, 0), (DEEP, 1, 2)):
        state = random_points(space, 5, 4)
        turn = rotation_matrix(state[..., begin : begin + 4])
        place = state[..., begin + 7 : begin + 10] if space is INERTIAL else state[..., begin + 4 : begin + 7]
        expected = [(turn.mT @ (torch.tensor(each) - place).unsqueeze(-1)).squeeze(-1) for each in LANDMARKS]
        reading = PositionInBody(space, LANDMARKS, part=part)
        assert_close(observe(reading, state), torch.cat(expected, -1))
        assert reading.reading_space == Euclidean(6)
        assert_close(observe(PositionInBody(space, LANDMARKS[0], part=part), state), expected[0])


def test_landmarks_in_the_plane(float64):
    state = random_points(FLAT, 5, 4)
    angle, x, y = state[..., 2:5].unbind(-1)
    away = (torch.complex(3 - x, 4 - y)) * torch.exp(-1j * angle)
    assert_close(observe(READINGS["landmarks in the plane"](), state), torch.stack([away.real, away.imag], -1))
    reading = RangeBearing(FLAT, [3.0, 4.0], part=1)
    assert_close(observe(reading, state), torch.stack([away.abs(), away.angle()], -1))
    assert reading.reading_space == Product(Euclidean(1), Circle())


def test_pose_of_returns_the_pose():
    state = random_points(DEEP, 5, 4)
    assert observe(PoseOf(DEEP, part=1), state).equal(state[..., 2:])
    assert PoseOf(DEEP, part=1).reading_space == SE3()
    assert observe(PoseOf(SE3()), state[..., 2:]).equal(state[..., 2:])


def test_at_the_landmark_itself_all_is_finite():
    state = torch.tensor([[0.5, 3.0, 4.0]], requires_grad=True)
    read = RangeBearing(SE2(), [3.0, 4.0]).observe(state)
    assert read.tolist() == [[0.0, 0.0]]
    read.sum().backward()
    assert state.grad.tolist() == [[0.0, 0.0, 0.0]]


def test_a_magnetometer_of_mujoco(float64):
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option magnetic="0.1 20 -40"/><worldbody><body quat="0.5 0.1 -0.3 0.8"><freejoint/>'
        '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><site name="here"/></body></worldbody>'
        '<sensor><magnetometer site="here"/></sensor></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    read = Magnetic(SO3(), [0.1, 20.0, -40.0]).observe(torch.tensor(data.qpos[3:]))
    assert_close(read, torch.tensor(data.sensordata), rtol=0, atol=1e-12)


@every_reading
def test_the_jacobian_is_that_of_differences(float64, make):
    reading, h = make(), 1e-6
    space, state = reading.space, random_points(reading.space)

    def read(tangent):
        return reading.compute(space.plus(state, tangent).unsqueeze(0))[0]

    units = torch.eye(space.tangent_dim)
    columns = [(read(h * unit) - read(-h * unit)) / (2 * h) for unit in units]
    assert_close(torch.func.jacrev(read)(torch.zeros(len(units))), torch.stack(columns, -1), rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Gravity(SE2()), r"Gravity reads a part that is SO3\(\) or SE3\(\) or SE23\(\); part 0 of SE2\(\)"),
        (lambda: Gravity(7), "space of Gravity"),
        (lambda: Gravity(SO3(), gravity=-1.0), "gravity must be"),
        (lambda: Gravity(INERTIAL, part=3), "part must be a whole number, at least 0 and at most 2; got 3"),
        (lambda: Magnetic(SO3(), [1.0, 2.0]), r"field is \[3\]; got \[2\]"),
        (lambda: PositionInBody(SO3(), [1.0, 2.0, 3.0]), "PositionInBody reads a part"),
        (lambda: PositionInBody(SE3(), [1.0, 2.0]), r"landmark is \[3\] or \[2, 3\]; got \[2\]"),
        (lambda: RangeBearing(SE3(), [1.0, 2.0, 3.0]), "RangeBearing reads a part"),
        (lambda: RangeBearing(SE2(), [[1.0, 2.0, 3.0]]), r"landmark is \[2\] or \[1, 2\]"),
        (lambda: RangeBearing(SE2()), "takes landmark=, or landmark_key="),
        (lambda: RangeBearing(SE2(), [1.0, 2.0], landmark_key="post"), "takes landmark=, or landmark_key="),
        (lambda: PositionInBody(SE2(), [1.0, float("nan")]), "landmark must be finite"),
    ],
)
def test_invalid_arguments_raise(make, words):
    with pytest.raises((TypeError, ValueError), match=words):
        make()


@pytest.mark.parametrize("space", [Product(SO3(), SE2()), Product(Euclidean(1), SE23(), SE2())])
def test_part_offset_in_a_product(space):
    """A rotation in front has four numbers, and three directions."""
    state = random_points(space, 5, 4)
    pose = state[..., -3:]
    assert observe(PoseOf(space, part=len(space.parts) - 1), state).equal(pose)
    expected = observe(PositionInBody(SE2(), [3.0, 4.0]), pose)
    assert observe(PositionInBody(space, [3.0, 4.0], part=len(space.parts) - 1), state).equal(expected)


@pytest.mark.parametrize("kind", [PositionInBody, RangeBearing])
def test_landmarks_from_the_data(float64, kind):
    """Each row reads its own ones, as the same landmarks given as constants are read."""
    pose, posts = torch.randn(5, 4, 3), torch.randn(5, 6)
    key = ("forecast", "observation")
    td = TensorDict({("forecast", "ensemble"): pose, "posts": posts}, [5])
    found = kind(SE2(), landmark_key="posts", count=3)(td)[key]
    for row in range(5):
        one = TensorDict({("forecast", "ensemble"): pose[row]})
        assert_close(kind(SE2(), posts[row].reshape(3, 2))(one)[key], found[row])
    with pytest.raises(ValueError, match=r"'posts' is \[\*B, 4\], 2 landmarks of 2 numbers; got \[5, 6\]"):
        kind(SE2(), landmark_key="posts", count=2)(td)


@pytest.mark.parametrize("kind", [PositionInBody, RangeBearing])
def test_jacobian_of_landmarks_from_the_data(float64, kind):
    """Against differences along the tangents of the pose."""
    model, pose, posts = kind(SE2(), landmark_key="posts", count=2), torch.randn(1, 3), torch.randn(4)
    _, matrix = model.jacobian(pose, posts)
    steps = 1e-6 * torch.eye(3)
    ahead, behind = (model.compute(SE2().plus(pose, sign * steps), posts) for sign in (1, -1))
    assert_close(matrix[0], (ahead - behind).T / 2e-6, rtol=0, atol=1e-7)
