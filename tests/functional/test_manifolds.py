"""Oracles: the exponential of matrices, MuJoCo's quaternions, jaxlie's groups, autodiff, and numbers by hand."""

import json
import math

import mujoco
import numpy as np
import pytest
import torch

from tests.functional.checks import assert_compiled_is_eager
from tests.functional.jaxlie_values import FILE
from torch_denkf.functional.angles import wrap_angles
from torch_denkf.functional.manifolds import (
    SE2,
    SE3,
    SE23,
    SO3,
    Circle,
    Euclidean,
    Flat,
    Opposite,
    Product,
    Repeated,
    Turned,
    quaternion_of,
    quaternion_product,
    rotate,
    rotation_matrix,
    skew,
)

MOTIONS = [SO3(), SE2(), SE3(), SE23(), Turned(3)]
SPACES = [
    *(Euclidean(2), Circle(), *MOTIONS, Product(SO3(), Euclidean(2), SE2()), Product(Product(Circle()), SE23())),
    Repeated(Product(Circle(), SE3()), 2),
    Opposite(SE23()),
]
ANGLES = {
    Circle(): 1,
    SE2(): 1,
    SO3(): 3,
    SE3(): 3,
    SE23(): 3,
    Turned(3): 3,
}  # leading components of a tangent that are a rotation
# Double precision, on numbers of size one and a handful of operations.
EXACT = {"rtol": 0, "atol": 1e-13}


pytestmark = pytest.mark.usefixtures("float64")


def tangents(space, *batch, size=None):
    """Returns random tangents; of a motion with rotations of one size, in rad."""
    value = torch.randn(*batch, space.tangent_dim)
    if size is not None and space in ANGLES:
        turn, rest = value[..., : ANGLES[space]], value[..., ANGLES[space] :]
        value = torch.cat([size * turn / turn.norm(dim=-1, keepdim=True), rest], -1)
    return value


def near(space, *batch, most=2.5):
    """Returns random tangents whose logarithm is themselves: rotations below half a turn."""
    value = tangents(space, *batch)
    return value * (most / value.norm(dim=-1, keepdim=True).clamp_min(most))


def points(space, *batch):
    return space.exp(tangents(space, *batch))


def matrix(space, point):
    """Returns the matrix whose product is that of the space."""
    if isinstance(space, SE2):
        angle, x, y = point.unbind(-1)
        rows = [[angle.cos(), -angle.sin(), x], [angle.sin(), angle.cos(), y], [0 * x, 0 * x, 0 * x + 1]]
        return torch.stack([torch.stack(row, -1) for row in rows], -2)
    out = torch.eye(3 + space.vectors).repeat(*point.shape[:-1], 1, 1)
    out[..., :3, :3] = rotation_matrix(point[..., :4])
    for place, vector in enumerate(point[..., 4:].split(3, -1) if space.vectors else ()):
        out[..., :3, 3 + place] = vector
    return out


def generator(space, tangent):
    """Returns the matrix whose exponential is the matrix of the point."""
    if isinstance(space, SE2):
        angle, x, y = tangent.unbind(-1)
        zero = 0 * x
        rows = [[zero, -angle, x], [angle, zero, y], [zero, zero, zero]]
        return torch.stack([torch.stack(row, -1) for row in rows], -2)
    out = tangent.new_zeros(*tangent.shape[:-1], 3 + space.vectors, 3 + space.vectors)
    out[..., :3, :3] = skew(tangent[..., :3])
    for place, vector in enumerate(tangent[..., 3:].split(3, -1) if space.vectors else ()):
        out[..., :3, 3 + place] = vector
    return out


def assert_same_points(space, one, other, **tolerance):
    """A quaternion and its negative are the same rotation: the tangent between two same points is zero."""
    zero = torch.zeros(*one.shape[:-1], space.tangent_dim).to(one)
    torch.testing.assert_close(space.minus(one, other), zero, **(tolerance or {"rtol": 0, "atol": 1e-12}))


# -------------------------------------------------------------------------------------------- other people's code


@pytest.mark.parametrize("space", MOTIONS, ids=repr)
@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.099, 0.101, 1.0, 3.0, 6.0, 40.0])
def test_exp_is_that_of_matrices(space, size):
    tangent = tangents(space, 20, size=size)
    expected = torch.linalg.matrix_exp(generator(space, tangent))
    # matrix_exp squares its result as often as the norm asks for, and each time doubles the rounding.
    torch.testing.assert_close(matrix(space, space.exp(tangent)), expected, rtol=0, atol=1e-12 * (1 + size))


@pytest.mark.parametrize("space", MOTIONS, ids=repr)
def test_products_are_those_of_matrices(space):
    first, second = points(space, 50), points(space, 50)
    torch.testing.assert_close(
        matrix(space, space.compose(first, second)), matrix(space, first) @ matrix(space, second), **EXACT
    )
    torch.testing.assert_close(matrix(space, space.inverse(first)), matrix(space, first).inverse(), **EXACT)


# jaxlie's order: a rotation stands last in its tangents; in the plane its points are (cos, sin, x, y).
ORDER = {"SO3": [0, 1, 2], "SE2": [2, 0, 1], "SE3": [3, 4, 5, 0, 1, 2]}


def from_jaxlie(name, point):
    return torch.cat([torch.atan2(point[1:2], point[:1]), point[2:]]) if name == "SE2" else point


@pytest.mark.parametrize("case", json.loads(FILE.read_text()), ids=lambda case: case["kind"])
def test_groups_are_those_of_jaxlie(case):
    name = case.pop("kind")
    space, order = {"SO3": SO3(), "SE2": SE2(), "SE3": SE3()}[name], ORDER[name]
    value = {key: torch.tensor(numbers) for key, numbers in case.items()}
    first, second = value["first"][order], value["second"][order]
    x, y = space.exp(first), space.exp(second)
    for own, key in ((x, "exp"), (space.compose(x, y), "compose"), (space.inverse(x), "inverse")):
        assert_same_points(space, own, from_jaxlie(name, value[key]))
    torch.testing.assert_close(space.adjoint(x), value["adjoint"][order][:, order], **EXACT)
    # Both take the logarithm to about 1e-15 over the distance from half a turn, 0.14 rad here.
    for point, key in ((x, "log"), (space.compose(x, y), "log of compose")):
        torch.testing.assert_close(space.log(point), value[key][order], rtol=0, atol=1e-12)


def by_mujoco(function, size, *inputs):
    out = np.zeros(size)
    function(out, *(value.numpy() if isinstance(value, torch.Tensor) else value for value in inputs))
    return torch.from_numpy(out)


def test_rotations_are_those_of_mujoco():
    space = SO3()
    for first, second, tangent in zip(points(space, 40), points(space, 40), near(space, 40), strict=True):
        product = by_mujoco(mujoco.mju_mulQuat, 4, first, second)
        torch.testing.assert_close(quaternion_product(first, second), product, **EXACT)
        assert_same_points(space, space.compose(first, second), product)
        turned = by_mujoco(mujoco.mju_rotVecQuat, 3, tangent, first)
        torch.testing.assert_close(rotate(first, tangent), turned, **EXACT)
        whole = by_mujoco(mujoco.mju_quat2Mat, 9, first).reshape(3, 3)
        torch.testing.assert_close(rotation_matrix(first), whole, **EXACT)
        difference = by_mujoco(mujoco.mju_subQuat, 3, first, second)
        # MuJoCo takes 2 pi off angles above pi by its own sine: 1e-12 is rounding.
        torch.testing.assert_close(space.minus(first, second), difference, rtol=0, atol=1e-12)


def test_quaternions_of_mujocos_matrices_in_all_quadrants():
    """Each of the four components is the largest once, with all signs of the others, or the only one."""
    signs = torch.cartesian_prod(torch.tensor([5.0]), *[torch.tensor([1.0, -1.0])] * 3)
    stack = torch.cat([torch.eye(4), *(signs.roll(place, -1) for place in range(4)), points(SO3(), 100)])
    stack = stack / stack.norm(dim=-1, keepdim=True)
    own = quaternion_of(rotation_matrix(stack))
    torch.testing.assert_close((own * stack).sum(-1).abs(), torch.ones(len(stack)), **EXACT)
    for quaternion, found in zip(stack, own, strict=True):
        by_name = by_mujoco(mujoco.mju_mat2Quat, 4, rotation_matrix(quaternion).flatten())
        torch.testing.assert_close((by_name @ found).abs().item(), 1.0, **EXACT)


# ------------------------------------------------------------------------------------------------------ the group


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_plus_and_minus_are_inverse(space):
    point, tangent = points(space, 3, 20), near(space, 3, 20)
    moved = space.plus(point, tangent)
    torch.testing.assert_close(space.minus(moved, point), tangent, rtol=0, atol=1e-11)
    assert_same_points(space, space.plus(point, space.minus(moved, point)), moved)
    torch.testing.assert_close(space.log(space.exp(tangent)), tangent, rtol=0, atol=1e-11)
    neutral = space.neutral(point)
    assert_same_points(space, space.compose(point, space.inverse(point)), neutral.expand_as(point))
    assert_same_points(space, space.compose(neutral.expand_as(point), point), point)
    assert_same_points(space, space.neutral().to(point), neutral)
    # The tangent seen from the other end is the negative one.
    torch.testing.assert_close(space.minus(point, moved), -space.minus(moved, point), rtol=0, atol=1e-11)
    torch.testing.assert_close(space.distance(moved, point), tangent.norm(dim=-1), rtol=0, atol=1e-11)
    first, second = points(space, 3, 20), points(space, 3, 20)
    assert_same_points(
        space, space.compose(space.compose(first, second), point), space.compose(first, space.compose(second, point))
    )
    noise, std = torch.randn_like(tangent), torch.rand(space.tangent_dim)
    assert space.perturb(point, std, noise).equal(space.plus(point, std * noise))


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_adjoint(space):
    point, tangent = points(space, 30), near(space, 30, most=1.0)
    left = space.compose(space.exp(tangent), point)
    back = space.adjoint(space.inverse(point)) @ tangent.unsqueeze(-1)
    assert_same_points(space, space.plus(point, back.squeeze(-1)), left)
    right = space.compose(point, space.exp(tangent))
    ahead = space.adjoint(point) @ tangent.unsqueeze(-1)
    assert_same_points(space, space.compose(space.exp(ahead.squeeze(-1)), point), right)


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_bases_are_derivatives_of_plus(space):
    point, zero = points(space), torch.zeros(space.tangent_dim)
    plus = torch.func.jacrev(lambda step: space.plus(point, step))(zero)
    minus = torch.func.jacrev(lambda other: space.minus(other, point))(point)
    torch.testing.assert_close(space.basis(point), plus, **EXACT)
    # Points off the space have no tangent.
    torch.testing.assert_close(space.dual_basis(point) @ plus, minus @ plus, **EXACT)
    torch.testing.assert_close(space.dual_basis(point) @ plus, torch.eye(space.tangent_dim), **EXACT)


def test_a_quaternion_and_its_negative_are_one_rotation():
    for space in (SO3(), SE3(), SE23()):
        point, origin = points(space, 20), points(space, 20)
        other = torch.cat([-point[..., :4], point[..., 4:]], -1)
        torch.testing.assert_close(space.minus(other, origin), space.minus(point, origin), rtol=0, atol=1e-12)
        torch.testing.assert_close(space.adjoint(other), space.adjoint(point), **EXACT)


# ---------------------------------------------------------------------------------------------------- derivatives


def of_one(function, *values):
    """Returns the derivative of ``function`` of vectors, by the first of them, of each row."""
    return torch.func.vmap(torch.func.jacrev(function))(*values)


@pytest.mark.parametrize("space", SPACES, ids=repr)
@pytest.mark.parametrize("size", [0.0, 1e-6, 0.05, 0.099, 0.101, 0.3, 1.0, 3.0])
def test_right_jacobian_is_that_of_autodiff(space, size):
    tangent = tangents(space, 10, size=size) if space in ANGLES else size * near(space, 10, most=1.0)

    def step(delta, base):
        return space.log(space.compose(space.inverse(space.exp(base)), space.exp(base + delta)))

    expected = of_one(step, torch.zeros_like(tangent), tangent)
    # The formula of the lower block divides by the fifth power of the angle, 1e-5 above its series' end: 1e-17 of its
    # numerator is 1e-12 of the result, and a few times that.
    torch.testing.assert_close(space.right_jacobian(tangent), expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_gradients(space):
    point = points(space, 2).requires_grad_()
    # 0.9 to 2.1 rad: neither at zero, where rotations have a cone, nor across half a turn.
    tangent = near(space, 2, most=1.0).requires_grad_()
    origin = space.plus(point.detach(), near(space, 2, most=1.0)).requires_grad_()
    group = torch.randn(2, 4, space.tangent_dim).mul(0.2).requires_grad_()

    def mean(center, away):
        return space.minus(space.mean(space.plus(center.unsqueeze(-2), away)), center.detach())

    for function, inputs in (
        *((space.plus, (point, tangent)), (space.minus, (point, origin)), (mean, (point.detach(), group))),
        *((function, (tangent,)) for function in (space.exp, space.right_jacobian)),
        *((function, (point,)) for function in (space.adjoint, space.basis, space.dual_basis)),
    ):
        assert torch.autograd.gradcheck(function, inputs, fast_mode=True)  # along random directions
    assert torch.autograd.gradgradcheck(space.exp, (tangent,), fast_mode=True)


# -------------------------------------------------------------------------------------- at zero and at half a turn


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("space", [Circle(), *MOTIONS], ids=repr)
@pytest.mark.parametrize("size", [0.0, 1e-30, 1e-12, 1e-6, 1e-3, 0.1, 0.5, 1.0, 2.0, 3.0, 3.1, math.pi - 1e-6, math.pi])
def test_all_sizes_of_rotations(space, size, dtype):
    tangent = tangents(space, 20, size=size).to(dtype).requires_grad_()
    point = space.exp(tangent)
    found = space.log(point)
    count, rounding = ANGLES[space], torch.finfo(dtype).eps
    # Above the end of the series, 0.1 rad, the versine 0.005 is 1 - cos: its rounding is 200 eps.
    tolerance = 200 * rounding
    back = found.detach()
    if size > 3.1:  # rounding may have carried it beyond half a turn, where the shorter way is the other one
        assert (back[..., :count].norm(dim=-1) - size).abs().max() < tolerance
        assert_same_points(space, space.exp(back), point.detach(), rtol=0, atol=2 * tolerance)
    else:
        torch.testing.assert_close(back, tangent.detach(), rtol=0, atol=tolerance)
        # Small rotations keep all their digits.
        turn = tangent.detach()[..., :count]
        torch.testing.assert_close(back[..., :count], turn, rtol=20 * rounding, atol=0 if count > 1 else tolerance)
    for value in (point, found, space.right_jacobian(tangent), space.adjoint(point), space.minus(point, point)):
        assert value.isfinite().all()
        if value.requires_grad:  # the derivatives of numbers and angles are constant
            (gradient,) = torch.autograd.grad(value.sum(), tangent, retain_graph=True)
            assert gradient.isfinite().all()
    # exp and log are inverse, so the derivative of their composition is the identity.
    if size <= 3.1:
        both = of_one(lambda value: space.log(space.exp(value)), tangent.detach())
        identity = torch.eye(space.tangent_dim).to(dtype).expand_as(both)
        # The versine's derivative divides its rounding by the fourth power of the angle, 1e-4 above the series' end.
        torch.testing.assert_close(both, identity, rtol=0, atol=3e4 * rounding)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("space", MOTIONS, ids=repr)
def test_exactly_half_a_turn(space, dtype):
    if isinstance(space, SE2):
        point = torch.tensor([math.pi, 1.0, 2.0], dtype=dtype).requires_grad_()
    else:
        axis = torch.tensor([0.0, 2.0, 3.0, 6.0], dtype=dtype) / 7
        point = torch.cat([axis, torch.arange(3.0 * space.vectors).to(dtype)]).requires_grad_()
    tangent = space.log(point)
    angle = tangent[: ANGLES[space]].norm()
    torch.testing.assert_close(angle.item(), math.pi, rtol=0, atol=10 * torch.finfo(dtype).eps)
    assert_same_points(space, space.exp(tangent), point, rtol=0, atol=50 * torch.finfo(dtype).eps)
    (gradient,) = torch.autograd.grad(tangent.sum(), point)
    assert gradient.isfinite().all()


# ----------------------------------------------------------------------------------------------------------- means


@pytest.mark.parametrize("space", SPACES, ids=repr)
@pytest.mark.parametrize("weighted", [False, True])
def test_tangents_at_the_mean_add_up_to_zero(space, weighted):
    members = space.plus(points(space, 3, 1).expand(3, 12, -1), 0.1 * torch.randn(3, 12, space.tangent_dim))
    weights = torch.rand(3, 12).softmax(-1) if weighted else None
    mean = space.mean(members, weights)
    assert mean.shape == (3, space.point_dim)
    away = space.minus(members, mean.unsqueeze(-2))
    left = away.mean(-2) if weights is None else (weights.unsqueeze(-1) * away).sum(-2)
    # Each of the steps leaves about the square of the spread, 0.01 to 0.03, of what was left.
    torch.testing.assert_close(left, torch.zeros_like(left), rtol=0, atol=1e-8)


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_the_mean_of_moved_points_is_the_moved_mean(space):
    members = space.plus(points(space, 1).expand(12, -1), 0.1 * torch.randn(12, space.tangent_dim))
    weights, move = torch.rand(12).softmax(-1), points(space)
    mean = space.mean(members, weights)
    left = space.mean(space.compose(move.expand_as(members), members), weights)
    # The same values up to rounding; those of an opposite space rotate.
    loose = {"rtol": 0, "atol": 1e-7} if isinstance(space, Opposite) else {}
    assert_same_points(space, left, space.compose(move, mean), **loose)
    right = space.mean(space.compose(members, move.expand_as(members)), weights)
    # From the right the axes of all tangents turn: the same mean, found to the same 1e-8 on another way.
    assert_same_points(space, right, space.compose(mean, move), rtol=0, atol=1e-7)
    order = torch.randperm(12)
    assert_same_points(space, space.mean(members[order], weights[order]), mean, rtol=0, atol=1e-7)


def test_means_of_numbers_and_angles():
    members, weights = torch.randn(3, 7, 2), torch.rand(3, 7).softmax(-1)
    assert Euclidean(2).mean(members).equal(members.mean(-2))
    torch.testing.assert_close(Euclidean(2).mean(members, weights), torch.einsum("be,bep->bp", weights, members))
    across = wrap_angles(torch.tensor([[3.0], [3.4], [3.5]]))
    torch.testing.assert_close(Circle().mean(across), wrap_angles(torch.tensor([3.3])), **EXACT)
    torch.testing.assert_close(
        Circle().mean(across, torch.tensor([0.5, 0.25, 0.25])), wrap_angles(torch.tensor([3.225])), **EXACT
    )
    one = points(SE3(), 5, 1)
    assert_same_points(SE3(), SE3().mean(one), one.squeeze(-2))


# ------------------------------------------------------------------------------------------ graphs, shapes, errors


SLOW = [pytest.param(space, marks=pytest.mark.slow) for space in (SO3(), Product(SE23(), Circle(), Euclidean(2)))]


@pytest.mark.parametrize("space", [SE2(), *SLOW], ids=repr)
def test_compiled_is_eager(space, monkeypatch):
    monkeypatch.setattr("torch_denkf.functional.manifolds.space._MEAN_STEPS", 1)  # which are all alike
    point, origin, tangent = (make(space, 3, 5).requires_grad_() for make in (points, points, near))

    def everything(point, origin, tangent):
        axes = space.right_jacobian(tangent) @ space.adjoint(point)
        return space.plus(point, tangent), space.minus(point, origin), axes, space.mean(space.plus(origin, tangent))

    assert_compiled_is_eager(everything, point, origin, tangent, gradients=1e-10)


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_vmap_and_any_batch_dimensions(space):
    point, origin, tangent = points(space, 2, 3, 4), points(space, 2, 3, 4), near(space, 2, 3, 4)
    for function, inputs in (
        (space.plus, (point, tangent)),
        (space.minus, (point, origin)),
        (space.mean, (point,)),
        (space.right_jacobian, (tangent,)),
        (space.adjoint, (point,)),
        (space.basis, (point,)),
        (space.dual_basis, (point,)),
    ):
        expected = function(*inputs)
        torch.testing.assert_close(torch.func.vmap(function)(*inputs), expected, **EXACT)
        torch.testing.assert_close(function(*(value[1, 2] for value in inputs)), expected[1, 2], **EXACT)
    # One point to many, and many to one.
    shape = (2, 3, 4)
    one = point[0, 0, 0]
    torch.testing.assert_close(space.plus(one, tangent), space.plus(one.expand(*shape, -1), tangent), **EXACT)
    torch.testing.assert_close(space.minus(point, one), space.minus(point, one.expand(*shape, -1)), **EXACT)
    torch.testing.assert_close(space.minus(one, point), space.minus(one.expand(*shape, -1), point), **EXACT)
    few = tangent[:, :1, :1]
    torch.testing.assert_close(space.plus(point, few), space.plus(point, few.expand_as(tangent)), **EXACT)
    assert space.plus(point[:0], tangent[:0]).shape == (0, 3, 4, space.point_dim)


@pytest.mark.parametrize("space", [SO3(), SE3(), SE23(), Turned(3), Repeated(SO3(), 2), Opposite(SE3())])
def test_the_signs_of_quaternions_do_not_move_a_point_near_the_mean(space):
    """A quaternion and its negative are one rotation: the mean of the numbers takes them on one side."""
    points = space.plus(space.exp(torch.randn(space.tangent_dim)), 0.2 * torch.randn(9, space.tangent_dim))
    expected, size = space.near(points), 4
    flipped = points.clone()
    for begin in range(0, 8 if isinstance(space, Repeated) else 4, size):
        flipped[1::2, begin : begin + size] *= -1
    assert space.distance(space.near(flipped), expected) < 1e-6
    assert space.distance(space.near(flipped), space.mean(points)) < 0.1


def test_headings_on_both_sides_of_pi_have_a_point_near_their_mean():
    points = torch.tensor([[3.1, 1.0, 0.0], [-3.1, 3.0, 0.0], [3.0, 2.0, 0.0]])
    assert SE2().near(points)[0].item() == pytest.approx((3.1 + (2 * math.pi - 3.1) + 3.0) / 3)


@pytest.mark.parametrize("space", [SO3(), SE3(), SE23(), Opposite(SE3()), Opposite(SE23())])
def test_the_length_of_a_readings_quaternion_does_not_matter(space):
    expected, reading = (space.exp(torch.randn(space.tangent_dim)) for _ in range(2))
    longer = torch.cat([1.5 * reading[:4], reading[4:]])
    torch.testing.assert_close(space.innovation(longer, expected), space.innovation(reading, expected))


@pytest.mark.parametrize("space", [SO3(), SE2(), SE3(), Opposite(SE3()), Product(SE2(), Euclidean(2)), Flat(3, [1])])
def test_a_mask_is_narrowed_to_whole_rotations_and_vectors(space):
    """The mask excludes components that a masked one mixes with; the others do not depend on it."""
    for hidden in range(space.tangent_dim):
        observed = torch.arange(space.tangent_dim) != hidden
        points, tangents = space.told(observed)
        assert not (tangents & ~observed).any()
        assert space.told(tangents)[1].equal(tangents)
        expected, reading = space.exp(torch.randn(space.tangent_dim)), space.exp(torch.randn(space.tangent_dim))
        other = torch.where(points, reading, space.exp(torch.randn(space.tangent_dim)))
        found = [space.innovation(one, expected, observed)[tangents] for one in (reading, other)]
        assert found[0].equal(found[1])
    assert space.told(torch.tensor([False]))[1].equal(torch.tensor([False]))
