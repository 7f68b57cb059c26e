"""Fixtures of objective tests: frames with true states, weights of one term, a mask of scored rows, and training."""

import torch

from tests.filters.factories import OBS, S, toy_frames


def problem(filter, batch=(2, 7), **kwargs):
    """Returns frames with noise, true states and true observations, and what the filter makes of them."""
    frames = filter.draw_noise(toy_frames(batch, **kwargs))
    frames["state"], frames["target_observation"] = torch.randn(*batch, S), torch.randn(*batch, OBS)
    return frames, filter.sequence(frames.copy())


def only(terms, name, weight=1.0):
    """Returns weights that are zero for all other terms."""
    return {term: weight * (term == name) for term in terms}


def stepped(frames):
    """Returns a mask of elements that a step has led to."""
    mask = ~frames["is_init"].squeeze(-1)
    mask[..., 0] = False
    return mask
