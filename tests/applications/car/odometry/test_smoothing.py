"""A car's filter looks back: its analysis sees more than the state, and tells the pose nothing."""

import torch
from tensordict import TensorDict

from torch_denkf.applications.car.odometry.filter import car_filter
from torch_denkf.smoothers import FixedLag

LAG = 3


def test_cloned_velocities_are_corrected_and_the_cloned_pose_is_not():
    car, batch = car_filter(), [2, 9]
    members, features = car.settings.ensemble_size, car.sensor.encoding_features
    sensor = {"ensemble": torch.tensor([9.0, 0.02]) + 0.2 * torch.randn(*batch, members, 2)}
    sensor["encoding"] = torch.randn(*batch, features)
    frames = TensorDict({"sensor": sensor, "start": torch.tensor([0.0, 0.0, 0.0, 8.0, 0.0]).expand(*batch, 5)}, batch)
    frames["observed"], frames["steps"] = torch.ones(*batch, 1, dtype=torch.bool), torch.ones(*batch, 1).long()
    with torch.no_grad():
        out = FixedLag(car.without_sensor(), LAG).sequence(frames)
    now, then = out["belief"][:, : -LAG - 1], out["smoothed"][:, LAG:-1]
    assert (out["smoothed", "age"][:, LAG:] == LAG).all()
    assert now["mean"][..., :3].equal(then["mean"][..., :3])
    assert then["var"][:, 1:, 3].mean() < now["var"][:, 1:, 3].mean()
    assert not torch.allclose(then["mean"][:, 1:, 4], now["mean"][:, 1:, 4])
