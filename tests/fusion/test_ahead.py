"""The belief of a later moment. Oracle: the Kalman filter's forecast in closed form, with known inputs."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import RenameTransform, TransformedEnv, check_env_specs
from torchrl.modules.utils import get_env_transforms_from_module

from tests.filters.factories import assert_equal, linear_system, toy_denkf
from tests.objectives.test_kept_noise import log_ratio, make_policy, toy_fused, toy_particles
from tests.transforms.envs_for_tests import toy_base_env
from torch_denkf import DEnKF, DEnKFTransform, KalmanFilter, LinearGaussianEnv
from torch_denkf.envs import LateActions
from torch_denkf.functional.manifolds import SE2, SE3
from torch_denkf.fusion import BeliefAhead, FusedFilter, FusedSensor
from torch_denkf.modules import (
    AroundState,
    ConstantNoise,
    GaussianAround,
    GaussianPrior,
    LearnedTransition,
    LinearObservation,
    LinearTransition,
    MomentPrior,
    Select,
)
from torch_denkf.motions import ConstantTwist
from torch_denkf.motions.readings import PoseOf

pytestmark = pytest.mark.usefixtures("float64")

K = 3
B_ = [[0.5], [-1.0]]
NEXT = ("under_way", "action")


def kalman(**options):
    F, Q, H, R = linear_system()
    start = {"mean": torch.tensor([0.5, -0.25]), "cov": torch.eye(2)}
    return KalmanFilter(F, H, process_noise_cov=Q, noise=R.sqrt(), control=torch.tensor(B_), **start, **options)


def ensemble(**options):
    F, Q, H, R = linear_system()
    motion = LearnedTransition(
        lambda x: x @ torch.cat([F, torch.tensor(B_)], -1).mT, residual=False, action_key="action"
    )
    start = GaussianPrior([0.5, -0.25], [1.0, 1.0], ensemble_size=12)
    noise = ConstantNoise(R.sqrt(), in_key="observation")
    parts = {"initial": start, "process_noise": Q.diagonal().sqrt().tolist(), "observation_key": "observation"}
    return DEnKF(motion, None, LinearObservation(H), noise, **parts, **options)


def fused(**options):
    """Delays the second reading by two steps."""
    F, Q, H, R = linear_system()
    sensors = {
        "observation": FusedSensor(LinearObservation(H), R.sqrt()),
        "late": FusedSensor(Select([0]), [0.3], delay=2),
    }
    start = MomentPrior(torch.tensor([0.5, -0.25]), torch.eye(2))
    return FusedFilter(LinearTransition(F, Q, control=torch.tensor(B_)), sensors, initial=start, **options)


def recorded(steps=6):
    data = TensorDict({"observation": torch.randn(4, steps, 2), "late": torch.randn(4, steps, 1)}, [4, steps])
    actions = torch.randn(4, steps + K, 1)
    return data.set("action", actions[:, :steps]).set(
        NEXT, torch.stack([actions[:, k : k + steps] for k in range(K)], 2)
    )


def moments(filter, out):
    mean = out["belief", "mean"]
    if "cov" in out["belief"]:
        return mean, out["belief", "cov"]
    away = out["belief", "ensemble"] - mean.unsqueeze(-2)
    return mean, away.mT @ away / (away.shape[-2] - 1)


def closed_form(mean, cov, actions, noise):
    """F m + B a and F P F^T + Q, so many times."""
    F, B = linear_system()[0], torch.tensor(B_)
    for a in actions.unbind(-2):
        mean, cov = mean @ F.mT + a @ B.mT, F @ cov @ F.mT + noise
    return mean, cov


@pytest.mark.parametrize("make", [kalman, ensemble, fused])
def test_a_forecast_through_known_inputs(make):
    """From each element of a sequence; of the members, whose draws are exact, mean and variances."""
    filter, Q = make(), linear_system()[1]
    noise = Q.diagonal().diag() if make is ensemble else Q
    out = BeliefAhead(filter, K)(filter.sequence(recorded()))
    mean, cov = moments(filter, out)
    expected, wide = closed_form(mean, cov, out[NEXT], noise)
    tolerance = {"rtol": 0, "atol": 2e-3 if make is ensemble else 1e-12}
    torch.testing.assert_close(out["ahead", "belief", "mean"], expected, **tolerance)
    torch.testing.assert_close(out["ahead", "belief", "var"], wide.diagonal(dim1=-2, dim2=-1), **tolerance)


def test_predictions_of_a_chunk_with_different_horizons():
    filter = kalman()
    out = filter.sequence(recorded())
    each = BeliefAhead(filter, K, each=True)(out.copy())["ahead", "belief", "mean"]
    steps = torch.randint(K + 1, (4, 6, 1))
    found = BeliefAhead(filter, "delay", most=K)(out.copy().set("delay", steps))["ahead", "belief", "mean"]
    in_seconds = BeliefAhead(filter, "delay", most=0.3, dt=0.1)(out.copy().set("delay", 0.1 * steps))
    all_means = torch.cat([out["belief", "mean"].unsqueeze(2), each], 2)
    expected = all_means.gather(2, steps.unsqueeze(-1).expand(4, 6, 1, 2)).squeeze(2)
    torch.testing.assert_close(found, expected, rtol=0, atol=0)
    torch.testing.assert_close(in_seconds["ahead", "belief", "mean"], expected, rtol=0, atol=0)


@pytest.mark.parametrize("seconds", [0.2, 0.25])
def test_transition_with_a_variable_time_step(seconds):
    """x' = x + dt (speed): .25 s are two steps of .1 s and a half one."""
    moves = torch.nn.Linear(1, 1)
    moves.weight.data, moves.bias.data = torch.zeros(1, 1), torch.tensor([2.0])
    filter = DEnKF(
        LearnedTransition(moves, dt_key="dt"),
        None,
        Select([0]),
        ConstantNoise([0.5], in_key="observation"),
        initial=GaussianPrior([0.0], [1.0], ensemble_size=4),
        observation_key="observation",
    )
    now = filter.initialise({"dt": [0.04], "observation": [0.0]})
    out = BeliefAhead(filter, seconds, dt=0.1, dt_key="dt")(now)
    torch.testing.assert_close(out["ahead", "belief", "mean"], out["belief", "mean"] + 2 * seconds)


@pytest.mark.parametrize("space", [SE2(), SE3()], ids=["SE2", "SE3"])
@pytest.mark.parametrize("start", [GaussianAround, AroundState], ids=["moments", "ensemble"])
def test_pose_prediction_follows_its_screw_motion(space, start):
    """At a constant twist the pose is x exp(k dt xi), and its tangent J^k P J^kT, J by finite differences."""
    dt, D = 0.1, space.tangent_dim
    motion = ConstantTwist(space, dt)
    options = {} if start is GaussianAround else {"ensemble_size": 4 * D + 1}
    initial = start([1e-4] * 2 * D, space=motion.space, **options)
    sensor = FusedSensor(PoseOf(motion.space), [0.1] * D, reading_space=space)
    filter = FusedFilter(motion, {"pose": sensor}, initial=initial, process_noise=[0.0] * 2 * D)
    pose = space.exp(0.7 * torch.randn(2, D))
    state = torch.cat([pose, torch.randn(2, D)], -1)
    now = filter.initialise(TensorDict({"state": state, "pose": pose}, [2]))
    out = BeliefAhead(filter, K, each=True)(now)
    mean, twist = out["belief", "mean"], out["belief", "mean"][..., -D:]
    for k in range(K):
        expected = torch.cat([space.plus(mean[..., :-D], (k + 1) * dt * twist), twist], -1)
        found = out["ahead", "belief", "mean"][:, k]
        assert motion.space.distance(found, expected).max() < 1e-6

    def moved(tangent):
        one = motion.space.plus(mean[0], tangent)
        return torch.cat([space.plus(one[:-D], K * dt * one[-D:]), one[-D:]])

    base, steps = moved(torch.zeros(2 * D)), 1e-6 * torch.eye(2 * D)
    J = torch.stack([motion.space.minus(moved(step), base) for step in steps], -1) / 1e-6
    wide = (J @ J.mT).diagonal() * 1e-8
    tolerance = 1e-3 if start is GaussianAround else 0.02
    torch.testing.assert_close(out["ahead", "belief", "var"][0, -1], wide, rtol=tolerance, atol=0)


def late_world(filter, **transform):
    F, Q, H, R = linear_system()
    stds = Q.diagonal().sqrt(), R.sqrt()
    env = LinearGaussianEnv(F, H, *stds, control=torch.tensor(B_), batch_size=[3], max_steps=[4, 9, 9])
    env = TransformedEnv(env, LateActions(K))
    if filter is not None:
        env.append_transform(DEnKFTransform(filter, ahead=BeliefAhead(filter, K), **transform))
    return env


def test_action_latency_with_partial_resets():
    """The state itself follows the actions of K steps before, without noise."""
    F, _, H, _ = linear_system()
    env = LinearGaussianEnv(F, H, [0.0] * 2, [0.0] * 2, control=torch.tensor(B_), batch_size=[3], max_steps=[4, 9, 9])
    data = TransformedEnv(env, LateActions(K)).rollout(9, break_when_any_done=False)
    ran = torch.cat([torch.zeros(3, K, 1), data["action"][:, :-K]], 1)
    ran[0, 4 : 4 + K] = ran[0, 8] = 0  # begins again, without the actions of before
    assert data[NEXT][:, :, 0].equal(ran)
    expected = data["state"] @ F.mT + ran @ torch.tensor(B_).mT
    torch.testing.assert_close(data["next", "state"], expected)


@pytest.mark.parametrize("options", [{}, {"prefix": "imu"}])
def test_transform_predictions_equal_those_of_a_sequence(options):
    filter = kalman(update_at_reset=True, **options)
    env = late_world(filter)
    check_env_specs(env)
    data = env.rollout(9, break_when_any_done=False)  # a row is reset within it, twice
    rows = data.select("observation", "observed", NEXT, ("next", "done")).set("action", data[NEXT][:, :, 0])
    expected = BeliefAhead(filter, K)(filter.sequence(rows))
    keys = [("ahead", *filter.outer(("belief", name))) for name in ("mean", "var")]
    assert_equal(data, expected, keys, atol=1e-12)
    assert_equal(data[1:, :-1]["next"], expected[1:, 1:], keys, atol=1e-12)


@pytest.mark.parametrize("make", [toy_denkf, toy_particles, toy_fused])
def test_log_ratio_is_zero_for_a_policy_on_the_prediction(make):
    """Its draws are kept, too; slices begin anywhere, rows reset inside."""
    filter = make()
    ahead = BeliefAhead(filter, 2, keep=[("belief", "mean")])
    policy = make_policy(filter, ahead, key=("ahead", "belief", "mean"))
    env = toy_base_env(batch_size=[3], max_steps=[4, 6, 20])
    env = TransformedEnv(env, RenameTransform(["observation"], ["measurement"]))
    env.append_transform(LateActions(2))
    with torch.no_grad():
        env = TransformedEnv(env, get_env_transforms_from_module(policy))
        data = env.rollout(12, policy, break_when_any_done=False)
    assert log_ratio(policy, data.reshape(-1, 4)).abs().max() < 1e-9
    again = data.exclude(("ahead", "drawn"))
    assert log_ratio(policy, again.reshape(-1, 4)).std() > 1e-3


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"ahead": "delay"}, "say its largest value"),
        ({"ahead": 0.25, "dt": 0.1}, "2.50 steps"),
        ({"ahead": 2, "dt_key": "dt"}, "give the usual one"),
        ({"ahead": 0}, "ahead"),
    ],
)
def test_numbers_that_do_not_fit_raise(options, match):
    with pytest.raises(ValueError, match=match):
        BeliefAhead(kalman(), **options)


def test_missing_entries_are_named():
    filter = kalman()
    out = filter.sequence(recorded())
    with pytest.raises(KeyError, match="under_way"):
        BeliefAhead(filter, K)(out.exclude("under_way"))
    with pytest.raises(ValueError, match="3 actions"):
        BeliefAhead(filter, K + 1)(out)
    with pytest.raises(ValueError, match="from 0 to most=2"):
        BeliefAhead(filter, "delay", most=2)(out.set("delay", torch.full((4, 6, 1), 3)))
    with pytest.raises(KeyError, match="keep names"):
        BeliefAhead(filter, K, keep=["ensemble"])
