"""Cache entries: what is opened is what was written, or it is made again; nothing in them is executed."""

import json
import logging
import os
import pickle
import shutil
import time
import zlib
from multiprocessing import Pipe, get_context
from pathlib import Path

import pytest
import tensordict
import torch
from tensordict import TensorDict

from torch_denkf.cli.cache import Cache
from torch_denkf.data import cache_entry
from torch_denkf.data.cache import cached, entries_of, forget
from torch_denkf.data.cache_entry import END, MANIFEST, CachedTensor, DamagedEntry, check_entry, is_entry, open_entry
from torch_denkf.deployment.files import sweep

NAME = "drive-0123456789abcdef"


def content():
    generator = torch.Generator().manual_seed(0)
    rows = {
        "state": torch.randn(4, 3, generator=generator),
        "half": torch.randn(4, generator=generator).half(),
        "observed": torch.tensor([[True], [False], [True], [True]]),
        "empty": torch.zeros(4, 0),
    }
    pictures = torch.randint(0, 256, (5, 3, 100, 200), generator=generator, dtype=torch.uint8)  # 5 ends of a file
    assert pictures.numel() > 4 * END
    time = torch.arange(4.0, dtype=torch.float64)
    return TensorDict({"rows": TensorDict(rows, [4]), "pixels": pictures, "time": time}, [])


def same(one, other):
    keys = sorted(map(str, one.keys(True, True)))
    assert keys == sorted(map(str, other.keys(True, True)))
    assert one.batch_size == other.batch_size
    for key in one.keys(True, True):
        assert one[key].dtype == other[key].dtype
        assert torch.equal(torch.Tensor(one[key]), torch.Tensor(other[key])), key
    return True


def never():
    raise AssertionError("made again")


@pytest.fixture
def entry(tmp_path):
    entry = tmp_path / "cache" / NAME
    assert same(cached(entry, content), content())
    return entry


def test_an_entry_is_read_back_from_its_files(entry):
    opened = cached(entry, never)
    assert same(opened, content())
    assert opened["rows"].batch_size == (4,)
    assert all(isinstance(opened[key], CachedTensor) for key in opened.keys(True, True) if key[1] != "empty")
    files = {f"{name}.bin" for name in ("rows.state", "rows.half", "rows.observed", "rows.empty", "pixels", "time")}
    assert set(os.listdir(entry)) == {MANIFEST, *files}
    assert (entry / "time.bin").read_bytes() == content()["time"].numpy().tobytes()
    about = json.loads(json.loads((entry / MANIFEST).read_text())["content"])["tensors"]["pixels"]
    assert about["crc32"] == zlib.crc32((entry / "pixels.bin").read_bytes())
    assert about["shape"] == [5, 3, 100, 200]
    assert os.listdir(entry.parent) == [NAME]


def test_writing_to_an_opened_entry_changes_no_file(entry):
    opened = cached(entry, never)
    opened["pixels"].zero_()
    assert not opened["pixels"].any()
    assert same(cached(entry, never), content())
    check_entry(entry)


def test_workers_read_the_written_file(entry):
    opened = cached(entry, never)
    opened["pixels"][0] = 7
    with get_context("fork").Pool(1) as pool:
        assert pool.apply(torch.sum, (opened["pixels"],)) == opened["pixels"].sum()
    assert torch.equal(pickle.loads(pickle.dumps(opened["pixels"])), torch.Tensor(opened["pixels"]))


def test_workers_get_the_place_of_a_view_and_a_copy_of_their_own(entry):
    opened, wanted = cached(entry, never), content()
    pictures, numbers = wanted["pixels"], wanted["rows", "state"]
    views = (
        (opened["pixels"][1:][2:4], pictures[3:5]),
        (opened["pixels"], pictures),
        (opened["pixels"][3, :, ::7], pictures[3, :, ::7]),
        (opened["pixels"].permute(0, 2, 3, 1)[2], pictures.permute(0, 2, 3, 1)[2]),
        (opened["pixels"].view(torch.int32)[..., 5], pictures.view(torch.int32)[..., 5]),
        (opened["rows"][1:]["state"].squeeze(), numbers[1:]),
        (opened["rows"][2:]["empty"], wanted["rows", "empty"][2:]),
    )
    for view, value in views:
        data = pickle.dumps(view)
        assert len(data) < 1000
        other = pickle.loads(data)
        assert other.dtype == value.dtype
        assert other.shape == value.shape
        assert (other == value).all()
        other.zero_()
        assert (view == value).all()
    assert same(cached(entry, never), wanted)
    check_entry(entry)
    computed = (
        opened["pixels"] + 1,
        opened["pixels"][torch.tensor([2])],
        opened["pixels"].clone(),
        opened["time"].float(),
    )
    assert {type(value) for value in computed} == {torch.Tensor}
    views[0][0][0] = 7  # what is written to a view is known of the whole
    assert (pickle.loads(pickle.dumps(opened["pixels"]))[3] == 7).all()


def flip(file, place):
    data = bytearray(file.read_bytes())
    data[place] ^= 1
    file.write_bytes(data)


def truncate(file, *sizes):
    for size in sizes:
        os.truncate(file, int(size))


def replace_by(make):
    """Replaces a file by something else."""

    def replace(file):
        file.unlink()
        make(file)

    return replace


def lists(batch_sizes, tensors):
    """Returns a manifest with its checksum, of other tensors."""

    def write(file):
        text = json.dumps({"format": "torch_denkf.cache/1", "batch_sizes": batch_sizes, "tensors": tensors})
        file.write_text(json.dumps({"crc32": zlib.crc32(text.encode()), "content": text}))

    return write


PIXELS, SIZE = "pixels.bin", 5 * 3 * 100 * 200
WAYS = {
    "cut": (PIXELS, lambda file: truncate(file, SIZE // 2)),
    "cut, then filled with zeros": (PIXELS, lambda file: truncate(file, SIZE // 2, SIZE)),
    "longer": (PIXELS, lambda file: truncate(file, SIZE + 1)),
    "gone": (PIXELS, Path.unlink),
    "a folder": (PIXELS, replace_by(Path.mkdir)),
    "head": (PIXELS, lambda file: flip(file, 5)),
    "middle": (PIXELS, lambda file: flip(file, SIZE // 2)),
    "tail": (PIXELS, lambda file: flip(file, SIZE - 5)),
    "small file": ("rows.state.bin", lambda file: flip(file, 20)),
    "no manifest": (MANIFEST, Path.unlink),
    "half a manifest": (MANIFEST, lambda file: truncate(file, 300)),
    "manifest": (MANIFEST, lambda file: file.write_text(file.read_text().replace("100, 200", "200, 100"))),
    "another manifest": (MANIFEST, lists({}, {})),
    "a pipe": (PIXELS, replace_by(os.mkfifo)),
    "a pipe for a manifest": (MANIFEST, replace_by(os.mkfifo)),
    "path": (MANIFEST, lists({"": []}, {"../x": {"dtype": "uint8", "shape": [1], "bytes": 1, "crc32": 0, "ends": 0}})),
}


@pytest.mark.parametrize("how", WAYS)
def test_damaged_entry_is_rebuilt_with_one_message(entry, how, caplog):
    name, damage = WAYS[how]
    damage(entry / name)
    assert is_entry(entry) == (how not in ("no manifest", "a pipe for a manifest"))
    with pytest.raises(DamagedEntry):
        open_entry(entry)
    with caplog.at_level(logging.WARNING, "torch_denkf"):
        assert same(cached(entry, content), content())
    (record,) = caplog.records
    assert f"the cache entry {entry} is damaged, and is made again: " in record.getMessage()
    assert same(cached(entry, never), content())
    assert os.listdir(entry.parent) == [NAME]


def test_every_byte_counts_for_the_whole_check(entry, capsys):
    check_entry(entry)
    file = entry / "pixels.bin"
    times = file.stat()
    flip(file, 2 * END)
    os.utime(file, ns=(times.st_atime_ns, times.st_mtime_ns))  # as on a disk that rots: opening cannot know
    cached(entry, never)
    with pytest.raises(DamagedEntry, match=r"pixels.bin does not have its checksum"):
        check_entry(entry)
    words = ["--folder", str(entry.parent)]
    assert Cache.main(["check", *words]) == 1
    assert "pixels.bin does not have its checksum" in capsys.readouterr().out
    assert Cache.main(["clear", "--damaged", *words]) == 0
    assert os.listdir(entry.parent) == []
    assert Cache.main(["check", *words]) == 0


def test_planted_code_is_not_executed(entry, tmp_path):
    """tensordict's own format may hold pickles; an entry of the cache that holds one is none."""

    class Trap:
        def __reduce__(self):
            return Path.touch, (tmp_path / "executed",)

    names = [str(kind) for kind in tensordict.base._ACCEPTED_CLASSES if "NonTensorData" in str(kind)]
    for name in ("pickle.pkl", "other.pickle"):
        (entry / name).write_bytes(pickle.dumps(Trap()))
    (entry / "_tensordict").mkdir()
    (entry / "_tensordict" / "meta.json").write_text(
        json.dumps({"_type": str(TensorDict), "shape": [], "device": "cpu"})
    )
    (entry / "meta.json").write_text(json.dumps({"_type": names[0], "_metadata": None, "stack_dim": None}))
    assert same(cached(entry, never), content())
    (entry / MANIFEST).unlink()
    assert same(cached(entry, content), content())
    assert set(os.listdir(tmp_path)) == {"cache"}


def write_when_told(entry, pipe):
    """Waits before it seals the entry, in a process of its own."""
    seal = cache_entry.seal_entry

    def waiting(folder, content):
        pipe.send("ready")
        pipe.recv()
        seal(folder, content)

    cache_entry.seal_entry = waiting
    pipe.send(cached(entry, lambda: TensorDict({"x": torch.full((1000,), 3.0)}, []))["x"].sum().item())


def start(entry):
    ours, theirs = Pipe()
    process = get_context("fork").Process(target=write_when_told, args=(entry, theirs), daemon=True)
    process.start()
    assert ours.recv() == "ready"
    return process, ours


def test_two_writers_and_one_that_is_killed(tmp_path):
    entry = tmp_path / NAME
    (_, one), (_, other), (killed, _) = start(entry), start(entry), start(entry)
    assert len(os.listdir(tmp_path)) == 3
    killed.kill()
    killed.join()
    assert sweep(tmp_path) == 1  # and not those that are alive
    one.send("go on")
    assert one.recv() == 3000
    opened = cached(entry, never)  # while the other one still writes
    other.send("go on")
    assert other.recv() == 3000
    assert opened["x"].sum() == cached(entry, never)["x"].sum() == 3000
    assert os.listdir(tmp_path) == [NAME]


def test_the_next_start_sweeps(tmp_path):
    earlier, recent = tmp_path / ".writing-earlier1", tmp_path / ".writing-recent12"  # of a version without locks
    for folder, age in ((earlier, 7200), (recent, 60)):
        folder.mkdir()
        (folder / "image.memmap").touch()
        for path in (folder / "image.memmap", folder):
            os.utime(path, (time.time() - age, time.time() - age))
    cached(tmp_path / "other-0123456789abcdef", content)
    assert sorted(os.listdir(tmp_path)) == [recent.name, "other-0123456789abcdef"]


def test_a_sound_entry_of_another_process_is_not_taken_for_damaged(entry, monkeypatch):
    """A damaged entry is replaced by a valid one before it is removed."""
    from torch_denkf.data import cache

    calls = []

    def open_once(folder):
        calls.append(folder)
        if len(calls) == 1:
            raise DamagedEntry("it was, a moment ago")
        return open_entry(folder)

    monkeypatch.setattr(cache, "open_entry", open_once)
    inode = entry.stat().st_ino
    assert same(cached(entry, content), content())
    assert entry.stat().st_ino == inode
    assert os.listdir(entry.parent) == [NAME]


def test_the_command_lists_and_clears(entry, capsys):
    folder = entry.parent
    damaged = folder / "drive-fedcba9876543210"
    shutil.copytree(entry, damaged)
    (damaged / "time.bin").unlink()
    foreign = folder / "holiday-pictures"
    foreign.mkdir()
    assert entries_of(folder) == [entry, damaged]
    assert Cache.main(["list", "--folder", str(folder)]) == 0
    out = capsys.readouterr().out
    assert f"{NAME}\n" in out
    assert f"2 entries, 0.6 MB, in {folder}\n" in out
    assert Cache.main(["check", "--folder", str(folder)]) == 1
    assert f"{NAME}: sound\n" in capsys.readouterr().out
    assert Cache.main(["clear", "--older-than", "1", "--folder", str(folder)]) == 0
    assert entries_of(folder) == [entry, damaged]
    opened = open_entry(entry)
    assert Cache.main(["clear", "--folder", str(folder)]) == 0
    assert f"0.6 MB removed from {folder}\n" in capsys.readouterr().out
    assert os.listdir(folder) == [foreign.name]
    assert same(opened, content())  # who has it open keeps it
    forget(entry)  # is gone: no error
    assert Cache.main(["list", "--damaged"]) == 2
    assert Cache.main(["list", "--folder", str(folder / "none")]) == 0
