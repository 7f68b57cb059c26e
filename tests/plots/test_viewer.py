"""Oracle: the tensors that were passed, as rerun, or what stands in for it, gets them."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.plots.runs_for_tests import ensemble_run
from torch_denkf.plots import log_rollout


class Recording:
    """Keeps what is logged: by entity, a list of (step, seconds, archetype, values)."""

    def __init__(self, *_):
        self.entries, self.now, self.file = {}, {}, None

    def save(self, file):
        self.file = file

    def flush(self):
        pass

    def set_time(self, timeline, *, sequence=None, duration=None):
        self.now[timeline] = sequence if duration is None else duration

    def log(self, entity, value, static=False):
        entity = entity if isinstance(entity, str) else "/".join(entity)
        now = (None, None) if static else (self.now["step"], self.now.get("time"))
        self.entries.setdefault(entity, []).append((*now, *value))

    def values(self, entity):
        return np.array([np.asarray(entry[3]) for entry in self.entries[entity]])


@pytest.fixture
def stand_in(monkeypatch):
    def archetype(name):
        return lambda values, **_: (name, values)

    names = ("Image", "LineStrips3D", "Points3D", "Scalars")
    module = SimpleNamespace(RecordingStream=Recording, ViewCoordinates=SimpleNamespace(RIGHT_HAND_Z_UP=("view", "z")))
    vars(module).update({name: archetype(name) for name in names})
    monkeypatch.setitem(sys.modules, "rerun", module)


def run_with_pixels():
    run = ensemble_run(steps=6)
    run["pixels"] = torch.linspace(0, 1, 6)[:, None, None, None].expand(6, 3, 4, 5)
    return run


def test_everything_is_logged_at_its_step(stand_in, tmp_path):
    run = run_with_pixels()
    run["observed"][2] = False
    logged = log_rollout(run, components=[2], names=["z, m"], time=0.5, file=tmp_path / "new" / "a.rrd")
    assert logged.file == str(tmp_path / "new" / "a.rrd")
    assert (tmp_path / "new").is_dir()
    truth, ensemble, mean = run["state"], run["belief", "ensemble"], run["belief", "mean"]
    flat = torch.tensor([1.0, 1.0, 0.0])  # two coordinates lie on the ground
    ((step, _, kind, (path,)),) = logged.entries["path/truth"]
    assert (step, kind) == (None, "LineStrips3D")
    np.testing.assert_allclose(path, truth * flat, rtol=1e-6)
    np.testing.assert_allclose(logged.values("path/belief/now")[:, 0], mean * flat, rtol=1e-6)
    np.testing.assert_allclose(logged.values("path/ensemble"), ensemble * flat, rtol=1e-6)
    assert [entry[:3] for entry in logged.entries["path/ensemble"]] == [(t, 0.5 * t, "Points3D") for t in range(6)]
    np.testing.assert_array_equal(logged.values("camera")[:, 0, 0, 0], [0, 51, 102, 153, 204, 255])
    assert logged.values("observed").tolist() == [1, 1, 0, 1, 1, 1]
    std = run["belief", "var"][:, 2].sqrt()
    for name, wanted in {"mean": mean[:, 2], "low": mean[:, 2] - 1.645 * std, "truth": truth[:, 2]}.items():
        np.testing.assert_allclose(logged.values(f"components/z, m/{name}"), wanted, rtol=1e-5, atol=1e-6)


def test_a_stream_of_the_caller_and_three_coordinates(stand_in):
    stream = Recording()
    run = run_with_pixels().exclude("pixels", "observed", "state")
    assert log_rollout(run, dims=[0, 1, 2], recording=stream) is stream
    assert {"camera", "observed", "path/truth"}.isdisjoint(stream.entries)
    assert stream.entries["path/belief/now"][3][:2] == (3, None)
    np.testing.assert_allclose(stream.values("path/belief/now")[:, 0], run["belief", "mean"], rtol=1e-6)
    assert {f"components/state {dim}/mean" for dim in range(3)} <= set(stream.entries)
    with pytest.raises(ValueError, match="two or three coordinates"):
        log_rollout(run, dims=[0])


def test_reruns_own_file_reads_back(tmp_path):
    pytest.importorskip("rerun")
    chunk = pytest.importorskip("rerun.chunk")
    run = run_with_pixels()
    recording = log_rollout(run, time=0.5, file=tmp_path / "a.rrd")
    del recording
    tables = {}
    for part in chunk.RrdReader(str(tmp_path / "a.rrd")).stream().to_chunks():
        tables.setdefault(part.entity_path, []).append(part.to_record_batch())

    def column(entity, name):
        """The values of a component of an entity, by step."""
        rows = {}
        for table in tables[entity]:
            (key,) = [key for key in table.schema.names if key.endswith(name)]
            rows.update(zip(table.column("step").to_pylist(), table.column(key).to_pylist(), strict=True))
        return [rows[step] for step in sorted(rows)]

    ensemble = torch.nn.functional.pad(run["belief", "ensemble"][..., :2], (0, 1))
    np.testing.assert_allclose(column("/path/ensemble", "positions"), ensemble, rtol=1e-6)
    np.testing.assert_allclose(
        np.ravel(column("/components/state\\ 1/mean", "scalars")), run["belief", "mean"][:, 1], rtol=1e-6
    )
    assert len(column("/camera", "buffer")) == 6
