"""The frontier of the KITTI study: the same weights at other sizes, means over drives."""

import torch

from benchmarks.kitti.frontier import COLUMNS, means
from tests.benchmarks.test_kitti import smooth_drive
from torch_denkf.applications.car.odometry.streams import all_frames


def drive(recipe, members):
    torch.manual_seed(1)
    read = smooth_drive(130, recipe.encoding)
    samples = read["spans", "ensemble"]
    read["spans"]["ensemble"] = samples[:, :, torch.arange(members) % samples.shape[2]]
    return all_frames(read)


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
