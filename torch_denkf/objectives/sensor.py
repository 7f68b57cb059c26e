"""The training objective of a sensor and its noise model alone, on frames."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from typing import Literal, Unpack

from tensordict import NestedKey, TensorDictBase, unravel_key
from torchrl.modules.tensordict_module.rnn import set_recurrent_mode

from torch_denkf.filters import Filter
from torch_denkf.modules._call import Call
from torch_denkf.modules._gaussian import as_covariance
from torch_denkf.modules._running import reads, run_modules
from torch_denkf.objectives._options import ReadingsOptions
from torch_denkf.objectives._part import PartLoss
from torch_denkf.objectives._readings import ReadingsLoss
from torch_denkf.objectives._scores import MEMBER_SCORES, score_gaussian

__all__ = ["SensorLoss"]


class SensorLoss(PartLoss, ReadingsLoss):
    r"""Scores what a filter's sensor reads, without the filter, on any batch of frames ``[*B]``. Of two or
    more dimensions the last is time, for modules that tell times apart.

    Those modules are run that read frames alone and lead to what is scored: the sensor, and with ``noise`` its noise
    model. Other sensors of the filter, and their readings, need not be there.

    ========================  =====================================================================================
    ``loss_sensor``           score of the sensor's samples against the true observation, the term of that name in
                              :class:`~torch_denkf.objectives.DEnKFLoss`
    ``loss_noise``            negative log-likelihood of the true observation under N(mean of the samples, R), nats
    ========================  =====================================================================================

    Terms with weight zero are neither computed nor returned; the others are returned with their weight applied. Frames
    count where the sensor observed all and the true observation is known, see :class:`ReadingsOptions`. The parameters
    of the loss are those of the modules it runs.

    Args:
        filter: the filter whose sensor is trained.
        score: of the samples: ``"crps"`` (fair), ``"energy"`` (fair) or ``"mse"`` (of the mean). Of one sample the
            first two are its absolute error, and the length of its error: the scores of a point.
        sensor: weight of ``loss_sensor``.
        noise: weight of ``loss_noise``. R must follow from frames alone.
        **options: ``observation_scale``, ``observation_angles`` and ``reduction``, see :class:`ReadingsOptions`.

    Raises:
        ValueError: on an unknown score, a scale that is not positive, or labels of another shape.
        KeyError: if an entry that a term needs is missing.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import DEnKF
        >>> loss = SensorLoss(DEnKF.paper(5, 2, ensemble_size=4), noise=0.1)
        >>> frames = TensorDict({"pixels": torch.rand(3, 6, 50, 150), "target_observation": torch.randn(3, 2)}, [3])
        >>> sorted(loss(frames).keys())
        ['loss_noise', 'loss_sensor']
    """

    @dataclass
    class _AcceptedKeys(ReadingsLoss._AcceptedKeys):
        """The entries that the loss reads.

        Attributes:
            state: true state ``[*B, S]``, read where there is no true observation.
            state_observed: where it is known, ``[*B, 1]`` or ``[*B, S]``.
            target_observation: true observation ``[*B, O]``; where it is missing and the filter's observation model has
                no parameters, it is that model's observation of the true state.
            target_observed: where it is known, ``[*B, 1]`` or ``[*B, O]``.
            observed: mask of the reading, ``[*B, 1]`` or ``[*B, O]``.
            sensor: the sensor's samples ``[*B, E, O]`` or readings ``[*B, O]``.
            noise: R, variances ``[*B, O]`` or a covariance ``[*B, O, O]``.
        """

        noise: NestedKey = ("sensor", "noise")

    default_keys = _AcceptedKeys
    SCORES = MEMBER_SCORES

    def __init__(
        self,
        filter: Filter,
        *,
        score: Literal["crps", "energy", "mse"] = "crps",
        sensor: float = 1.0,
        noise: float = 0.0,
        **options: Unpack[ReadingsOptions],
    ):
        super().__init__(filter, {"sensor": sensor, "noise": noise}, score=score, **options)

    def _trained(self):
        return [module for _, module in self._placed()]

    def _placed(self):
        """The modules that read frames alone and lead to what is scored: the sensor, and R where its weight is set."""
        wanted = {unravel_key(self.tensor_keys.sensor)}
        wanted |= {unravel_key(self.tensor_keys.noise)} if "noise" in self.weights else set()
        placed = []
        for place, module in reversed(self.filter.structure.frames):
            if not wanted.isdisjoint(map(unravel_key, module.out_keys)):
                placed.append((place, module))
                wanted.update(key for keys in reads(module) for key in keys)
        return placed[::-1]

    def _needed(self) -> list[NestedKey]:
        """What the modules read, and the true observation, or the state that it follows from."""
        needed: list[NestedKey] = []
        made: set[NestedKey] = set()
        for _, module in self._placed():
            needed += [key for key in reads(module)[0] if key not in made and key not in needed]
            made.update(map(unravel_key, module.out_keys))
        model = self._observation_model()
        known = model is not None and not any(True for _ in model.parameters())
        return [*needed, self.tensor_keys.state if known else self.tensor_keys.target_observation]

    def _run(self, tensordict: TensorDictBase) -> TensorDictBase:
        size, out = tensordict.batch_size, tensordict.copy()
        call = Call(size, time=len(size) > 1)
        # As in Filter.sequence: a recurrent network among these modules reads whole sequences.
        with set_recurrent_mode(True) if call.time else nullcontext():
            written = run_modules(self._placed(), self.filter.entries_of(tensordict), call)
        for key, value in written.items():
            out.set(key, value)
        return out

    def _noise(self, tensordict, out):
        samples, labels = self._samples(tensordict, out)
        noise = self._entry(out, self.tensor_keys.noise, "R must follow from frames alone. ")
        error = labels.errors(samples, self.observation_angles).mean(-2)
        return score_gaussian(error, labels.mask, as_covariance(noise, error), "nll", labels.scale), labels.rows
