"""Logs of messages as robots write them: large numbers, stamps of another clock, sensors that fall silent."""

import re
import warnings

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torch_denkf.fusion import message_rows


@pytest.fixture(autouse=True)
def _no_other_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        yield


def messages(name="gps", count=200, rate=100.0, begin=0.0, value=lambda k: [0.1 * (k % 7)]):
    return [(begin + k / rate, name, value(k)) for k in range(count)]


@pytest.mark.parametrize(
    ("dtype", "origin", "step", "resolved"),
    [
        (torch.float32, 5.4e6, 0.02, "0.5"),
        (torch.float32, -2.1e9, 7.0, "1.3e\\+02"),
        (torch.float16, 30.0, 0.02, "0.031"),
        (torch.bfloat16, 100.0, 1.0, "2"),
    ],
)
def test_large_numbers(dtype, origin, step, resolved):
    log = messages(value=lambda k: [0.5 * (k % 2), origin + step * k])
    match = rf"the log: 'gps\[1\]' moves by {step:.3g} a row .* {str(dtype)[6:]} resolves {resolved}; pass origin="
    with pytest.warns(UserWarning, match=match) as said:
        message_rows(log, dtype=dtype)
    assert len(said) == 1
    assert said[0].filename == __file__
    kept = message_rows(log, dtype=torch.float32, origin={"gps": [0.0, origin]})["gps"][1:, 1]
    assert_close(kept.double(), step * torch.arange(200.0).double(), rtol=1e-6, atol=1e-6 * abs(origin) ** 0.5)
    double = message_rows(log, dtype=torch.float64, origin={"gps": 0.0})["gps"][1:, 1]
    assert_close(double, origin + step * torch.arange(200.0).double(), rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("log", "seen"),
    [
        ([(1e7 * k, "gps", [0.0]) for k in range(50)], "'gps' has steps of usually 1e\\+07 s"),  # ns
        ([(0.0, "pose", [0.0]), *messages(begin=1.7e9)], "'pose' has nothing for 1.7e\\+09 s after 0 s"),
        (messages() + messages(begin=0.3), "'gps' goes back by 1.69 s, to 0.3 s, at 200 of 400"),
        ([*messages()[:50], (-3600.0, "gps", [0.0]), *messages()[51:]], "'gps' goes back by 3600 s.* has nothing for"),
    ],
    ids=["ns", "a stamp that was not set", "two runs", "an hour back"],
)
def test_stamps_that_no_log_has(log, seen):
    with pytest.warns(UserWarning, match="the log: .* pass unit='ms', 'us' or 'ns'") as said:
        message_rows(log)
    texts = " and ".join(str(one.message) for one in said)
    assert re.search(seen, texts), texts


def test_units():
    """Stamps in ns since 1970 keep their steps to a microsecond; delays and the start are in seconds."""
    log = [(1_700_000_000_000_000_000 + 10_000_000 * k, "gps", [0.1 * k]) for k in range(50)]
    rows = message_rows(log, unit="ns", delays={"gps": 0.5}, start=1.7e9 - 0.5)
    assert_close(rows["dt"][2:], torch.full((49, 1), 0.01), rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="unit is one of 's', 'ms', 'us', 'ns', got 'h'"):
        message_rows(log, unit="h")


def test_unordered_stamps_and_consecutive_streams():
    random = np.random.default_rng(0)
    log = messages() + messages("imu", 400, 200.0) + [(1.7, "pose", [0.0])]
    expected = message_rows(log)
    shuffled = [log[k] for k in random.permutation(len(log))]
    assert_close(message_rows(shuffled)["stamp"], expected["stamp"])
    uneven = np.sort(random.exponential(0.1, 300)).cumsum()  # a sensor of events
    assert len(message_rows([(stamp, "bumper", [1.0]) for stamp in random.permutation(uneven)])) == 301


GPS = messages(count=20, rate=1.0)


@pytest.mark.parametrize(
    ("imu", "seen"),
    [
        (messages("imu", 500), "in 1 stretches, 4.99 to 19 s, where its steps are usually 0.01 s"),  # ends at 5 s
        (messages("imu", 500) + messages("imu", 500, begin=15.0), "in 1 stretches, 4.99 to 15 s"),  # silent for 10 s
        (messages("imu", 1000, begin=12.0), "in 1 stretches, 0 to 12 s"),  # begins late
        (messages("imu", 2, 1.0), "in 0 stretches"),
    ],
    ids=["ends", "is silent", "begins late", "says it twice"],
)
def test_a_sensor_that_drives_and_is_silent(imu, seen):
    if "in 0" in seen:
        message_rows(GPS[:2] + imu, driving=["imu"])
        return
    with pytest.warns(UserWarning, match=rf"the log: 'imu' drives the motion and says nothing {seen}.*pass start="):
        rows = message_rows(GPS + imu, driving=["imu"])
    assert rows["imu"].isfinite().all()


@pytest.mark.parametrize("begin", [3600.0, -3600.0])
def test_a_sensor_that_drives_from_an_hour_off(begin):
    imu = messages("imu", 1900, begin=begin)
    with pytest.warns(UserWarning, match="has nothing for 3.*unit="):  # noqa: SIM117
        with pytest.raises(ValueError, match=r"'imu' drives the motion from .* no message while the others read, 0 to"):
            message_rows(GPS + imu, driving=["imu"])
    covered = messages("imu", 2100, begin=-1.0)
    assert message_rows(GPS + covered, driving=["imu"], start=0.0)["imu"].isfinite().all()
