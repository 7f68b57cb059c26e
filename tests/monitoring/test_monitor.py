"""The monitor on linear Gaussian systems, where the distribution of every test is known."""

import math

import pytest
import torch
from scipy.stats import f as f_distribution
from scipy.stats import norm
from tensordict import TensorDict

from torch_denkf.filters import KalmanFilter
from torch_denkf.functional import analyse
from torch_denkf.monitoring import InnovationMonitor, Monitored, MonitoredSensor
from torch_denkf.monitoring.change_detection import cusum_threshold

STATE, READ = 2, 2
F = torch.tensor([[1.0, 0.1], [-0.1, 0.9]])
Q, R = 0.05 * torch.eye(STATE), torch.tensor([0.3, 0.2])
P0 = torch.eye(STATE)


def kalman(dtype=torch.float32, **kwargs):
    f, h, q, r = (part.to(dtype) for part in (F, torch.eye(READ, STATE), Q, R.diag()))
    return KalmanFilter(
        f, h, process_noise_cov=q, noise_cov=r, mean=torch.zeros(STATE, dtype=dtype), cov=P0.to(dtype), **kwargs
    )


def simulate(runs, steps, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)

    def normal(*size):
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    state, states, readings = normal(runs, STATE), [], []
    for _ in range(steps):
        states.append(state)
        readings.append(state + R.double().sqrt() * normal(runs, READ))
        state = state @ F.double().mT + 0.05**0.5 * normal(runs, STATE)
    values = {"state": torch.stack(states, 1), "observation": torch.stack(readings, 1)}
    return TensorDict(values, [runs, steps]).to(dtype)


def monitor(**kwargs):
    return InnovationMonitor({"gps": MonitoredSensor("info", READ)}, **kwargs)


def within_binomial_error(share, rate, count, deviations=4.0):
    return abs(share - rate) < deviations * math.sqrt(rate * (1 - rate) / count)


@pytest.mark.parametrize("rate", [0.05, 1e-3])
def test_false_alarms_of_one_step_come_at_their_rate(rate):
    out = Monitored(kalman(), monitor(window=1)).sequence(simulate(500, 201))
    p = out["monitor", "gps", "p_value"][:, 1:]
    assert p.numel() == 100_000
    assert within_binomial_error((p < rate).double().mean().item(), rate, p.numel())


def test_false_alarms_of_windows_come_at_their_rate():
    out = Monitored(kalman(), monitor(window=5)).sequence(simulate(5000, 106))
    tests = out["monitor", "gps"][:, 5::5]  # windows that do not overlap; the first step sees no reading
    count = tests.numel()
    assert count > 1e5
    for name in ("p_value", "whiteness"):
        share = (tests[name] < 0.01).double().mean().item()
        if name == "p_value":
            assert within_binomial_error(share, 0.01, count), name
        else:  # a sum of four products is normal in the limit alone
            assert 0.005 < share < 0.03, name


@pytest.mark.parametrize(("whiteness", "noise", "tests"), [(False, False, 4), (True, False, 6), (True, True, 7)])
def test_all_tests_of_all_sensors_share_the_false_alarms_equally(whiteness, noise, tests):
    """Window and sum of two sensors; whiteness, where it may raise the alarm; a noise that one of them claims."""
    rate = 0.012
    sensors = {name: MonitoredSensor(("info", name), 1) for name in ("gps", "wheel")}
    if noise:
        sensors["gps"] = sensors["gps"]._replace(noise_key=("sensor", "noise"))
    watch = InnovationMonitor(sensors, false_alarm_rate=rate, whiteness=whiteness).double()
    for limit in (watch.p_limit, watch.whiteness_limit):
        assert limit.tolist() == pytest.approx([rate / tests] * 2)
    assert watch.cusum_limit.tolist() == pytest.approx([cusum_threshold(tests / rate)] * 2)


def test_a_bias_of_the_reported_size_is_found_with_the_reported_power():
    # Without dynamics nor doubt the innovation is the reading's error: its bias is the sensor's.
    still = KalmanFilter(
        torch.eye(2),
        torch.eye(2),
        process_noise_cov=0 * torch.eye(2),
        noise=R.sqrt(),
        mean=torch.zeros(2),
        cov=1e-12 * torch.eye(2),
    )
    watch = monitor(window=4)
    bias = watch.detectable_bias(power=0.8)["gps"]
    direction = torch.tensor([0.6, 0.8]) * bias * R.sqrt()
    readings = R.sqrt() * torch.randn(20000, 5, 2, generator=torch.Generator().manual_seed(1)) + direction
    out = Monitored(still, watch).sequence(TensorDict({"observation": readings}, [20000, 5]))
    found = (out["monitor", "gps", "p_value"][:, -1] < watch.p_limit).double().mean().item()
    assert within_binomial_error(found, 0.8, 20000)


def test_coloured_innovations_fail_whiteness_with_the_closed_form():
    """Innovations with correlation rho: the test's z has mean rho sqrt(W O) and scatters by little more than one."""
    rho, steps, runs = 0.5, 60, 2000
    generator = torch.Generator().manual_seed(0)
    white = torch.randn(runs, steps, 2, generator=generator)
    rows = [white[:, 0]]
    for t in range(1, steps):
        rows.append(rho * rows[-1] + math.sqrt(1 - rho**2) * white[:, t])
    innovation = torch.stack(rows, 1)
    data = TensorDict(
        {"info": {"innovation": innovation, "nis": innovation.square().sum(-1, keepdim=True)}}, [runs, steps]
    )
    p = monitor(window=steps).replay(data)["monitor", "gps", "whiteness"][:, -1]
    z = torch.from_numpy(norm.isf(p.double().clamp_min(1e-30).numpy() / 2))
    assert z.median().item() == pytest.approx(rho * math.sqrt((steps - 1) * 2), rel=0.05)


def test_calibration_finds_the_distribution_of_few_members():
    """With R near zero the NIS of E Gaussian members is (1 + 1/E) times Hotelling's: F distributed, up to a factor."""
    members, dim, count = 8, 2, 60_000
    generator = torch.Generator().manual_seed(0)
    draws = torch.randn(count, members + 1, dim, generator=generator, dtype=torch.float64)
    noise = torch.full((count, dim), 1e-12, dtype=torch.float64)
    result = analyse(draws[:, 1:], draws[:, 1:], draws[:, 0], noise, scheme="etkf", space="observation")
    clean = TensorDict({"info": {"innovation": result.innovation, "nis": result.nis}}, [count]).reshape(1200, 50)
    watch = InnovationMonitor({"gps": MonitoredSensor("info", dim)}, window=1).double()
    naive = (watch.replay(clean)["monitor", "gps", "p_value"] < 0.01).double().mean()
    assert naive > 0.08  # eight times as many as promised
    watch.calibrate([clean[:600]])
    for rate in (0.2, 0.01):
        # The value that Hotelling's distribution exceeds at this rate gets this p-value.
        factor = (members - 1) * dim / (members - dim) * (1 + 1 / members)
        value = torch.tensor([[factor * f_distribution.isf(rate, dim, members - dim)]], dtype=torch.float64)
        one = TensorDict({"info": {"innovation": value.sqrt().expand(1, dim), "nis": value}}, [1])
        assert watch.replay(one)["monitor", "gps", "p_value"].item() == pytest.approx(rate, rel=0.1)
    fresh = watch.replay(clean[600:])["monitor", "gps", "p_value"]
    assert within_binomial_error((fresh < 0.01).double().mean().item(), 0.01, 30_000, 6.0)  # both sides are samples


def test_the_alarm_names_the_sensor_that_fails():
    sensors = {"gps": MonitoredSensor(("info", "gps"), 1), "wheel": MonitoredSensor(("info", "wheel"), 2)}
    torch.manual_seed(1)
    innovation = {"gps": torch.randn(2, 40, 1), "wheel": torch.randn(2, 40, 2)}
    innovation["wheel"][0, 30:] += 6
    innovation["gps"][1, 30:] -= 6
    info = {name: {"innovation": d, "nis": d.square().sum(-1, keepdim=True)} for name, d in innovation.items()}
    out = InnovationMonitor(sensors).replay(TensorDict({"info": info}, [2, 40]))["monitor"]
    assert not out["alarm"][:, :30].any()
    assert (out["sensor"][:, :30] == -1).all()
    assert out["alarm"][:, 32:].all()
    assert out["sensor"][0, 32:].unique().tolist() == [1]
    assert out["sensor"][1, 32:].unique().tolist() == [0]


def test_missing_observations_change_nothing():
    data = simulate(3, 40)
    data["observed"] = torch.ones(3, 40, 1, dtype=torch.bool)
    data["observed"][:, 20:30] = False
    data["observation"][:, 15:20] += 1.5
    data["observation"][:, 20:30] = torch.nan
    out = Monitored(kalman(), monitor()).sequence(data)["monitor"]
    assert (out["gps", "cusum"][:, 19] > 1).all(), "what could fall"
    for key in (("gps", "p_value"), ("gps", "cusum"), ("gps", "terms"), "alarm"):
        assert torch.equal(out[key][:, 19:29], out[key][:, 20:30]), key
    assert out["gps", "p_value"].isfinite().all()


def test_single_components_count_as_many_degrees_as_are_observed():
    data = simulate(20_000, 2)
    data["observed"] = torch.tensor([True, False]).expand(20_000, 2, 2).clone()
    p = Monitored(kalman(), monitor(window=1)).sequence(data)["monitor", "gps", "p_value"][:, 1]
    assert within_binomial_error((p < 0.05).double().mean().item(), 0.05, 20_000)


def test_a_marked_beginning_forgets():
    data = simulate(2, 30)
    data["observation"][:, :15] += 40.0
    data["is_init"] = torch.zeros(2, 30, 1, dtype=torch.bool)
    data["is_init"][:, [0, 15]] = True
    watched = Monitored(kalman(), monitor())
    out = watched.sequence(data.clone())["monitor"]
    alone = watched.sequence(data[:, 15:].clone())["monitor"]
    assert out["alarm"][:, 14].all()
    for key in (("gps", "p_value"), ("gps", "cusum"), "alarm"):
        assert torch.equal(out[key][:, 15:], alone[key]), key
    replayed = watched.monitor.replay(watched.sequence(data.clone()))["monitor"]
    assert torch.allclose(replayed["gps", "cusum"][:, 16:], alone["gps", "cusum"][:, 1:], atol=1e-5)


def test_a_claimed_noise_that_jumps_raises_the_alarm():
    """A sensor that says itself that it sees nothing has innovations that are too small, not too large."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.exp(0.3 * torch.randn(12, 100, 1, generator=generator))
    innovation = noise.sqrt() * torch.randn(12, 100, 1, generator=generator)
    nis = innovation.square() / noise
    data = TensorDict({"info": {"innovation": innovation, "nis": nis}, "sensor": {"noise": noise}}, [12, 100])
    sensor = MonitoredSensor("info", 1, noise_key=("sensor", "noise"))
    watch = InnovationMonitor({"camera": sensor}).calibrate([data])
    blind = data.clone()
    blind["sensor", "noise"][:, 60:] *= 50
    blind["info", "nis"][:, 60:] /= 50
    assert not watch.replay(data)["monitor", "alarm"][:, 60:].any()
    assert watch.replay(blind)["monitor", "alarm"][:, 62:].all()


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match="sensors names none"):
        InnovationMonitor({})
    with pytest.raises(ValueError, match="window"):
        monitor(window=0)
    with pytest.raises(ValueError, match="false_alarm_rate"):
        monitor(false_alarm_rate=0.7)
    with pytest.raises(KeyError, match="does not write"):
        Monitored(kalman(), InnovationMonitor({"gps": MonitoredSensor("elsewhere", 2)}))
    with pytest.raises(ValueError, match="50 steps"):
        monitor().calibrate([Monitored(kalman(), monitor()).sequence(simulate(1, 10))])
