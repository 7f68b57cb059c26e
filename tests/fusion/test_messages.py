"""Oracles: a Kalman filter in numpy that goes from message to message; integrals in closed form; a regular clock."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch.testing import assert_close

from torch_denkf import FusedFilter, FusedSensor, ParticleFilter
from torch_denkf.functional.manifolds import SE2, SE3
from torch_denkf.fusion import message_rows
from torch_denkf.modules import AroundState, ConstantNoise, EKFTransition, GaussianAround, MomentPrior, Select
from torch_denkf.motions import AttitudeMotion, ConstantTwist, ContinuousMotion, ContinuousNoise, Gravity, PoseOf
from torch_denkf.smoothers import ParticleSmoother


def glider(**options) -> FusedFilter:
    """Returns the position and speed in continuous time; both read at once, or the speed alone."""
    motion = ContinuousMotion(torch.tensor([[0.0, 1.0], [0.0, 0.0]]))
    sensors = {
        "both": FusedSensor(Select([0, 1]), "both_noise", **options),
        "speed": FusedSensor(Select([1]), "speed_noise"),
    }
    move = EKFTransition(motion, ContinuousNoise(motion, torch.diag(torch.tensor([0.0, 0.3]))))
    return FusedFilter(move, sensors, initial=MomentPrior(torch.zeros(2), torch.eye(2)))


def irregular_log(seed: int = 0, count: int = 40) -> list[tuple]:
    """Messages in no order, each with a noise of its own; some share a time, and two a time and a sensor."""
    random, log = np.random.default_rng(seed), []
    for stamp in random.uniform(0.1, 8.0, count):
        root = random.normal(size=(2, 2))
        log.append((stamp, "both", random.normal(size=2), root @ root.T + 0.1 * np.eye(2)))
        if random.random() < 0.5:
            log.append((stamp if random.random() < 0.5 else stamp + 0.03, "speed", [random.normal()], [0.5]))
    log.append((log[0][0], "both", random.normal(size=2), np.eye(2)))
    return [log[place] for place in random.permutation(len(log))]


def kalman(log: list[tuple], start: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the mean and covariance behind the last message, from one message to the next."""
    mean, cov, now = np.zeros(2), np.eye(2), start
    for stamp, name, value, noise in sorted(log, key=lambda message: message[0]):
        dt, now = stamp - now, stamp
        move = np.array([[1, dt], [0, 1]])
        mean = move @ mean
        cov = move @ cov @ move.T + 0.3 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        model = np.eye(2) if name == "both" else np.array([[0.0, 1.0]])
        noise = np.asarray(noise) if name == "both" else np.diag(noise)
        gain = cov @ model.T @ np.linalg.inv(model @ cov @ model.T + noise)
        mean, cov = mean + gain @ (np.asarray(value) - model @ mean), cov - gain @ model @ cov
    return mean, cov


def test_log_equals_filtering_message_by_message(float64):
    log = irregular_log()
    rows = message_rows(log, start=0.0)
    assert rows["both_observed"].sum() == 41  # none is lost
    out = glider().sequence(rows)
    mean, cov = kalman(log, 0.0)
    assert_close(out["belief", "mean"][-1].numpy(), mean, rtol=1e-9, atol=1e-11)
    assert_close(out["belief", "cov"][-1].numpy(), cov, rtol=1e-9, atol=1e-11)


def test_delays_in_seconds_shift_messages(float64):
    log = irregular_log()
    late = [(stamp + 0.45 * (name == "speed"), name, *rest) for stamp, name, *rest in log]
    rows = message_rows(late, delays={"speed": 0.45}, start=0.0)
    assert_close(glider().sequence(rows)["belief", "mean"][-1].numpy(), kalman(log, 0.0)[0], rtol=1e-9, atol=1e-11)


def test_start(float64):
    """By default the first reading's time; what was read before a start is left out."""
    log = irregular_log()
    rows = message_rows(log)
    assert rows["stamp"][0] == rows["stamp"][1] == min(message[0] for message in log)
    assert not rows["both_observed"][0]
    assert rows["dt"][1] == 0
    after = message_rows(log, start=4.0)
    later = [message for message in log if message[0] >= 4.0]
    assert after["both_observed"].sum() + after["speed_observed"].sum() == len(later)
    assert_close(glider().sequence(after)["belief", "mean"][-1].numpy(), kalman(later, 4.0)[0], rtol=1e-9, atol=1e-11)


def test_input_is_the_mean_since_the_previous_row(float64):
    """Integrates a parabola that is sampled finely: its integral. Beyond the samples it stays."""
    stamps = np.linspace(1.0, 3.0, 2001)
    log = [(stamp, "imu", [stamp**2, 1.0]) for stamp in stamps] + [(stamp, "gps", [0.0]) for stamp in (0.5, 3.5)]
    log += [(2.0003, "imu", [np.nan, 0.0])]
    rows = message_rows(log, driving=["imu"])
    end = rows["stamp"][:, 0]
    begin = end - rows["dt"][:, 0]
    inside = (begin >= 1.0) & (end <= 3.0) & (end > begin)
    assert inside.sum() == 2000
    mean = (end**3 - begin**3)[inside] / (3 * (end - begin)[inside])
    assert_close(rows["imu"][inside, 0], mean, rtol=0, atol=1e-6)  # straight lines between samples 1 ms apart
    assert_close(rows["imu"][:, 1], torch.ones(len(rows)))
    assert rows["imu"][0, 0] == 1.0
    assert rows["imu"][-1, 0] == pytest.approx(9.0)
    coarse = message_rows([(0.0, "imu", [0.0]), (1.0, "imu", [2.0]), (0.25, "gps", [0.0])], driving=["imu"])
    assert coarse["imu"].flatten().tolist() == [0.0, 0.0, 0.25, 1.25]
    with pytest.raises(ValueError, match="no message that is finite"):
        message_rows([(0.0, "imu", [np.nan]), (1.0, "gps", [0.0])], driving=["imu"])


def test_one_absurd_message_spoils_no_row_beyond_its_neighbours():
    log = [(0.01 * k, "imu", [1.0]) for k in range(1000)]
    log[10] = (0.1, "imu", [1e20])
    rows = message_rows([*log, (9.0, "gps", [0.0])], driving=["imu"])
    assert_close(rows["imu"][20:], torch.ones(len(rows) - 20, 1))


def test_input_before_the_start_and_duplicate_stamps():
    log = [(-1.0, "imu", [5.0]), (0.0, "imu", [7.0]), (0.0, "imu", [1.0]), (2.0, "imu", [1.0]), (1.0, "gps", [0.0])]
    rows = message_rows(log, driving=["imu", "imu"], start=0.0, dtype=torch.float64)
    assert rows["stamp"].flatten().tolist() == [0.0, 0.0, 1.0, 2.0]  # the message before the start is no row
    assert rows["imu"].flatten().tolist() == [1.0, 1.0, 1.0, 1.0]  # of two at a time the last counts
    assert rows["imu"].dtype == rows["dt"].dtype == torch.float64
    late = message_rows([(1.0, "gps", [0.0]), (1.5, "wheel", [0.0])], delays={"gps": 0.8})
    assert late["stamp"][0] == pytest.approx(0.2)  # when the first reading was taken


def test_particles_go_back_over_a_step_of_no_length(float64):
    """Two readings at one time: nothing moves between them, and the smoother finds each particle's own past."""
    torch.manual_seed(0)
    motion = ConstantTwist(SE2(), "dt", twist_noise=0.5)
    start = AroundState([0.3] * 6, ensemble_size=50, state_key="start", space=motion.space)
    noise = ConstantNoise([0.2] * 3, in_key="pose")
    options = {"initial": start, "process_noise": motion.process_noise, "reading_space": SE2()}
    filter = ParticleFilter(motion, None, PoseOf(motion.space), noise=noise, observation_key="pose", **options)
    rows = message_rows([(0.1 * k, "pose", [0.0, 0.1 * k, 0.0]) for k in (0, 1, 1, 2)])
    rows["observed"], rows["start"] = rows["pose_observed"], torch.zeros(len(rows), 6)
    smoothed = ParticleSmoother(filter).sequence(rows)["smoothed"]
    assert smoothed["mean"].isfinite().all()
    assert_close(smoothed["ensemble"][0], smoothed["ensemble"][1], rtol=0, atol=1e-9)


def test_two_messages_with_one_stamp():
    rows = message_rows([(1.0, "gps", [1.0]), (1.0, "gps", [2.0]), (1.0, "wheel", [3.0]), (2.0, "gps", [4.0])])
    assert rows["gps"].flatten().tolist()[1:] == [1.0, 2.0, 4.0]
    assert rows["gps"][0].isnan()  # what is not there is not taken for a reading by a motion
    assert rows["dt"].flatten().tolist() == [0.0, 0.0, 0.0, 1.0]
    assert rows["wheel_observed"].flatten().tolist() == [False, True, False, False]
    assert rows["gps"].dtype == torch.float32
    assert rows["stamp"].dtype == torch.float64


def test_stamps_of_a_clock_that_counts_from_1970_keep_their_steps():
    log = [(1.7e9 + 0.01 * row, "gps", [0.0]) for row in range(101)]
    assert_close(message_rows(log)["dt"][2:], torch.full((100, 1), 0.01), rtol=0, atol=1e-6)


GPS = [(float(k), "gps", [0.1 * (k % 7)]) for k in range(20)]


@pytest.mark.parametrize(
    ("log", "options", "message"),
    [
        ([], {}, "no message"),
        ([(0.0, "gps")], {}, "Message 0 is no"),
        ([(0.0, [1.0], "gps")], {}, "Message 0 is no"),
        ([(float("nan"), "gps", [1.0])], {}, "Message 0, of 'gps', has the stamp nan"),
        ([(0.0, "gps", [[1.0]])], {}, r"value of \[1, 1\]"),
        ([(0.0, "gps", [1.0, 2.0], [[1.0, 2.0]])], {}, r"noise of \[1, 2\]"),
        ([(0.0, "gps", [1.0]), (1.0, "gps", [1.0, 2.0])], {}, "'gps' differ in size"),
        ([(0.0, "gps", [1.0]), (1.0, "gps", [1.0], [2.0])], {}, "'gps' differ in size"),
        ([(0.0, "gps", [1.0], [-1.0])], {}, "Message 0, of 'gps', has a noise that is none"),
        ([(0.0, "gps", [1.0, 2.0], [[1.0, 2.0], [2.0, 1.0]])], {}, "has a noise that is none"),
        ([(0.0, "gps", [1.0, 2.0], [[1.0, 50.0], [0.0, 1.0]])], {}, "a covariance is symmetric"),
        ([(0.0, "gps", [1.0, 2.0], [[1e4, 0.001], [0.0, 1e-8]])], {}, "a covariance is symmetric"),
        ([(0.0, "gps", [1.0, 2.0], [[1.0, float("nan")], [float("nan"), 1.0]])], {}, "has a noise that is none"),
        ([(0.0, "gps", [1.0], 0.3)], {}, r"noise of \[\]"),
        ([(0.0, "gps", [1.0], [1.0, 2.0])], {}, r"noise of \[2\]"),
        ([(0.0, "dt", [1.0])], {}, r"\['dt'\] would be written twice"),
        ([(0.0, "stamp", [1.0]), (0.0, "x", [1.0])], {"driving": ["stamp"]}, r"\['stamp'\] would be written twice"),
        ([(0.0, "x", [1.0], [1.0]), (0.0, "x_noise", [1.0])], {}, r"\['x_noise'\] would be written twice"),
        ([(0.0, "gps", [1.0])], {"driving": ["imu"]}, r"driving names \['imu'\]"),
        ([(0.0, "gps", [1.0])], {"delays": {"imu": 0.1}}, r"delays names \['imu'\]"),
        ([(0.0, "gps", [1.0])], {"delays": {"gps": float("nan")}}, "delay of 'gps'"),
        (GPS, {"start": 19.5}, "start=19.5 is behind the last message, 19 s"),
        (GPS, {"start": 1.7e9}, "start=1700000000.0 is behind the last message"),
        (GPS, {"origin": {"imu": 1.0}}, r"origin names \['imu'\]"),
        (GPS, {"origin": {"gps": [1.0, 2.0]}}, "origin of 'gps' must be a finite number, or 1 of them"),
        (GPS, {"origin": {"gps": float("nan")}}, "origin of 'gps' must be a finite number"),
        ([(0.0, "gps", np.ma.masked_equal([1.0, 2.0], 2.0))], {}, "Message 0, of 'gps', has masked"),
        ([(0.0, "gps", [1.0], np.ma.masked_equal([2.0], 2.0))], {}, "Message 0, of 'gps', has masked"),
        ([(np.ma.masked, "gps", [1.0])], {}, "Message 0, of 'gps', has masked"),
        ([("now", "gps", [1.0])], {}, "Message 0, of 'gps', has a stamp that is no number: 'now'"),
        ([(0.0, "gps", ["north"])], {}, "Message 0, of 'gps', has a value that is no number"),
        ([(0.0, "gps", None)], {}, "Message 0, of 'gps', has a value that is no number"),
        ([(0.0, "gps", [1.0], ["wide"])], {}, "Message 0, of 'gps', has a noise that is no number"),
    ],
)
def test_a_log_that_makes_no_sense_raises(log, options, message):
    with pytest.raises((ValueError, KeyError), match=message):
        message_rows(log, **options)


def test_a_regular_log_is_a_regular_filter(float64):
    """A motion that reads its steps, with the noise of each step, does what one of fixed steps does."""
    torch.manual_seed(0)
    gyro, up = 0.3 * torch.randn(50, 3), torch.randn(50, 3)
    log = [(0.02 * row, "gyro", value) for row, value in enumerate(gyro.tolist())]
    log += [(0.02 * row, "up", value) for row, value in enumerate(up.tolist())]
    rows = message_rows(log, driving=["gyro"])[1:]  # the first message stands where the filter starts

    def attitude(dt):
        motion = AttitudeMotion(dt, gyro_noise=1e-2, gyro_walk=1e-3)
        start = GaussianAround([0.3] * 3 + [0.02] * 3, state_key="start", space=motion.space)
        sensors = {"up": FusedSensor(Gravity(motion.space), [0.5] * 3)}
        return FusedFilter(motion, sensors, initial=start, process_noise=motion.process_noise)

    rows["start"] = attitude(0.1).initial.space.neutral(gyro).expand(len(rows), 7)
    fixed, read = attitude(0.02).sequence(rows.copy()), attitude("dt").sequence(rows.copy())
    assert_close(read["belief", "mean"], fixed["belief", "mean"], rtol=0, atol=1e-8)
    assert_close(read["belief", "cov"], fixed["belief", "cov"], rtol=1e-6, atol=1e-10)


def pose_log(covariance: bool) -> TensorDict:
    """Returns poses at times of their own, each with the noise of its tangent."""
    random, log = np.random.default_rng(0), []
    for row in range(12):
        root = 0.1 * random.normal(size=(6, 6))
        noise = root @ root.T + 0.01 * np.eye(6)
        pose = SE3().perturb(SE3().neutral(), torch.tensor(0.3), torch.randn(6)).tolist()
        log.append((0.1 * row + 0.02 * random.random(), "pose", pose, noise if covariance else noise.diagonal()))
    return message_rows(log)


def pose_filter(covariance: bool) -> FusedFilter:
    """An extended Kalman filter takes covariances, an ensemble variances."""
    motion = ConstantTwist(SE3(), "dt", twist_noise=0.5)
    around = {"state_key": "start", "space": motion.space}
    start = GaussianAround([0.3] * 12, **around) if covariance else AroundState([0.3] * 12, ensemble_size=16, **around)
    sensor = FusedSensor(PoseOf(motion.space), "pose_noise", reading_space=SE3())
    return FusedFilter(motion, {"pose": sensor}, initial=start, process_noise=motion.process_noise)


@pytest.mark.parametrize("covariance", [True, False], ids=["EKF", "ensemble"])
def test_noise_of_each_reading_in_every_way_to_run(float64, covariance):
    """A sequence, its steps, and a step whose reading is left out."""
    torch.manual_seed(1)
    filter, rows = pose_filter(covariance), pose_log(covariance)
    rows["start"] = filter.initial.space.neutral(rows["pose"]).expand(len(rows), 13)
    torch.manual_seed(2)
    rows = filter.draw_noise(rows)
    whole = filter.sequence(rows.copy())
    belief = filter.initialise(rows[0].copy())
    for row in rows[1:]:
        belief = filter.step(belief.update(row))
    assert_close(belief["belief", "mean"], whole["belief", "mean"][-1], rtol=0, atol=1e-10)
    left_out = rows[1].exclude("pose", "pose_noise", "pose_observed")
    without = filter.step(filter.initialise(rows[0].copy()).update(left_out), without=["pose"])
    assert not without["info", "nis"].any()
    assert whole["info", "nis"][1] > 0


def test_a_sensor_that_drives_and_makes_no_rows_is_a_mean_over_each_step():
    """The mean over a step of a line is its value in the middle; without it all 100 messages are rows."""
    log = [(0.01 * k, "imu", [0.03 * k]) for k in range(101)]
    log += [(0.25 * k, "gps", [1.0]) for k in range(1, 5)]
    assert len(message_rows(log, driving=["imu"])) > 100
    rows = message_rows(log, driving=["imu"], rows_of=["gps"], start=0.0, dtype=torch.float64)
    torch.testing.assert_close(rows["stamp"][:, 0], 0.25 * torch.arange(5, dtype=torch.float64))
    torch.testing.assert_close(rows["imu"][1:, 0], 3 * (0.25 * torch.arange(4, dtype=torch.float64) + 0.125))
    assert rows["gps_observed"][:, 0].tolist() == [False, True, True, True, True]
    with pytest.raises(ValueError, match=r"rows_of=\['imu'\] leaves out \['gps'\], which do not drive"):
        message_rows(log, driving=["imu"], rows_of=["imu"])
    with pytest.raises(KeyError, match=r"rows_of names \['lidar'\]"):
        message_rows(log, driving=["imu"], rows_of=["gps", "lidar"])
