"""How far simple filters get on a sensor's readings: what is left for any filter that is not told where the arm goes.

Three kinds, for each of the table's ten numbers by itself. A regression on the last readings knows no motion at all. A
recurrent network remembers all readings of a demo, and is not linear: it may tell a joint that stands still from one
that moves. A Kalman filter carries the number, its rate, its acceleration if wanted, and the sensor's slow errors
(:class:`~torch_denkf.imperfect.FadingBias`); noise, damping, size and time of the errors are fitted. All are fitted on
the demos that train the filters; nothing here sees a picture.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from benchmarks.common.tables import head, line, write_page
from benchmarks.ur5.demos import JOINTS, STATE
from benchmarks.ur5.evaluation import errors
from benchmarks.ur5.memory import UPDATES as MEMORY_UPDATES
from benchmarks.ur5.memory import Memory
from benchmarks.ur5.readings import read_all
from benchmarks.ur5.recipes._base import INITIAL
from benchmarks.ur5.sensors import MEMBERS, WRIST, Preset
from benchmarks.ur5.study import Base, Study
from torch_denkf.functional import crps_gaussian, kalman_predict, kalman_update
from torch_denkf.imperfect import FadingBias

LAGS = (1, 10, 30)  # readings that a regression sees
KINDS = ((2, 0), (2, 1), (3, 1), (3, 2))  # 2: rates, 3: accelerations, too; and how many biases
TIMES = {1: (20.0,), 2: (3.0, 30.0)}  # steps in which biases fade, before fitting
UPDATES, LENGTH, BLIND, BATCH = 120, 100, 20, 48  # fitting; the first steps of a window do not count


class LinearFilter(nn.Module):
    """A Kalman filter for each of D numbers, with rates that are damped or accelerations that are, and biases.

    Args:
        order: 2 or 3: whether accelerations are states.
        biases: of each number.
        error: root mean square error of the readings ``[D]``.
        change: root mean square of the number's second or third difference ``[D]``, as ``order`` has it.
    """

    def __init__(self, order: int, biases: int, error: Tensor, change: Tensor):
        super().__init__()
        self.order, self.biases = order, biases
        self.damping = nn.Parameter(torch.tensor([4.0, 1.5])[: order - 1].repeat(len(error), 1))
        self.log_noise, self.log_reading = nn.Parameter(change.log()), nn.Parameter((0.4 * error).log())
        if biases:
            std = (0.8 * error / biases**0.5).unsqueeze(-1).expand(-1, biases)
            self.bias = FadingBias(std.flatten(), torch.tensor(TIMES[biases]).repeat(len(error)))

    def matrices(self) -> tuple[Tensor, Tensor]:
        """F and Q of all numbers, ``[D, S, S]``."""
        size, order = self.order + self.biases, self.order
        damping = self.damping.sigmoid()
        row = torch.zeros(*damping.shape[:1], size)
        change = row.clone()  # of the number in a step: what is left of its rate, and of its acceleration
        change[:, 1:order] = damping
        unit = torch.eye(size)
        rows = [unit[0] + change, change]
        if order == 3:
            rows.append(damping[:, 1:] * unit[2])
        drive = (torch.arange(size) < order).to(row)
        noise = (2 * self.log_noise).exp()[:, None, None] * drive.outer(drive)
        if self.biases:
            decay, variance = (value.view(-1, self.biases) for value in (self.bias.decay, self.bias.variance))
            rows += [decay[:, n : n + 1] * unit[order + n] for n in range(self.biases)]
            noise = noise + nn.functional.pad(variance, (order, 0)).diag_embed()
        return torch.stack([value.expand_as(row) for value in rows], -2), noise

    def forward(self, readings: Tensor, start: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
        """Means and variances ``[N, T - 1, D]`` of readings ``[N, T, D]``, from ``start`` ``[N, D]``, ``[D]``."""
        move, noise = (part.expand(len(start), -1, -1, -1) for part in self.matrices())
        size = move.shape[-1]
        mean = nn.functional.pad(start.unsqueeze(-1), (0, size - 1))
        variance = nn.functional.pad(std.square().unsqueeze(-1), (0, size - 1))
        if self.biases:
            own = self.bias.std.square().view(-1, self.biases)
            variance = variance + nn.functional.pad(own, (self.order, 0))
        cov = variance.diag_embed().expand(*mean.shape, size)
        read = torch.ones(1, size, dtype=mean.dtype)
        read[:, 1 : self.order] = 0.0
        white = (2 * self.log_reading).exp().unsqueeze(-1).expand(*mean.shape[:-1], 1)
        means, variances = [], []
        for reading in readings.unbind(1)[1:]:
            mean, cov = kalman_predict(mean, cov, move, noise)
            mean, cov, *_ = kalman_update(mean, cov, reading.unsqueeze(-1), read, white)
            means.append(mean[..., 0]), variances.append(cov[..., 0, 0])
        return torch.stack(means, 1), torch.stack(variances, 1)


def fit(order: int, biases: int, readings: Tensor, truth: Tensor, *, updates: int = UPDATES) -> LinearFilter:
    """Fits Kalman filters to demos ``[N, T, D]`` by the CRPS of windows that begin as wrong as readings are."""
    error = (readings - truth).square().mean((0, 1)).sqrt()
    change = truth.diff(dim=1, n=order).square().mean((0, 1)).sqrt()
    filter = LinearFilter(order, biases, error, change)
    optimiser = torch.optim.Adam(filter.parameters(), lr=0.05)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates, 0.002)
    generator, length = torch.Generator().manual_seed(0), min(LENGTH, truth.shape[1])
    for _ in range(updates):
        rows = torch.randint(len(truth), (BATCH,), generator=generator)
        first = int(torch.randint(truth.shape[1] - length + 1, (), generator=generator))
        seen, true = readings[rows, first : first + length], truth[rows, first : first + length]
        start = true[:, 0] + error * torch.randn(true[:, 0].shape, generator=generator)
        mean, variance = (part[:, BLIND:] for part in filter(seen, start, error))
        loss = (crps_gaussian(mean, variance.clamp_min(1e-12), true[:, BLIND + 1 :]) / error).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return filter


def regress(tune: tuple[Tensor, Tensor], readings: Tensor, lags: int, ridge: float = 1e-3) -> Tensor:
    """What a ridge regression on the last ``lags`` readings of a number says of it, ``[N, T, D]``.

    Args:
        tune: readings and truth ``[M, T, D]`` to fit on.
        readings: to apply it to.
        lags: a demo's first reading stands for those before it.
        ridge: penalty, in units of the readings' variance.
    """

    def design(values: Tensor) -> Tensor:
        held = torch.cat([values[:, :1].expand(-1, lags - 1, -1), values], 1).unfold(1, lags, 1)
        return torch.cat([held, torch.ones_like(held[..., :1])], -1).double()

    loc, scale = (part(tune[0].flatten(0, 1), 0) for part in (torch.mean, torch.std))
    before, after = design((tune[0] - loc) / scale), design((readings - loc) / scale)
    said = []
    for number in range(readings.shape[-1]):
        x, y = before[..., number, :].flatten(0, 1), tune[1][..., number].flatten().double()
        penalty = ridge * len(x) * torch.eye(lags + 1, dtype=torch.double)
        said.append(after[..., number, :] @ torch.linalg.solve(x.mT @ x + penalty, x.mT @ y))
    return torch.stack(said, -1).float()


def limits(
    tune: tuple[Tensor, Tensor],
    test: tuple[Tensor, Tensor],
    *,
    updates: int = UPDATES,
    remembering: int = MEMORY_UPDATES,
) -> list[dict]:
    """Errors of readings and of all three kinds on ``test``, fitted on ``tune``; both readings and truth."""
    readings, truth = test
    std = INITIAL * tune[1].flatten(0, 1).std(0)
    rows = [{"method": "the readings", **errors(readings, truth)}]
    for lags in LAGS:
        rows.append({"method": f"regression on {lags}", **errors(regress(tune, readings, lags), truth)})
    memory = Memory(*tune, updates=remembering)
    with torch.no_grad():
        rows.append({"method": "GRU on all so far", **errors(memory(readings, truth[:, 0]), truth)})
    for order, biases in KINDS:
        filter = fit(order, biases, *tune, updates=updates)
        with torch.no_grad():
            mean, _ = filter(readings, truth[:, 0], std)
        name = f"Kalman filter, {'accelerations' if order == 3 else 'rates'}, {biases} biases"
        rows.append({"method": name, **errors(torch.cat([truth[:, :1], mean], 1), truth)})
    return rows


def page(studied: dict[str, tuple[list[dict], Tensor]]) -> str:
    """Markdown of the rows of each sensor, and how far its readings follow the truth ``[10]``."""
    lines = ["# How far simple filters get on the sensors' readings", ""]
    lines += ["Test demos, clean. Each of the ten numbers by itself; fitted on the demos that train the filters.", ""]
    for sensor, (rows, slopes) in studied.items():
        lines += [f"**{sensor}**", "", *head("", "joints deg", "end effector cm", "J1 to J7")]
        for row in rows:
            joints = ", ".join(f"{row[f'J{number + 1}_deg']:.1f}" for number in range(JOINTS))
            lines.append(line(row["method"], f"{row['joint_mae_deg']:.2f}", f"{row['ee_mae_cm']:.3f}", joints))
        told = ", ".join(f"{value:.2f}" for value in slopes)
        lines += ["", f"A reading moves by so much where J1 to J7, x, y, z move by one: {told}.", ""]
    return "\n".join(lines)


def slopes(readings: Tensor, truth: Tensor) -> Tensor:
    """Regression coefficients of readings on the truth ``[D]``: 1 for a sensor that follows, 0 if it does not."""
    centred = truth - truth.mean((0, 1))
    return (centred * (readings - readings.mean((0, 1)))).sum((0, 1)) / centred.square().sum((0, 1))


def run(study: Study) -> list[Path]:
    """Leaves ``limits.md`` in ``--out``, of all trained sensors of the simulator."""
    studied = {}
    for kind in study.sensors:
        base = Base(study, kind, "sim", study.seeds[0])
        tune, test = (_read(base, role) for role in ("tune", "test"))
        few = {"updates": 2, "remembering": 2} if study.smoke else {}
        studied[kind] = limits(tune, test, **few), slopes(*tune)
    file = study.out / "limits.md"
    write_page(page(studied), file)
    return [file]


def _read(base: Base, role: str) -> tuple[Tensor, Tensor]:
    """Readings and truth ``[N, T, 10]``; J6 on the truth's turn."""
    reading = read_all(base.sensor, base.codes(role), MEMBERS)
    return means(base.preset, reading["sensor", "ensemble"], reading["state"]), reading["state"]


def means(preset: Preset, samples: Tensor, truth: Tensor) -> Tensor:
    """States ``[N, T, 10]`` that the means of samples say; of J6 half a turn apart that next to the truth."""
    return preset.state_of(samples.mean(-2), truth[..., WRIST])[..., :STATE]
