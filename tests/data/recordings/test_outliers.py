"""Fixes that are far from all around them, by the truth of a simulated cart."""

import numpy as np
import pytest

from tests.data.recordings.cart import cart
from torch_denkf.cli.main import main
from torch_denkf.data.recordings.offsets import delays_between, solved
from torch_denkf.data.recordings.outliers import outlying, without_outliers
from torch_denkf.data.recordings.tables import Readings


@pytest.mark.parametrize("share", [0.0, 0.1])
def test_outliers_of_a_cart(share):
    """Finds all of 3 m, 30 standard deviations, gaps and ends of the log included, and none that is sound."""
    _, fixes, wrong, _ = cart(300, share, gaps=[(60, 75), (180, 188)])
    assert (outlying(fixes[:, 0], fixes[:, 1:]) == wrong).all()


def test_sound_fixes_are_kept():
    """Turns at 1 Hz that no parabola follows, steps of a grid, a robot at rest, jumps that last, logs of few fixes."""
    rng, time = np.random.default_rng(0), np.arange(200.0)
    heading = np.cumsum(0.5 * np.sign(np.sin(0.3 * time)))
    turns = np.cumsum(8 * np.c_[np.cos(heading), np.sin(heading)], 0)
    jump = turns + np.where(time > 100, 50.0, 0.0)[:, None]
    for fixes in (turns, turns.round(), jump + 0.3 * rng.normal(size=jump.shape), np.zeros_like(turns), turns[:5]):
        assert not outlying(time[: len(fixes)], fixes).any()
    assert len(outlying(np.zeros(0), np.zeros((0, 2)))) == 0


def test_ends_of_a_window_of_noise_are_kept():
    """There, the parabola through the other fixes misses a sound one by more."""
    rng = np.random.default_rng(0)
    assert not any(outlying(np.arange(11.0), rng.normal(size=(11, 2))).any() for _ in range(100))


def test_a_repeated_outlier_is_one():
    """A log at 20 Hz repeats the fixes of 5 Hz: their rows go with them, and count once."""
    _, fixes, wrong, _ = cart(30, 0.1)
    rows = np.repeat(fixes, 4, 0)
    rows[:, 0] = 0.05 * np.arange(len(rows))
    kept, count = without_outliers(Readings(rows[:, 0], rows[:, 1:], ("x", "y")))
    assert (count, len(kept.times)) == (wrong.sum(), 4 * (~wrong).sum())
    speeds = Readings(rows[:, 0], rows[:, 1:2], ("speed",))
    late = Readings(rows[:, 0], rows[:, 1:], ("x", "y"), arrived=rows[:, 0] + 1)
    for table in (speeds, late):
        assert without_outliers(table) == (table, 0)


@pytest.mark.parametrize("seed", range(4))
def test_outliers_and_gaps_invent_no_delay(seed):
    """Wheel and fixes of one clock: none within three standard deviations, which are small enough to say something.

    Across a gap of 15 s of a bend the chord is much shorter than the way.
    """
    _, fixes, _, wheel = cart(120, 0.1, seed, gaps=[(60, 75)])
    places, speeds = Readings(fixes[:, 0], fixes[:, 1:], ("x", "y")), Readings(wheel[:, 0], wheel[:, 1:], ("speed",))
    tables = {"fixes": places, "wheel": speeds}
    offset = solved(delays_between(tables), tables)["fixes"]
    assert not offset.sure
    assert abs(offset.seconds) < 0.2
    assert offset.std < 0.1


def test_outliers_are_counted(tmp_path, capsys):
    _, fixes, wrong, _ = cart(30, 0.1)
    np.savetxt(tmp_path / "log.csv", fixes, delimiter=",", header="t,x,y", comments="")
    assert main(["log", str(tmp_path / "log.csv")]) == 0
    assert f"{wrong.sum()} outliers, fixes that are far from all around them" in capsys.readouterr().out
