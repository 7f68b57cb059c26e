"""The arms: what each reads."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules import GRUModule, LSTMModule

MEMORY = 64  # units of an LSTM or a GRU


@dataclass(frozen=True)
class Arm:
    """What an arm reads.

    Attributes:
        keys: entries of the environment.
        stack: readings side by side.
        memory: ``"lstm"`` or ``"gru"``, or nothing.
        filter: ``"learned"`` from readings, ``"taught"`` with the simulator's states, ``"exact"``, or nothing.
        end_to_end: whether the loss of the actor trains the filter, too.
    """

    keys: tuple[NestedKey, ...]
    stack: int = 1
    memory: str = ""
    filter: str = ""
    end_to_end: bool = False


MEAN, VAR, ENSEMBLE = ("belief", "mean"), ("belief", "var"), ("belief", "ensemble")
ARMS = {
    "last reading": Arm(("seen",)),
    "four readings": Arm(("seen",), stack=4),
    "LSTM": Arm(("seen",), memory="lstm"),
    "GRU": Arm(("seen",), memory="gru"),
    "belief mean": Arm((MEAN,), filter="learned"),
    "belief mean, spread": Arm((MEAN, VAR), filter="learned"),
    "ensemble": Arm((ENSEMBLE,), filter="learned"),
    "belief mean, taught": Arm((MEAN,), filter="taught"),
    "belief mean, end to end": Arm((MEAN,), filter="learned", end_to_end=True),
    "Kalman": Arm((MEAN,), filter="exact"),
    "physics": Arm((MEAN,), filter="exact"),
    "truth": Arm(("state",)),
}


@dataclass(frozen=True)
class Inputs:
    """Sizes and units of what an arm's networks read and write.

    Attributes:
        seen: width of the entry, of arms that read it.
        actions: A.
        scale: what a state is divided by, ``[S]``.
        limit: of an action.
    """

    seen: int
    actions: int
    scale: Tensor
    limit: float


def memory(kind: str, width: int, name: str) -> TensorDictModuleBase:
    """An LSTM or a GRU of torchrl's on what is seen."""
    states = [f"{name}_hidden", f"{name}_cell"][: 2 if kind == "lstm" else 1]
    keys = {"in_keys": ["seen", *states], "out_keys": [f"{name}_memory", *(("next", key) for key in states)]}
    return {"lstm": LSTMModule, "gru": GRUModule}[kind](input_size=width, hidden_size=MEMORY, **keys)
