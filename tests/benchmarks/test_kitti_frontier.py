"""The frontier of the KITTI study: the same weights at other sizes, means over drives."""

import pytest
import torch

from benchmarks.kitti.folds import Statistics
from benchmarks.kitti.frontier import COLUMNS, means
from benchmarks.kitti.recipes import FILTERS
from benchmarks.kitti.sensors import SENSORS
from benchmarks.kitti.training import load_filter, run_filter
from tests.benchmarks.test_kitti import smooth_drive
from torch_denkf.applications.car.odometry.streams import all_frames
from torch_denkf.training.checkpoint import write_checkpoint


@pytest.fixture
def trained(tmp_path):
    """A folder with an untrained DEnKF of 32 members, its recipe and its model."""
    facts = Statistics(torch.tensor([9.0, 0.0]), torch.tensor([3.0, 0.1]), torch.zeros(2), torch.ones(2), 0.1)
    torch.manual_seed(0)
    recipe = FILTERS["denkf"](SENSORS["flow"](facts), facts)
    model = recipe.build()
    notes = {"filter": "denkf", "sensor": "flow", "facts": vars(facts)}
    write_checkpoint(tmp_path / "filter.pt", {"model": model.state_dict(), "inflation": 1.1, **notes})
    return tmp_path, recipe, model


def drive(recipe, members):
    torch.manual_seed(1)
    read = smooth_drive(130, recipe.encoding)
    samples = read["spans", "ensemble"]
    read["spans"]["ensemble"] = samples[:, :, torch.arange(members) % samples.shape[2]]
    return all_frames(read)


def test_the_size_that_was_trained_gives_what_was_trained(trained):
    folder, recipe, model = trained
    recipe.set_inflation(model, 1.1)
    reading = drive(recipe, 32)
    with torch.no_grad():
        own = run_filter(recipe, model, [reading])["belief", "mean"]
        for options in ({}, {"size": 32}, {"size": 32, "scheme": "sensor"}):
            again, loaded, *_ = load_filter(folder, **options)
            assert torch.equal(run_filter(again, loaded, [reading])["belief", "mean"], own)


def row(name, drive, value, window=100, **entries):
    names = {"filter": name, "sensor": "flow", "members": 8, "seed": 0, "drive": drive, "window": window}
    return {**names, "translation_m_per_m": value, "crps": 2 * value, **entries}


def test_means_are_over_drives_that_are_long_enough_and_a_drive_counts_once():
    rows = [row("a", "d/image_0", 1.0, ms_per_step=0.5), row("a", "d/image_1", 3.0), row("a", "e/image_0", 4.0)]
    rows += [row("a", "f/image_0", 90.0, window=50), row("b", "d/image_0", 7.0)]
    first, second = means(rows)
    assert (first["filter"], first["drives"], first["translation_m_per_m"], first["crps"]) == ("a", 2, 3.0, 6.0)
    assert first["ms_per_step"] == 0.5  # of the weights that were timed
    assert (second["filter"], second["drives"], second["crps"]) == ("b", 1, 14.0)
    assert set(first) <= set(COLUMNS.names)
    assert means(rows[3:4])[0]["translation_m_per_m"] == 90.0  # where no drive is long enough, all count
