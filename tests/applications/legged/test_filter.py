"""The filter of a legged robot's base: simulated trots, and a real humanoid's walk."""

import pytest
import torch

from tests.applications.legged.test_environment import trotting
from tests.real_data import SHARED
from torch_denkf.applications.legged import QUADRUPED, legged_filter, quadruped_env
from torch_denkf.applications.legged.icub import ICUB, icub_log, icub_model
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.functional.manifolds import SO3, rotate
from torch_denkf.imperfect import RejectReadings

VELOCITY, VAR = ("belief", "velocity"), ("belief", "velocity_var")
ICUB_FOLDER = SHARED / "icub"


def filtered(filter, log):
    torch.manual_seed(0)
    with torch.no_grad():
        return filter.sequence(log.clone(), keep=[VELOCITY, VAR, ("belief", "mean")])


@pytest.mark.parametrize("kind", ["EKF", "DEnKF"])
def test_a_trot_is_followed(kind):
    env = quadruped_env(seed=1)
    log = trotting(env, 100).exclude("done", "terminated", "truncated", "reward").unsqueeze(0)
    filter = legged_filter(env.model, **QUADRUPED, dt=env.dt, kind=kind, ensemble_size=48)
    out = filtered(filter, log)
    true = log["true", "velocity"][:, 20:]
    error = (out[VELOCITY][:, 20:] - true).square().sum(-1).mean().sqrt()
    assert error < 0.5 * true.square().sum(-1).mean().sqrt()
    assert (out[VAR] > 0).all()


@pytest.mark.slow
@pytest.mark.skipif(not ICUB_FOLDER.exists(), reason="the log is not here")
def test_a_real_humanoid_walks():
    """Twelve seconds. Plain numbers in an extended Kalman filter: .086 m/s, .66 degrees. Standing still: .207 m/s."""
    model, log = icub_model(ICUB_FOLDER), icub_log(ICUB_FOLDER)
    filter = legged_filter(model, **ICUB, dt="dt", kind="EKF").double()
    out = filtered(filter, log)
    rows = slice(50, 1168)
    error = (out[VELOCITY] - log["true", "velocity"])[:, rows]
    assert error.square().sum(-1).mean().sqrt() < 0.12
    sensor = LegKinematics(model, ICUB["feet"], ICUB["imu"], joints=ICUB["joints"]).base.double()
    turn = out["belief", "mean"][..., :4]
    turn = SO3().compose(turn, SO3().inverse(sensor[:4]).expand_as(turn))
    up = [
        rotate(SO3().inverse(each), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))[:, rows]
        for each in (turn, log["true", "orientation"])
    ]
    tilt = torch.acos((up[0] * up[1]).sum(-1).clamp(-1, 1)).rad2deg().square().mean().sqrt()
    assert tilt < 0.7


@pytest.mark.parametrize("kind", ["EKF", "DEnKF"])
def test_a_start_without_acceleration_is_level(kind):
    """A first row that is rejected does not spoil the run."""
    env = quadruped_env(seed=0)
    log = trotting(env, 3).select("imu", "joints", "joint_rates", "contact").unsqueeze(0)
    log["imu"][:, 0] = torch.nan
    options = {**QUADRUPED, "dt": env.dt, "kind": kind, "ensemble_size": 8}
    log = RejectReadings(dict.fromkeys(["imu", "joints", "joint_rates"], "contact"))(log)
    assert not log["contact"][:, 0].any()
    out = filtered(legged_filter(env.model, **options), log)
    assert out[VELOCITY].isfinite().all()
    start = legged_filter(env.model, **options).initialise(log[:, 0].clone())["legs", "start"]
    sensor = LegKinematics(env.model, **QUADRUPED).base
    torch.testing.assert_close(start[0, :4], sensor[:4])


@pytest.mark.parametrize("kind", ["EKF", "DEnKF"])
def test_run_resumes_from_the_carry(kind):
    """The velocity of the stored belief follows from it and from what the gyro reads then."""
    env = quadruped_env(seed=1)
    log = trotting(env, 12).select("imu", "joints", "joint_rates", "contact").unsqueeze(0)
    filter = legged_filter(env.model, **QUADRUPED, dt=env.dt, kind=kind, ensemble_size=16)
    log = filter.draw_noise(log)
    with torch.no_grad():
        whole = filter.sequence(log.clone())
        rest = filter.sequence(log[:, 7:].clone().update(whole[:, 7:].select(*filter.carry_keys)))
    for key in filter.belief_keys:
        torch.testing.assert_close(rest[key], whole[key][:, 7:], rtol=0, atol=1e-5)
