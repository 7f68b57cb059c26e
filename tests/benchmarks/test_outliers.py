import pytest
import torch

from benchmarks.outliers.filters import UPDATES, known
from benchmarks.outliers.study import score, scores
from benchmarks.outliers.task import SHARE, best, moved, recordings


def test_the_cart_sticks_and_slides():
    states = torch.tensor([[1.0, 0.04, 1.1], [1.0, 0.04, 1.3], [0.0, 2.0, 1.0]])
    expected = [[1.0, 0.0], [1 + 0.05 * (0.04 + 0.05 * 0.496), 0.04 + 0.05 * 0.496], [0.05 * 2.0, 2.0]]
    torch.testing.assert_close(moved(states), torch.tensor(expected))


def test_one_reading_in_five_is_wrong():
    data = recordings(500, 3)
    wrong, error = data["wrong"], data["reading"] - data["state"][..., :1]
    assert wrong.float().mean().item() == pytest.approx(0.2, abs=0.01)
    assert error[wrong].std().item() == pytest.approx(2, rel=0.05)
    assert (error[~wrong] / (0.02 + 0.05 * data["state"][..., :1][~wrong].abs())).std().item() == pytest.approx(
        1, rel=0.05
    )


def test_contaminated_update_is_near_the_optimum():
    data = recordings(12, 5)
    truth = scores(*best(data, 2000).values())
    assert 0.8 < truth["held"] < 0.97
    told = data.clone().set("sound", torch.full((*data.shape, 1), 1 - SHARE))
    found = {name: score(around(known("DEnKF")), told, 0) for name, around in UPDATES.items()}
    for contaminated in [found[name] for name in found if "gence" in name or "width" in name]:
        assert all(contaminated[name] < 1.4 * truth[name] for name in ("rmse_x", "rmse_v", "crps_x", "crps_v"))
        assert contaminated["held"] > 0.85
        assert contaminated["rmse_x"] < min(found["plain"]["rmse_x"], found['gate, "student"']["rmse_x"]) / 2
