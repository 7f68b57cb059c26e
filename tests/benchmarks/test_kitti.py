"""The parts of the KITTI study that a wrong table could come from."""

import math

import pytest
import torch
from tensordict import TensorDict

from benchmarks.kitti.evaluation import errors, integrate, last_velocities
from benchmarks.kitti.folds import Fold, Part, Statistics, make_fold, with_disturbances
from benchmarks.kitti.recipes import FILTERS
from benchmarks.kitti.sensors import SENSORS, SensorOfFold
from benchmarks.kitti.streams import DISTURBANCES, LONGEST, Stream
from benchmarks.kitti.tables import by_drive
from benchmarks.kitti.training import log_gains, run_filter
from tests.applications.car.odometry.test_streams import readings
from torch_denkf.applications.car import dead_reckoning
from torch_denkf.applications.car.modules.pairs import PairObservation
from torch_denkf.applications.car.odometry.streams import all_frames


def streams(*drives, cameras=("image_0",)):
    return [Stream("root", drive, camera) for drive in drives for camera in cameras]


@pytest.fixture(autouse=True)
def rows_of_drives(monkeypatch):
    monkeypatch.setattr("benchmarks.kitti.folds._rows", lambda stream: 100)


@pytest.mark.parametrize("rendered", [0, 4])
@pytest.mark.parametrize("test", ["a", "c", "f"])
def test_no_fold_trains_on_its_test_drive_in_any_condition_or_camera(test, rendered):
    found = streams(*"abcdef", cameras=("image_0", "image_1"))
    parts = [Part(stream) for stream in streams(*[f"r{i}" for i in range(rendered)])]
    fold = make_fold(test, found, parts[1:], parts[:1])
    others = [*fold.train, *fold.tune, *fold.validation]
    assert {stream.drive for stream in fold.test} == {test}
    assert len(fold.test) == 2  # both cameras
    assert test not in {part.stream.drive for part in others}
    assert {part.stream.condition for part in fold.train} == {"clean", *DISTURBANCES}
    roles = [{part.stream.drive for part in role} for role in (fold.train, fold.tune, fold.validation)]
    if not rendered:  # the checkpoint is chosen on a drive of its own; the others are read by sensors that stand in
        assert roles[0] == roles[1] == fold.shared
        assert not roles[0] & roles[2]
        assert set.union(*roles) == set("abcdef") - {test}


def test_dead_reckoning_holds_the_last_reading_and_before_the_first_the_true_start():
    values = [[9.0, 9.0], [1.0, 0.1], [9.0, 9.0], [2.0, 0.2], [9.0, 9.0]]
    read = all_frames(readings(values, [False, True, False, True, False]))
    expected = torch.tensor([[7.0, 0.7], [1.0, 0.1], [1.0, 0.1], [2.0, 0.2], [2.0, 0.2]])
    torch.testing.assert_close(last_velocities(read, 0.1), expected)


def test_errors_of_a_path_that_is_a_tenth_too_fast():
    truth = torch.zeros(121, 5, dtype=torch.float64)
    truth[:, 3] = 10.0
    truth[:, 0] = torch.arange(121) * 1.0
    states = integrate(truth[:, 3:] * 1.1, truth, 0.1)
    table = errors(states, truth)
    assert [row["window"] for row in table] == [50, 100]
    for row in table:
        assert row["translation_m_per_m"] == pytest.approx(0.1)
        assert row["pathlength_m_per_m"] == pytest.approx(0.1)
        assert row["rotation_deg_per_m"] == pytest.approx(0.0)
        assert row["rmse_v_m_per_s"] == pytest.approx(1.0)
        assert row["devkit_t_rel_percent"] == pytest.approx(10.1, abs=0.15)  # a segment ends behind 100 m, by a frame


def test_gains_are_those_of_clean_unseen_drives():
    """Drives at 7 m/s read as 7 e^0.03 and 7 e^-0.04; what a disturbed one reads does not count."""
    parts = with_disturbances([Part(stream) for stream in streams("a", "b")])
    fold = Fold("t", [], parts, [])
    base = SensorOfFold("flow", None, None, [])
    for part in parts:
        off = {"a": 0.03, "b": -0.04}[part.stream.drive] if part.stream.condition == "clean" else 0.5
        read = readings([[7.0 * math.exp(off), 0.0]] * 20)
        base.readings += [(read[:12], read[12:], 1.0)] * 2  # as they are, and mirrored
    torch.testing.assert_close(log_gains(fold, base), torch.tensor([0.03, -0.04]), rtol=1e-4, atol=0)


def test_filters_predict_readings_of_a_sensor_with_gain():
    sensor = SENSORS["flow"](facts := Statistics(torch.zeros(2), torch.ones(2), torch.zeros(2), torch.ones(2), 0.1))
    for name in ("denkf", "dekf", "bkf", "dpf_m_lrn"):
        recipe = FILTERS[name](sensor, facts)
        model = recipe.build()
        recipe.set_gain(model, math.log(0.9))
        (h,) = [module for module in model.modules() if isinstance(module, PairObservation)]
        read = h.module(torch.tensor([10.0, 0.5]))
        torch.testing.assert_close(read, torch.tensor([9.0, 0.5]))
        assert "logarithm" not in " ".join(model.state_dict())


def row(drive, seed, value, **entries):
    row = {"filter": "denkf", "sensor": "flow", "condition": "clean", "window": 100, "coverage90": 0.9}
    return {**row, "drive": drive, "seed": seed, "translation_m_per_m": value, "rotation_deg_per_m": 0.1, **entries}


def test_a_drive_counts_once_by_the_median_of_its_seeds_and_the_mean_of_its_cameras():
    rows = [row("a/image_0", 0, 1.0), row("a/image_1", 0, 3.0), row("a/image_0", 1, 5.0), row("a/image_1", 1, 5.0)]
    rows += [row("a/image_0", 2, 90.0), row("a/image_1", 2, 90.0), row("b/image_2", 0, 7.0)]
    assert by_drive(rows)["translation_m_per_m"].tolist() == [5.0, 7.0]


def facts():
    return Statistics(torch.tensor([9.0, 0.0]), torch.tensor([3.0, 0.1]), torch.zeros(2), torch.ones(2), 0.1)


def smooth_drive(count, encoding):
    """Returns readings of a flow sensor over gaps, with errors of 0.02, from a drive of ``count`` steps."""
    velocity = torch.stack([8 + 2 * torch.linspace(0, 6, count).sin(), 0.1 * torch.linspace(0, 4, count).cos()], -1)
    path = dead_reckoning(velocity.double(), torch.zeros(3, dtype=torch.float64), 0.1).float()
    sums = torch.stack([sum(torch.roll(velocity, lag, 0) for lag in range(n)) for n in range(1, LONGEST + 1)], 1)
    samples = sums.unsqueeze(2) + 0.02 * torch.randn(count, LONGEST, 32, 2)
    encoding = torch.zeros(count, LONGEST, encoding)
    entries = {"observed": torch.ones(count, LONGEST, 1).bool(), "ensemble": samples, "encoding": encoding}
    state = torch.cat([path, velocity], -1)
    return TensorDict({"state": state, "spans": TensorDict(entries, batch_size=[count, LONGEST])}, [count])


@pytest.mark.parametrize("name", ["dekf", "bkf"])
def test_inflation_of_the_gaussian_filters_widens_the_velocities_and_leaves_pose_and_gain_finite(name):
    recipe = FILTERS[name](SENSORS["flow"](facts()), facts())
    model, read = recipe.build(), smooth_drive(300, recipe.encoding)
    out = []
    with torch.no_grad():
        for factor in (1.0, 1.4):
            recipe.set_inflation(model, factor)
            out.append(run_filter(recipe, model, [all_frames(read)])["belief"][0])
    plain, inflated = out
    settled = slice(100, None)  # the first belief is the same in both
    ratio = inflated["var"][settled, 3:5] / plain["var"][settled, 3:5]
    torch.testing.assert_close(ratio, torch.full_like(ratio, 1.4**2), rtol=0.01, atol=0.0)
    torch.testing.assert_close(inflated["mean"][settled, 3:5], plain["mean"][settled, 3:5], rtol=1e-3, atol=1e-3)
    # The pose's spread grows with the way, not by 1.4 a step: 1.4**600 would have left float32 behind.
    assert (inflated["var"][-1, :3] < 2.5 * plain["var"][-1, :3]).all()
