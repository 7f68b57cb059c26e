"""A small system, its filter in three stages, and a training of it that can be made to kill itself anywhere."""

import os
import signal

import torch
from tensordict import TensorDict

from tests.filters.factories import OBS, A, M, S, toy_denkf
from torch_denkf.functional import crps_ensemble
from torch_denkf.objectives import DEnKFLoss
from torch_denkf.training import FilterTrainer, Stage
from torch_denkf.training.logs import RunLogs


def drives(count, steps, seed):
    """Returns states that drift with the action, measurements that mix them, ``[count, steps]``."""
    generator = torch.Generator().manual_seed(seed)
    action = torch.randn(count, steps, A, generator=generator)
    drift = torch.cat([action, action.sum(-1, keepdim=True)], -1)
    state = 0.3 * torch.cat([torch.zeros(count, 1, S), drift[:, :-1]], 1).cumsum(1)
    mixing = torch.randn(S, M, generator=generator)
    noise = torch.randn(count, steps, M, generator=generator)
    entries = {"action": action, "state": state, "measurement": state @ mixing + 0.1 * noise}
    return TensorDict({**entries, "target_observation": state[..., :OBS]}, [count, steps])


class Killer:
    """Kills its own process, as ``kill -9`` does, the ``count``-th time that ``at(place)`` is called."""

    def __init__(self, place=None, count=0):
        self.place, self.left = place, count

    def at(self, place):
        if place == self.place:
            self.left -= 1
            if self.left == 0:
                os.kill(os.getpid(), signal.SIGKILL)


STAGES = ("sensor", "filter", "end_to_end")


def make_trainer(out, *, kill=(), noise_in_batch=False, updates=5, stages=STAGES, **kwargs):
    """Sensor alone, then the rest with the sensor frozen, then all of it on sequences that grow."""
    torch.manual_seed(0)
    denkf = toy_denkf()
    killer = Killer(*kill)
    training, held_out = drives(16, 8, seed=1), drives(4, 8, seed=2)

    def sample(generator, length):
        killer.at("sample")
        rows = torch.randint(len(training), (6,), generator=generator)
        batch = training[rows, : length or 3]
        return denkf.draw_noise(batch, generator=generator) if noise_in_batch else batch

    def sensor_loss(batch):
        samples = denkf["sensor"](batch.copy())["sensor", "ensemble"]
        return {"loss_sensor": crps_ensemble(samples, batch["target_observation"]).mean()}

    whole, evaluate = DEnKFLoss(denkf), DEnKFLoss(denkf, score="mse", sensor=0.0, transition=0.0)

    def validate():
        killer.at("validate")
        return {"mse": evaluate(held_out)["loss_state"].item(), "noise": torch.rand(()).item()}

    sensor = list(denkf["sensor"].parameters())
    rest = [p for p in denkf.parameters() if not any(p is q for q in sensor)]
    made = [
        Stage("sensor", sensor_loss, sample, updates, sensor),
        Stage("filter", DEnKFLoss(denkf, sensor=0.0), sample, updates, rest, schedule="cosine"),
        Stage("end_to_end", whole, sample, updates, lengths={0: 2, 2: 4, 4: 6}, clip=None, weight_decay=0.1),
    ]
    defaults = {"validate_every": 2, "save_every": 3, "log_every": 2, "device": "cpu", "monitor": "mse"}
    made = [stage for stage in made if stage.name in stages]
    trainer = FilterTrainer(denkf, made, out=out, validate=validate, **{**defaults, **kwargs})
    _watch(killer)
    return trainer


def _watch(killer):
    """Lets the killer strike around the replacing of a checkpoint and after a log entry."""
    if killer.place is None:
        return
    replace, log = os.replace, RunLogs.log

    def watched_replace(source, target):
        killer.at("before replace")
        replace(source, target)
        killer.at("after replace")

    def watched_log(self, values, step):
        log(self, values, step)
        killer.at("log")

    os.replace, RunLogs.log = watched_replace, watched_log
