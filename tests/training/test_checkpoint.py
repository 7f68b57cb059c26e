"""Damage done to real files by hand."""

import zipfile

import pytest
import torch

from torch_denkf.training import checkpoint as module
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint


@pytest.fixture
def file(tmp_path):
    write_checkpoint(tmp_path / "last.pt", {"weight": torch.arange(1000.0), "update": 7})
    return tmp_path / "last.pt"


def test_checkpoint_round_trip(file):
    content = read_checkpoint(file)
    assert content["update"] == 7
    assert torch.equal(content["weight"], torch.arange(1000.0))
    assert [f.name for f in file.parent.iterdir()] == ["last.pt"]


def test_equal_content_gives_equal_bytes(tmp_path):
    """Writes texts that are one object here, and two equal ones there; likewise lists."""
    word, shared = "learning", [1, 2]
    equal = "".join(["lear", "ning"])
    assert equal is not word
    written = []
    for first, second, mine, yours in ((word, word, shared, shared), (word, equal, [1, 2], shared)):
        write_checkpoint(tmp_path / "last.pt", {first: [second, mine, yours], "inside": ({second: torch.ones(2)},)})
        written.append((tmp_path / "last.pt").read_bytes())
    assert written[0] == written[1]
    assert read_checkpoint(tmp_path / "last.pt")[word] == [word, [1, 2], [1, 2]]


def test_a_failed_write_leaves_the_old_file(file, monkeypatch):
    def half(content, stream):
        stream.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(module.torch, "save", half)
    with pytest.raises(OSError, match="disk full"):
        write_checkpoint(file, {"update": 8})
    monkeypatch.undo()
    assert read_checkpoint(file)["update"] == 7


def test_compressed_parts_raise_before_they_are_unpacked(tmp_path):
    """torch stores its parts as they are; compressed ones could become a thousand times as large."""
    file = tmp_path / "bomb.pt"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(10_000_000))
    with pytest.raises(ValueError, match=r"bomb\.pt cannot be read as a checkpoint \(its parts are compressed"):
        read_checkpoint(file)
