"""Scores of an ensemble by hand, and settings of the loss, for tests."""

import torch

TERMS = ["state", "transition", "sensor", "observation", "nll", "kl"]
ONLY_STATE = {"transition": 0.0, "sensor": 0.0}
# The loss and the oracle add the same numbers in another order.
CLOSE = {"rtol": 1e-12, "atol": 1e-13}


def pairs(x, distance):
    """Returns the mean distance of different members, by a double loop."""
    size = x.shape[-2]
    terms = [distance(x[..., i, :] - x[..., j, :]) for i in range(size) for j in range(size) if i != j]
    return sum(terms) / len(terms)


def score_by_hand(score, ensemble, truth):
    """Per element [*B, T]."""
    errors = ensemble - truth.unsqueeze(-2)
    if score == "mse":
        return errors.mean(-2).square().mean(-1)
    if score == "energy":
        norm = torch.linalg.vector_norm
        return norm(errors, dim=-1).mean(-1) - pairs(ensemble, lambda d: norm(d, dim=-1)) / 2
    return (errors.abs().mean(-2) - pairs(ensemble, torch.abs) / 2).mean(-1)
