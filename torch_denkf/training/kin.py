"""Transfer of weights between filters with the same sub-models."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_denkf.filters import Filter
from torch_denkf.submodel import SubModel

__all__ = ["take_weights"]


def take_weights(filter: Filter, source: Filter) -> list[str]:
    """Copies trained weights into a filter with the same sub-models, but another kind, delay or number of members.

    A sub-model takes the weights of the one with the same class, names and shapes; among several, of the one in the
    same place, or with the same position in their order. Sub-models without parameters, such as a prior, do not change.

    Args:
        filter: changed in place.
        source: the trained filter.

    Returns:
        the names of the parameters in ``filter`` that were not replaced.

    Raises:
        ValueError: if no sub-model matches, or the match of a sub-model is ambiguous.

    Example:
        >>> from torch_denkf import DEnKF, EKF
        >>> from torch_denkf.modules import ConstantNoise, GaussianPrior, LearnedTransition, MomentPrior, Select
        >>> net, other = nn.Linear(2, 2), nn.Linear(2, 2)
        >>> rest = None, Select([0]), ConstantNoise([0.1], in_key="y")
        >>> start = GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=8)
        >>> trained = DEnKF(LearnedTransition(net), *rest, initial=start, observation_key="y")
        >>> start = MomentPrior(torch.zeros(2), torch.eye(2))
        >>> ekf = EKF(LearnedTransition(other), *rest, initial=start, process_noise=0.1, observation_key="y")
        >>> take_weights(ekf, trained)
        []
        >>> other.weight.equal(net.weight)
        True
    """
    theirs: dict[tuple, list[tuple[str, dict[str, Tensor]]]] = {}
    for place, kind, state in _learned(source):
        theirs.setdefault(kind, []).append((place, state))
    ours: dict[tuple, list[tuple[str, dict[str, Tensor]]]] = {}
    for place, kind, state in _learned(filter):
        ours.setdefault(kind, []).append((place, state))
    moved: set[int] = set()
    for kind, found in ours.items():
        given = theirs.get(kind, [])
        by_place = dict(given)
        for number, (place, state) in enumerate(found):
            if place not in by_place and given and len(given) != len(found):
                raise ValueError(
                    f"{kind[0]} at {place!r} could take the weights of any of {[name for name, _ in given]}: give it "
                    "the place of one of them, or copy its state_dict."
                )
            if given:
                taken = by_place.get(place) or given[number][1]
                with torch.no_grad():
                    for name, value in state.items():
                        value.copy_(taken[name])
                moved.update(map(id, state.values()))
    if not moved:
        raise ValueError(
            f"No sub-model of {type(filter).__name__} has class and shapes of one of {type(source).__name__}: it has "
            f"{sorted({kind[0] for kind in ours})}, the other {sorted({kind[0] for kind in theirs})}."
        )
    return [name for name, value in filter.named_parameters() if id(value) not in moved]


def _learned(filter: Filter) -> list[tuple[str, tuple, dict[str, Tensor]]]:
    """Returns place, kind and tensors of each sub-model with parameters, without those of nested sub-models."""
    found = []
    for path, module in filter.named_modules():
        if not isinstance(module, SubModel):
            continue
        inside = [name + "." for name, part in module.named_modules() if name and isinstance(part, SubModel)]
        values = {**dict(module.named_parameters()), **dict(module.named_buffers())}
        own = {name: value for name, value in values.items() if not name.startswith(tuple(inside))}
        if any(isinstance(value, nn.Parameter) for value in own.values()):
            shapes = tuple((name, tuple(value.shape)) for name, value in sorted(own.items()))
            found.append((path.removeprefix("module.").split(".")[0], (type(module).__name__, shapes), own))
    return found
