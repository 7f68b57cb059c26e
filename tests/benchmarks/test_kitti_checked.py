"""Streams whose pictures are checked: those that show nothing are left out, what hides the street is seen through."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from benchmarks.kitti.folds import Fold, Statistics
from benchmarks.kitti.recipes import FILTERS
from benchmarks.kitti.sensors import SENSORS
from benchmarks.kitti.streams import LONGEST, Stream, spans
from benchmarks.kitti.study import Job, Study
from torch_denkf.applications.car import write_drives
from torch_denkf.applications.car.kitti.frames import MOTION_KEYS

FRAMES = 14


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A stream of a rendered drive, and where streams are kept."""
    folder = tmp_path_factory.mktemp("checked")
    (name,) = write_drives(folder / "kitti", ["a"], frames=FRAMES, size=(100, 300), seed=0)
    return Stream(str(folder / "kitti"), name, "image_2", size=(100, 300)), folder / "streams"


def test_a_clean_drive_stays_as_it_is(drive):
    stream, cache = drive
    plain, checked = (replace(stream, repair=each).read(cache) for each in (False, True))
    assert all(torch.equal(plain[key], checked[key]) for key in ("steps", "image", *MOTION_KEYS))


def test_black_pictures_are_left_out_and_seen_past(drive):
    stream, cache = drive
    black = replace(stream, condition="black")
    dark = black._drive()["image"].flatten(1).float().mean(1) < 1
    assert 1 <= int(dark[1:].sum()) < FRAMES // 2
    lengths = [each.steps for each in spans(replace(black, repair=True), "flow")]
    assert lengths == list(range(1, LONGEST + 1))
    assert len(spans(black, "flow")) == 1
    for steps in lengths:
        seen = replace(black, repair=True, steps=steps).read(cache)
        clean = replace(stream, steps=steps).read(cache)
        for row in range(FRAMES):
            between = dark[max(row - steps + 1, 0) : row]
            whole = row >= steps and not dark[row] and not dark[row - steps] and bool(between.all())
            assert int(seen["steps"][row]) == steps * whole, (row, steps)
            if whole:
                assert all(torch.equal(seen[key][row], clean[key][row]) for key in MOTION_KEYS)


def test_behind_a_box_what_is_read_is_nearer_to_the_street(drive):
    stream, cache = drive
    box, clean = replace(stream, condition="box"), stream.read(cache)
    plain, checked = (replace(box, repair=each).read(cache) for each in (False, True))
    assert torch.equal(plain["steps"], checked["steps"])
    apart = [(each["road"] - clean["road"])[1:].float().abs().mean() for each in (plain, checked)]
    assert apart[1] < 0.6 * apart[0]
    assert len(spans(replace(box, repair=True), "flow")) == 1


def test_the_filter_on_checked_pictures_takes_the_trained_weights(tmp_path, monkeypatch):
    job = Job(Study(out=tmp_path), Fold("t", [], [], []), "flow", 0)
    asked, facts = (
        [],
        Statistics(torch.tensor([9.0, 0.0]), torch.tensor([3.0, 0.1]), torch.zeros(2), torch.ones(2), 0.1),
    )
    sensor = SENSORS["flow"](facts)
    loaded = (SimpleNamespace(facts=facts), {"sensor": sensor}, "denkf", "flow")
    monkeypatch.setattr("benchmarks.kitti.study.train_filter", lambda fold, name, base, **_: asked.append(name))
    monkeypatch.setattr("benchmarks.kitti.study.load_filter", lambda folder: loaded)
    assert not job.borrows("denkf_gated")
    recipe, model = job.train("denkf_gated", None)
    assert asked == ["denkf"]
    assert type(recipe) is FILTERS["denkf_gated"]
    assert recipe.repair
    assert recipe.sensor is sensor is model["sensor"]
    job.out("denkf").mkdir(parents=True)
    (job.out("denkf") / "filter.pt").touch()
    assert job.borrows("denkf_gated")
    assert not job.borrows("denkf")
    job.train("denkf_gated", None)
    assert asked == ["denkf"]
