"""The program that trained the UR5 table's filter runs, leaves a folder that loads, and scores both."""

import pytest

from tests.envs.opengl import needs_opengl
from torch_denkf import from_pretrained
from torch_denkf.applications.ur5.train import evaluate_ur5_table, train_ur5_table, whole_demos


@pytest.mark.slow
def test_ur5_table(tmp_path):
    needs_opengl()
    few = {"demos": 12, "sequences": 10, "sensor_updates": 2, "filter_updates": 2, "progress": False}
    model = train_ur5_table(tmp_path, seed=1, **few)
    demos, cache = whole_demos(tmp_path, 10, progress=False), tmp_path / "cache"
    mine, loaded = (
        evaluate_ur5_table(each, demos, missing=0.3, cache=cache, progress=False)
        for each in (model, from_pretrained(tmp_path))
    )
    assert mine == loaded
    shipped = from_pretrained("ur5-table")
    assert model["analysis"].significance == shipped["analysis"].significance == 1.0
    trained = evaluate_ur5_table(shipped, demos, cache=cache, progress=False)
    assert trained["filter"]["joints, deg"] < 1.2
    assert trained["filter"]["joints, deg"] < trained["last targets"]["joints, deg"]
    assert trained["filter"]["tool, cm"] < trained["sensor"]["tool, cm"]
