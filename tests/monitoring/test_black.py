"""Black pictures are missing; dark ones, and those of one bright pixel, are not."""

import torch
from tensordict import TensorDict

from torch_denkf.monitoring import BlackIsMissing


def pictures():
    pixels = torch.zeros(3, 3, 4, 4)
    pixels[1, 0, 2, 2] = 0.3
    pixels[2] = 0.5
    return pixels


def test_black_pictures_are_missing_and_dark_ones_are_not():
    td = TensorDict({"pixels": pictures(), "observed": torch.tensor([[True], [True], [False]])}, [3])
    assert BlackIsMissing()(td)["seen"].squeeze(-1).tolist() == [False, True, False]
    whole = TensorDict({"pixels": (pictures() * 255).to(torch.uint8)}, [3])
    assert BlackIsMissing()(whole)["seen"].squeeze(-1).tolist() == [False, True, True]


def test_the_threshold_is_a_share_of_white_in_both_kinds_of_pictures():
    for level, seen in ((5, False), (6, True)):  # of 255: 2.0 and 2.4 %
        whole = torch.full((2, 3, 4, 4), level, dtype=torch.uint8)
        for pixels in (whole, whole / 255):
            assert BlackIsMissing(0.02)(TensorDict({"pixels": pixels}, [2]))["seen"].tolist() == [[seen]] * 2
    assert not BlackIsMissing(0.6)(TensorDict({"pixels": pictures()}, [3]))["seen"].any()
