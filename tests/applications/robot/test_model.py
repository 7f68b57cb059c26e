"""The fifteen states of robot_localization against its equations in numpy."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torch_denkf.applications.robot import robot_model
from torch_denkf.applications.robot.config import PLANE
from torch_denkf.fusion import message_rows

EYE = np.eye(15)


def flags(*places):
    return [place in places for place in range(15)]


def moved(state, dt):
    """Returns the state after dt, angles not wrapped."""
    roll, pitch, _ = state[3:6]
    rates = np.array(
        [
            [1, np.sin(roll) * np.tan(pitch), np.cos(roll) * np.tan(pitch)],
            [0, np.cos(roll), -np.sin(roll)],
            [0, np.sin(roll) / np.cos(pitch), np.cos(roll) / np.cos(pitch)],
        ]
    )
    out = state.copy()
    out[:3] += Rotation.from_euler("xyz", state[3:6]).as_matrix() @ (state[6:9] * dt + state[12:] * dt**2 / 2)
    out[3:6] += rates @ state[9:12] * dt
    out[6:9] += state[12:] * dt
    return out


def wrapped(angles):
    return (angles + np.pi) % (2 * np.pi) - np.pi


def oracle(state, cov, messages, reads, noise, two_d, dynamic=False):
    """Kalman filter with Jacobians by central differences, after each message."""
    time, means, covs = messages[0][0], [], []
    for stamp, name, value, variance in messages:
        dt = stamp - time
        if dt > 0:
            step = 1e-6
            jacobian = np.stack(
                [(moved(state + step * e, dt) - moved(state - step * e, dt)) / (2 * step) for e in EYE], 1
            )
            added = noise.copy()
            if dynamic:
                added[:6, :6] *= np.linalg.norm(state[6:12]) ** 2
            state, cov = moved(state, dt), jacobian @ cov @ jacobian.T + dt * added
            state[3:6] = wrapped(state[3:6])
            time = stamp
        places = list(reads[name])
        model, covariance = EYE[places], np.asarray(variance)
        innovation = np.asarray(value) - model @ state
        angles = [k for k, place in enumerate(places) if place in (3, 4, 5)]
        innovation[angles] = wrapped(innovation[angles])
        gain = cov @ model.T @ np.linalg.inv(model @ cov @ model.T + covariance)
        state = state + gain @ innovation
        state[3:6] = wrapped(state[3:6])
        kept = EYE - gain @ model
        cov = kept @ cov @ kept.T + gain @ covariance @ gain.T
        means.append(state.copy())
        covs.append(cov.copy())
    return np.array(means), np.array(covs)


def config(two_d, **more):
    noise = np.diag(np.linspace(0.01, 0.06, 15))
    noise[0, 1] = noise[1, 0] = 0.003
    return {
        "ekf_filter_node": {
            "ros__parameters": {
                "frequency": 30.0,
                "two_d_mode": two_d,
                "odom0": "/odom",
                "odom0_config": flags(0, 1, 5, 6, 7, 11),
                "imu0": "/imu",
                "imu0_config": flags(3, 4, 5, 11, 12),
                "process_noise_covariance": noise.reshape(-1).tolist(),
                "initial_estimate_covariance": [1.0] * 15,
                **more,
            }
        }
    }


def log(reads, two_d, count=40):
    """Messages of a robot that turns past half a turn, some at the same time."""
    rng = np.random.default_rng(0)
    messages, stamp = [], 10.0
    for k in range(count):
        stamp += 0.0 if k % 5 == 4 else rng.uniform(0.01, 0.15)
        name = list(reads)[rng.integers(len(reads))]
        places = list(reads[name])
        value = 0.3 * rng.normal(size=len(places))
        for at, place in enumerate(places):
            value[at] += 2.9 + 0.05 * k if place == 5 else 0.0
            if place == 5:
                value[at] = wrapped(value[at])
        root = rng.normal(size=(len(places), len(places)))
        variance = 0.02 * root @ root.T + 0.05 * np.eye(len(places))
        if two_d:
            plane = len(places) - len(PLANE)
            value[plane:] = 0.0
            variance[plane:], variance[:, plane:] = 0.0, 0.0
            variance[range(plane, len(places)), range(plane, len(places))] = 1e-6
        messages.append((stamp, name, value, variance))
    return messages


@pytest.mark.parametrize("dynamic", [False, True])
@pytest.mark.parametrize("two_d", [True, False])
def test_the_equations(float64, two_d, dynamic):
    model = robot_model(config(two_d, dynamic_process_noise_covariance=dynamic))
    messages = log(model.reads, two_d)
    rows = message_rows(messages, start=messages[0][0])
    state = np.zeros(15)
    state[5], state[6] = 2.9, 1.0
    model = model.started(torch.from_numpy(state), torch.eye(15))
    with torch.no_grad():
        belief = model.filter.sequence(rows)["belief"]
    mean, cov = oracle(state, np.eye(15), messages, model.reads, model.config.process_noise, two_d, dynamic)
    # Messages of one time are one row: the last of them is compared.
    stamps = np.array([message[0] for message in messages])
    last = np.append(np.diff(stamps) > 0, True)
    there = np.append(np.diff(rows["stamp"][:, 0].numpy()) > 0, True)
    there[0] &= len(np.flatnonzero(there)) == last.sum()
    found = belief["mean"].numpy()[there][-last.sum() :]
    off = found - mean[last]
    off[:, 3:6] = wrapped(off[:, 3:6])
    np.testing.assert_allclose(off, 0.0, atol=1e-6)
    np.testing.assert_allclose(belief["cov"].numpy()[there][-last.sum() :], cov[last], rtol=0, atol=1e-6)
    assert np.ptp(np.unwrap(mean[:, 5])) > 0.5


@pytest.mark.parametrize("held", [False, True])
def test_jacobians_of_drifts(float64, held):
    """Motion and readings, with slow errors behind the states; after the time of a drift a third is left."""
    sensor = {"odom0": "/o", "odom0_config": flags(0, 1, 5, 6, 7, 11), "odom0_drift_time": [4.0] * 6 + [2.0] * 9}
    drifts = [0.0] * 15
    drifts[0], drifts[6], drifts[11] = 2.0, 0.1, 0.02
    model = robot_model(sensor | {"odom0_drifts": drifts, "held_velocities": held})
    motion = model.filter.transition_module.module
    state, dt = 0.7 * torch.randn(4, 18), torch.full((4, 1), 0.3)
    moved, jacobian = motion.move_and_gradient(state, dt=dt)
    every = torch.func.vmap(torch.func.jacrev(lambda one: motion.move(one, dt=dt[0])))
    torch.testing.assert_close(jacobian, every(state))
    torch.testing.assert_close(moved, motion.move(state, dt=dt))
    torch.testing.assert_close(moved[:, 15:], state[:, 15:] * torch.exp(-0.3 / torch.tensor([4.0, 2.0, 2.0])))
    for name, wanted in (
        ("odom0_pose", [state[:, 0] + state[:, 15], state[:, 1], state[:, 5]]),
        ("odom0_twist", [state[:, 6] + 3.0 * state[:, 16], state[:, 7], state[:, 11] + state[:, 17]]),
    ):
        model_of, seen = model.reading(name), torch.tensor([3.0, torch.nan, 0.0])
        read, by_state = model_of.jacobian(state, seen)
        torch.testing.assert_close(read, torch.stack(wanted, -1))
        by_hand = torch.func.jacrev(lambda one, of=model_of, seen=seen: of.compute(one.unsqueeze(0), seen)[0])
        torch.testing.assert_close(by_state, torch.func.vmap(by_hand)(state))


def test_held_velocities_are_means_of_the_step(float64):
    """On a circle a step of a quarter turn leads to the heading's end, along that of its middle."""
    motion = robot_model({"odom0": "/o", "odom0_config": flags(0), "held_velocities": True})
    motion = motion.filter.transition_module.module
    state = torch.zeros(15)
    state[6], state[11] = 2.0, torch.pi / 2
    moved = motion.move(state, dt=1.0)
    torch.testing.assert_close(moved[[0, 1, 5]], torch.tensor([2**0.5, 2**0.5, torch.pi / 2]))


def test_ignored_settings_are_named():
    model = robot_model(
        config(
            True,
            publish_tf=True,
            use_control=True,
            odom0_pose_rejection_threshold=5.0,
            odom0_queue_size=10,
            shoe_size=44,
        )
    )
    assert model.unheeded == (
        "use_control: there is no control here",
        "odom0_pose_rejection_threshold: put Gated(model.filter, ...) around the filter",
        "shoe_size: it is not known here",
    )


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"odom0": "/odom"}, "odom0_config must be fifteen of true and false; got None"),
        ({"odom0": "/odom", "odom0_config": [True] * 14}, "odom0_config must be fifteen"),
        ({"two_d_mode": True}, "names no sensor, such as odom0"),
        ({"odom0": "/o", "odom0_config": flags(0), "process_noise_covariance": [1.0] * 16}, "15 rows of 15; got 16"),
        ({"odom0": "/o", "odom0_config": flags(0), "initial_state": [1.0]}, "initial_state must be 15 numbers; got 1"),
    ],
)
def test_settings_that_are_none(given, match):
    with pytest.raises(ValueError, match=match):
        robot_model(given)


def test_a_file(tmp_path):
    yaml = pytest.importorskip("yaml")
    (tmp_path / "ekf.yaml").write_text(yaml.safe_dump(config(True)).replace("frequency: 30.0", "frequency: 1e-1"))
    assert robot_model(tmp_path / "ekf.yaml").config.frequency == 0.1
    with pytest.raises(FileNotFoundError, match=r"no configuration .*none.yaml"):
        robot_model(tmp_path / "none.yaml")


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
@pytest.mark.parametrize("two_d", [True, False])
def test_beliefs_stay_finite_where_others_go_to_nan(float64, kind, two_d):
    """The kinds of configuration of which users report NaN: hardly any initial variance, much of the heading, no pose.

    Speeds of two sensors, turn rates and slopes of an inertial one; and the default, 1e-9 in each state.
    """
    start = [1e1, 1e1, *[1e2] * 4, *[1e-2] * 9]
    for initial in (start, [1e-9] * 15):
        settings = config(two_d, odom0_config=flags(6, 7), odom1="/visual", odom1_config=flags(6, 7, 8))
        parameters = settings["ekf_filter_node"]["ros__parameters"]
        parameters |= {"initial_estimate_covariance": initial, "imu0_config": flags(3, 4, 9, 10, 11)}
        model = robot_model(settings, kind=kind)
        messages = log(model.reads, two_d, 80)
        for _, name, value, _ in messages:
            value[np.isin(model.reads[name], (3, 4))] *= 0.1  # slopes
        with torch.no_grad():
            belief = model.filter.sequence(message_rows(messages))["belief"]
        assert belief["mean"].isfinite().all()
        assert torch.linalg.eigvalsh(belief["cov"]).min() > -1e-9
