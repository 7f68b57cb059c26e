"""What the sub-models share: their own forward, clear errors, and noise that may come in as a tensor."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModule
from torch import nn

__all__ = ["SubModel"]


class SubModel(TensorDictModule):
    """A :class:`~tensordict.nn.TensorDictModule` that reads, computes and writes in its own ``forward``.

    A plain ``TensorDictModule`` costs about 40 us a call in tensordict 0.14, a subclass with its own forward
    about 5 us, which matters where a whole filter step takes 400 us.

    Sub-classes read with :meth:`read`, so that a missing entry names itself, and list what they can do without
    in ``optional_keys``. A sub-model that draws random numbers gives its ``noise_key`` and draws with
    :meth:`draw_noise`; when the tensordict holds ``noise_key``, that noise is used instead of fresh one. This is
    what makes a step equal a sequence, and lets a filter draw the noise of a whole sequence at once.

    A sub-class whose ``forward`` uses nothing of its tensordict but ``get``, ``set``, ``batch_size``, ``ndim`` and
    ``device`` says ``runs_on_rows = True`` beside that ``forward``: a filter then spares it the TensorDict.

    Args:
        network: the module that holds the parameters.
        in_keys: entries that must be there.
        out_keys: entries that are written.
        optional_keys: entries that are used when they are there.
        noise_key: entry that holds the noise, if the sub-model is stochastic.
    """

    def __init__(
        self,
        network: nn.Module,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
        *,
        optional_keys: Sequence[NestedKey] = (),
        noise_key: NestedKey | None = None,
    ):
        super().__init__(network, in_keys=list(in_keys), out_keys=list(out_keys))
        self.optional_keys = [unravel_key(key) for key in optional_keys]
        self.noise_key = None if noise_key is None else unravel_key(noise_key)

    runs_on_rows = False

    # Unlike TensorDictModule, show no attributes of the network: its "loc" or "scale" would hide our buffers.
    __getattr__ = nn.Module.__getattr__

    def read(self, tensordict: TensorDictBase, key: NestedKey) -> torch.Tensor:
        """Returns the entry ``key``.

        Raises:
            KeyError: if it is missing; the message names it and lists what is there.
        """
        value = tensordict.get(key, None)
        if value is None:
            present = sorted(str(name) for name in tensordict.keys(True, True))
            raise KeyError(
                f"{type(self).__name__} reads {key!r}, which the tensordict lacks. It holds {', '.join(present)}. "
                f"Rename the key in the constructor of {type(self).__name__}, or put the module that writes it "
                "in front."
            )
        return value

    def read_noise(self, tensordict: TensorDictBase) -> torch.Tensor | TensorDictBase | None:
        """Returns the noise that the tensordict brings, or ``None`` where fresh noise is to be drawn."""
        return None if self.noise_key is None else tensordict.get(self.noise_key, None)

    def draw_noise(
        self,
        batch_size: Sequence[int],
        *,
        device: torch.device | None = None,
        dtype: torch.dtype | None = None,
        generator: torch.Generator | None = None,
    ) -> torch.Tensor | TensorDictBase | None:
        """Draws the noise of one call on ``batch_size`` elements; ``None`` for a deterministic sub-model."""
        return None
