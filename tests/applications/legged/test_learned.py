"""Learned contacts: what they write before training, what they read, and that they find the foot that slides."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from tests.applications.legged.test_environment import trotting
from torch_denkf import from_pretrained
from torch_denkf.applications.legged import (
    QUADRUPED,
    LearnedContacts,
    LeggedNoises,
    legged_filter,
    quadruped_env,
    with_last_rows,
)
from torch_denkf.applications.legged.motion import LeggedMotionNoise
from torch_denkf.functional.manifolds import rotation_matrix

RATE, LASTS = 0.2, 4.0
KEYS = ("imu", "joints", "joint_rates", "contact")


@pytest.fixture(scope="module")
def model():
    return quadruped_env().model


@pytest.fixture(scope="module")
def log():
    rows = trotting(quadruped_env(seed=3), 40)
    return rows.select(*KEYS, "true").unsqueeze(0)


def contacts_of(model, rows=10, **options):
    return LearnedContacts(model, **QUADRUPED, rows=rows, rate=RATE, lasts=LASTS, **options)


def test_each_foot_has_a_covariance_of_its_own(model, log):
    contacts = contacts_of(model)
    for weight in contacts.parameters():
        torch.nn.init.normal_(weight, std=0.1)
    contacts.standardise(with_last_rows(log, 10))
    noise = contacts(with_last_rows(log, 10))["sensor", "noise"]
    blocks = noise.unflatten(-1, (4, 3)).unflatten(-3, (4, 3))  # [..., foot, axis, foot, axis]
    for one in range(4):
        for other in range(4):
            assert blocks[..., one, :, other, :].any() == (one == other)
    assert torch.linalg.eigvalsh(noise).min() > 0
    assert (blocks[..., 0, :, 0, :] - blocks[..., 0, :, 0, :].mT).abs().max() < 1e-7


def test_feet_of_a_rigid_rotation_give_one_velocity(model, log):
    """With true joints and no foot that slides each foot says the base's velocity: here that is made up."""
    contacts, kinematics = contacts_of(model, rows=1), contacts_of(model).kinematics
    imu, joints = (log[key][0] for key in ("imu", "joints"))
    velocity = torch.randn(40, 3)
    # joint rates that move the feet as a standing foot moves: by least squares, four joints a leg
    jacobian, feet = kinematics.jacobian(joints), kinematics(joints)
    wanted = -velocity.unsqueeze(-2) - torch.linalg.cross(imu[:, None, :3].expand_as(feet), feet)
    found = torch.linalg.lstsq(jacobian.mT, wanted.unsqueeze(-1)).solution.squeeze(-1)
    rates = torch.zeros_like(joints)
    rates.scatter_(-1, kinematics.column.flatten().expand(40, -1), found.flatten(-2))
    features = contacts.features(imu, joints, rates, log["contact"][0])
    assert_close(features[..., 4:7], velocity.unsqueeze(-2).expand(40, 4, 3), rtol=0, atol=1e-3)
    stands = log["contact"][0].any(-1)
    assert_close(features[stands][..., 7:10], velocity[stands].unsqueeze(-2).expand(-1, 4, 3), rtol=0, atol=1e-3)
    assert torch.equal(features[..., 0].bool(), log["contact"][0])


def test_a_foot_walks_as_its_noise_says():
    noise = LeggedMotionNoise(2, 0.01, LeggedNoises(kinematics=0.5), ensemble=True, slip_key="slip")
    slip = torch.tensor([[4.0, 9.0]])
    out = noise(TensorDict({"contact": torch.tensor([[True, False]]), "slip": slip}, [1]))["forecast", "noise"]
    assert_close(out[0, 15:], torch.tensor([0.0004] * 3 + [0.25] * 3))
    timed = LeggedMotionNoise(2, "dt", LeggedNoises(kinematics=0.5), ensemble=True, slip_key="slip")
    more = {"contact": torch.tensor([[True, True]]), "slip": slip, "dt": torch.tensor([[0.5]])}
    assert_close(timed(TensorDict(more, [1]))["forecast", "noise"][0, 15:], torch.tensor([1.0] * 3 + [2.25] * 3))


@pytest.mark.parametrize("kind", ["EKF", "DEnKF"])
def test_untrained_covariances_equal_legged_noises(kind, model, log):
    """Constant covariances are those of LeggedNoises(slip=, rate=); slip is independent in each step."""
    rate, slip = LASTS**0.5 * RATE, (0.01 * LASTS) ** 0.5 * RATE
    rows, options = with_last_rows(log, 10), {"dt": 0.01, "kind": kind, "ensemble_size": 16}
    velocities = []
    for noises, contacts in ((LeggedNoises(rate=rate, slip=slip), None), (LeggedNoises(), contacts_of(model))):
        filter = legged_filter(model, **QUADRUPED, noises=noises, contacts=contacts, **options)
        torch.manual_seed(0)
        with torch.no_grad():
            velocities.append(filter.sequence(rows.clone())["belief", "velocity"])
    assert_close(*velocities, rtol=0, atol=2e-3)


def test_the_loss_is_that_of_the_feet_that_stand(model, log):
    """Before training it is the likelihood under N(0, rate^2) of how each standing foot moves in the world."""
    contacts, rows = contacts_of(model, rows=1), with_last_rows(log, 1)
    kinematics, true = contacts.kinematics, log["true", "velocity"]
    joints, rates, gyro = log["joints"], log["joint_rates"], log["imu"][..., :3]
    to_base = rotation_matrix(kinematics.base[:4])
    feet, in_body = kinematics(joints), kinematics.velocities(joints, rates)
    # In the base's axes: the base's velocity, and that about its origin; then what the joints add.
    turn = (gyro @ to_base.mT).unsqueeze(-2).expand_as(feet)
    places = feet @ to_base.mT + kinematics.base[4:]
    moves = true.unsqueeze(-2) + torch.linalg.cross(turn, places) + in_body @ to_base.mT
    square = moves[log["contact"]].square().sum(-1)
    expected = (0.5 * square / RATE**2 + 3 * math.log(RATE * (2 * math.pi) ** 0.5)).mean()
    assert_close(contacts.loss(rows), expected, rtol=1e-4, atol=1e-4)


def test_a_filter_moves_a_foot_that_slides(model):
    """All feet slide alike: threshold contacts take that for the base's motion, known slides do not."""
    rest = quadruped_env(seed=0).reset().select(*KEYS).expand(1, 30).clone()
    rest["contact"][:] = True
    rest["joint_rates"].zero_()
    rest["imu"][..., :3] = 0
    rest["imu"][..., 3:] *= 9.81 / rest["imu"][0, 0, 3:].norm()
    speed, kinematics = torch.tensor([0.2, -0.1, 0.05]), contacts_of(model, rows=1).kinematics
    jacobian = kinematics.jacobian(rest["joints"][0, 0])
    rates = torch.linalg.lstsq(jacobian.mT, speed.expand(4, 3).unsqueeze(-1)).solution.squeeze(-1)
    for row in range(30):
        rest["joints"][0, row, kinematics.column] += 0.01 * row * rates
        rest["joint_rates"][0, row, kinematics.column] = rates
    log, contacts = with_last_rows(rest, 1), contacts_of(model, rows=1)
    contacts.mean = torch.nn.Linear(16, 3).requires_grad_(False)
    contacts.mean.weight.zero_()
    contacts.mean.bias.copy_(speed)
    found = []
    for each in (contacts, None):
        filter = legged_filter(model, **QUADRUPED, dt=0.01, kind="EKF", contacts=each)
        with torch.no_grad():
            found.append(filter.sequence(log.clone())["belief", "velocity"][0, -1].norm())
    assert found[0] < 0.03
    assert found[1] > 0.1


def test_contacts_are_trained_through_the_filter(model, log):
    contacts = contacts_of(model)
    filter = legged_filter(model, **QUADRUPED, dt=0.01, kind="EKF", contacts=contacts)
    out = filter.sequence(with_last_rows(log[:, :6], 10))
    error, var = out["belief", "velocity"] - log["true", "velocity"][:, :6], out["belief", "velocity_var"]
    (error.square() / var + var.log()).mean().backward()
    gradients = {name: each.grad for name, each in contacts.named_parameters()}
    last = max(name for name in gradients if name.endswith("weight"))
    assert all(each.isfinite().all() for each in gradients.values())
    assert gradients[last].any()
    assert gradients[next(name for name in gradients if name.startswith("mean"))] is not None


@pytest.mark.slow
def test_pretrained_filter_handles_sliding_feet():
    """Against contacts that a threshold tells alone, with the noises of its validation, where friction is .2."""
    base = quadruped_env(friction=0.2, seed=7)
    rows = trotting(base, 200).select(*KEYS, "true").unsqueeze(0)
    plain = legged_filter(
        base.model, **QUADRUPED, dt=base.dt, kind="EKF", noises=LeggedNoises(kinematics=0.1, rate=1.0)
    )
    errors = []
    for filter in (from_pretrained("quadruped"), plain):
        with torch.no_grad():
            out = filter.sequence(with_last_rows(rows, 10, every=5))
        error = out["belief", "velocity"] - rows["true", "velocity"]
        errors.append(error[:, 50:].square().sum(-1).mean().sqrt())
    assert errors[0] < 0.7 * errors[1]
