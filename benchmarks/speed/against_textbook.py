"""A step over a sequence against the plain torch step, forward, and forward and backward."""

from __future__ import annotations

from collections.abc import Callable

import torch

from benchmarks.speed.ours import sequences
from benchmarks.speed.pairs import Row, against
from benchmarks.speed.textbook import Textbook
from benchmarks.speed.workload import STEPS, make_filter, make_frames, start

NOTE = "same networks, sensor's samples and update; ours also writes variance, innovation, NIS and likelihood"
LIMITS = {(1, False): (0.5, 0.35), (64, False): (0.55, 0.4), (1, True): (0.75, 0.6), (64, True): (0.75, 0.6)}


def textbook(batch: int, backward: bool) -> Callable[[], object]:
    """Returns the plain step over a sequence."""
    filter = make_filter()
    plain, ensemble = Textbook.of(filter), start(filter, batch)
    samples = make_frames(batch, STEPS).get(("sensor", "ensemble"))
    parameters = list(plain.parameters())

    def call() -> object:
        with torch.set_grad_enabled(backward):
            mean = plain.sequence(ensemble, samples)[1]
        if backward:
            torch.autograd.grad(mean.square().sum(), parameters)
        return mean

    return call


def rows(seconds: float) -> list[Row]:
    out = []
    for (batch, backward), (target, aim) in LIMITS.items():
        ours = sequences(batch, backward=backward)
        title = f"sequence / textbook torch, {'forward and backward, ' * backward}B={batch}"
        fields = {"per": STEPS, "target": target, "aim": aim, "note": NOTE}
        out += against(ours, "textbook", textbook(batch, backward), title, how={"seconds": seconds}, **fields)
    return out
