"""A path that was written, and changed since."""

import pytest

from torch_denkf.applications.car.odometry.paths import PATH_COLUMNS, read_path


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
@pytest.mark.parametrize("column", range(len(PATH_COLUMNS)))
def test_numbers_that_are_not_finite_are_named(tmp_path, value, column):
    row = ["1"] * len(PATH_COLUMNS)
    broken = [*row[:column], value, *row[column + 1 :]]
    (tmp_path / "path.csv").write_text("\n".join(",".join(line) for line in (PATH_COLUMNS, row, broken)) + "\n")
    with pytest.raises(ValueError, match=rf"path\.csv:3: {PATH_COLUMNS[column]} not finite"):
        read_path(tmp_path / "path.csv")
