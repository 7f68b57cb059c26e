"""Tests what a sensor of several is told, and what it raises."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import pytest

from torch_denkf import FusedSensor
from torch_denkf.modules import Select


def test_a_misspelt_argument_is_named_beside_those_that_exist():
    with pytest.raises(TypeError, match=r"FusedSensor takes no argument 'dealy'; it takes .*delay, late_key"):
        FusedSensor(Select([0]), [0.1], dealy=3)


def test_a_key_is_a_key():
    with pytest.raises(TypeError, match="late_key of FusedSensor is a key"):
        FusedSensor(Select([0]), [0.1], delay=3, late_key=5)


def test_a_sensor_is_copied_pickled_and_changed():
    sensor = FusedSensor(Select([0]), [0.1], delay=3)
    assert copy.deepcopy(sensor).delay == pickle.loads(pickle.dumps(sensor)).delay == 3
    assert replace(sensor, delay=2).delay == 2
