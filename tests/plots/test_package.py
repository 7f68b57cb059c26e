"""Tests the error where an extra is missing, and that pyplot is left alone."""

import sys

import pytest
import torch

import torch_denkf.plots as plots


def test_missing_dependency_is_named_with_its_extra(monkeypatch, tmp_path):
    walk = torch.randn(5, 2)
    for module, extra, call in (
        ("matplotlib.figure", "plots", lambda: plots.plot_path(walk)),
        ("PIL", "plots", lambda: plots.write_video(tmp_path / "a.gif", [torch.zeros(8, 8)], 5)),
    ):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, module, None)
            with pytest.raises(ImportError, match=rf'pip install "torch_denkf\[{extra}\]"'):
                call()
    assert not list(tmp_path.iterdir())
