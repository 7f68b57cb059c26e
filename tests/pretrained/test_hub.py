"""Filters with the methods of huggingface_hub's mixin, in folders; the Hub itself is not asked."""

from importlib.util import find_spec

import pytest
import torch

from torch_denkf.applications.reacher import reacher
from torch_denkf.filters import KalmanFilter
from torch_denkf.pretrained import from_pretrained
from torch_denkf.pretrained.hub import HubFilter

INSTALLED = find_spec("huggingface_hub") is not None


def still(size):
    eye = torch.eye(size)
    return KalmanFilter(eye, eye, process_noise_cov=eye, noise_cov=eye, mean=torch.zeros(size), cov=eye)


@pytest.mark.skipif(INSTALLED, reason="huggingface_hub is installed")
def test_without_the_hub_it_says_what_to_install(tmp_path):
    with pytest.raises(ImportError, match="needs huggingface_hub: pip install"):
        HubFilter(still(2))
    with pytest.raises(ImportError, match="needs huggingface_hub: pip install"):
        HubFilter.from_pretrained(tmp_path)


@pytest.mark.skipif(not INSTALLED, reason="pip install 'torch_denkf[hub]'")
def test_a_folder_of_the_mixin_is_one_of_the_library(tmp_path):
    model = reacher(ensemble_size=8)
    HubFilter(model, card="# My filter").save_pretrained(tmp_path / "reacher")
    for read in (HubFilter.from_pretrained(tmp_path / "reacher").filter, from_pretrained(tmp_path / "reacher")):
        assert read.settings == model.settings
        assert all(value.equal(model.state_dict()[name]) for name, value in read.state_dict().items())
    assert (tmp_path / "reacher/card.md").read_text() == "# My filter"


@pytest.mark.skipif(not INSTALLED, reason="pip install 'torch_denkf[hub]'")
def test_a_filter_of_ones_own_keeps_its_builder(tmp_path):
    HubFilter(still(2), builder=still, settings={"size": 2}).save_pretrained(tmp_path / "a")
    again = HubFilter.from_pretrained(tmp_path / "a", builders={"still": still})
    again.save_pretrained(tmp_path / "b")
    assert from_pretrained(tmp_path / "b", builders={"still": still}).carry_keys == still(2).carry_keys
