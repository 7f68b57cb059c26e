"""A filter in a control loop on one page: a cart, an encoder with dropout, irregular time steps.

    python examples/online_loop.py

No environment, no data set and no training: the motion is known. The loop calls the filter's ``step`` if a reading
has arrived, ``predict`` if none has, and ``step`` with ``without=`` for a silent sensor. The length of each step is
read from the clock. It takes a few seconds. The documentation is in ``docs/how_to/online_loop.md``; other robots are in
``examples/kitti.py``, ``ur5.py``, ``lerobot.py`` and ``own_recordings.py``.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor, nn

from torch_denkf import Filter
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, GaussianPrior, Select, Transition

PUSH = 0.8  # m/s, random walk of the speed: its standard deviation after a second


class Coasting(Transition):
    """Motion of a cart [position m, speed m/s] whose speed is a random walk, over steps of any length."""

    def __init__(self):
        super().__init__(nn.Identity(), [("belief", "ensemble"), "seconds"], [("forecast", "ensemble")])

    def compute(self, state: Tensor, seconds: Tensor) -> Tensor:  # [*B, E, 2], [*B, 1]
        dt = seconds.unsqueeze(-2)
        position, speed = state.split(1, -1)
        faster = speed + PUSH * dt.sqrt() * torch.randn_like(speed)
        return torch.cat([position + dt * (speed + faster) / 2, faster], -1)


def make_filter(members: int = 200) -> Filter:
    """Returns a filter of two sensors, each with its own noise and analysis: a position in m and a speed in m/s."""
    return Filter(
        {
            "transition": Coasting(),
            "encoder_noise": ConstantNoise([0.05], in_key="encoder", out_key="encoder_noise"),
            "h_encoder": Select([0], out_key="encoder_predicted"),
            "by_encoder": EnsembleAnalysis(
                "etkf",
                predicted_key="encoder_predicted",
                observation_key="encoder",
                noise_variance_key="encoder_noise",
                belief_prefix="middle",
            ),
            "radar_noise": ConstantNoise([0.3], in_key="radar", out_key="radar_noise"),
            "h_radar": Select([1], in_key=("middle", "ensemble"), out_key="radar_predicted"),
            "by_radar": EnsembleAnalysis(
                "etkf",
                forecast_key=("middle", "ensemble"),
                predicted_key="radar_predicted",
                observation_key="radar",
                noise_variance_key="radar_noise",
            ),
        },
        initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=members),
    )


class Cart:
    """Simulates the hardware: the true cart, its clock, and its readings."""

    def __init__(self):
        self.time, self.state = 0.0, torch.tensor([0.5, 1.0])

    def read(self) -> tuple[float, dict[str, list[float]]]:
        """Returns the seconds since the last call, and the readings; the encoder has a dropout from 6 to 9 s."""
        dt = 0.1 * (0.5 + torch.rand(()).item())
        speed = self.state[1] + PUSH * dt**0.5 * torch.randn(())
        self.state = torch.stack([self.state[0] + dt * (self.state[1] + speed) / 2, speed])
        self.time += dt
        readings = {}
        if not 6.0 < self.time < 9.0 and torch.rand(()) > 0.2:
            readings["encoder"] = [self.state[0].item() + 0.05 * torch.randn(()).item()]
        if torch.rand(()) > 0.5 and self.time < 8.0:
            readings["radar"] = [self.state[1].item() + 0.3 * torch.randn(()).item()]
        return dt, readings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0, help="of the cart's clock")
    parser.add_argument("--smoke", action="store_true", help="a tiny run of everything")
    args = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)

    denkf, cart = make_filter(), Cart()
    sensors = ["encoder", "radar"]
    inside, steps, shown = torch.zeros(2), 0, 0.0
    print("time    true position, speed    estimated position, 90 %    speed, 90 %             readings")
    with torch.no_grad():  # otherwise a graph grows with every step
        belief = denkf.initialise({})
        while cart.time < (2.0 if args.smoke else args.seconds):
            dt, readings = cart.read()
            belief = belief.update({"seconds": [dt], **readings})
            silent = [name for name in sensors if name not in readings]
            if len(silent) == len(sensors):
                belief = denkf.predict(belief)
            else:
                belief = denkf.step(belief, without=silent)  # otherwise its last reading would be used again
            mean, half = belief["belief", "mean"], 1.645 * belief["belief", "var"].sqrt()
            inside, steps = inside + ((mean - cart.state).abs() < half), steps + 1
            if cart.time >= shown:
                shown += 1.0
                true, bands = cart.state.tolist(), zip(mean.tolist(), half.tolist(), strict=True)
                position, speed = (f"{m:6.2f} [{m - h:6.2f}, {m + h:6.2f}]" for m, h in bands)
                text = f"{true[0]:6.2f} m  {true[1]:5.2f} m/s     {position} m   {speed} m/s"
                print(f"{cart.time:4.1f} s  {text}   {' '.join(readings) or 'none'}")
    holds = (100 * inside / steps).tolist()
    print(f"{steps} steps; 90 % coverage: position {holds[0]:.0f} %, speed {holds[1]:.0f} %")


if __name__ == "__main__":
    main()
