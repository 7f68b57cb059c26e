"""All sub-commands answer alike: help with an example, one-line mistakes, exit statuses."""

import subprocess
import sys
import warnings
from dataclasses import dataclass
from pkgutil import resolve_name

import pytest

import torch_denkf
from torch_denkf.cli.command import Command
from torch_denkf.cli.main import commands, main


def test_help_names_every_command(capsys):
    assert main([]) == main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(f"\n  {name} " in out for name in commands())


@pytest.mark.parametrize("name", commands())
def test_each_command_has_help_with_an_example(name, capsys):
    assert main([name, "--help"]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"usage: denkf {name} ")
    command = resolve_name(commands()[name][0])
    assert f"\nexample: {command.example}\n" in out
    assert command.name == name
    command.read(command.example.split()[2:])  # it is a command that works


def test_the_list_of_commands_needs_neither_torch_nor_tyro():
    code = (
        "import sys; from torch_denkf.cli.main import main; main(['--help']); print({'torch', 'tyro'} & {*sys.modules})"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.endswith("\nset()\n")


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"denkf {torch_denkf.__version__}\n"


TYPOS = {
    "fly": "unknown command 'fly'; there are info, ",
    "dmo": "unknown command 'dmo'; did you mean demo?",
    "odometry --fpss 3": "unknown option --fpss; did you mean --fps?",  # and frames are missing, too
    "demo --oot x": "unknown option --oot; did you mean --",
}
WORDS = {
    "train": "--out",
    "train --out": "--out",
    "odometry x --fps fast": "see denkf odometry --help",
    "demo --seed -1": "--seed must be a whole number, at least 0; got -1",
    "evaluate --root x --seed x": "parsing --seed: invalid literal for int() with base 10: 'x'",
    "evaluate --root x --threads 0": "--threads must be a whole number, at least 1; got 0",
    "train --out x --rendered 3 --device nowhere": "--device nowhere cannot be used here: ",
}


@pytest.mark.parametrize(("words", "told"), {**TYPOS, **WORDS}.items(), ids=str)
def test_wrong_words_are_one_line(words, told, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words.split()) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert told in err


@dataclass
class Some(Command):
    """Does something."""

    name, example = "some", "denkf some"

    def run(self):
        raise NotImplementedError


@dataclass
class Resumable(Some):
    """Goes on."""

    resumable, mistakes = True, (RuntimeError,)


def raising(monkeypatch, error):
    def run(self):
        raise error

    monkeypatch.setattr(Some, "run", run)


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (ValueError("too\n  few"), 2, "error: too few\n"),
        (FileNotFoundError("no file"), 2, "error: no file\n"),
        (ImportError("pip install it"), 2, "error: pip install it\n"),
        (KeyError("the drive lacks 'image'"), 2, "error: the drive lacks 'image'\n"),
        (KeyboardInterrupt(), 130, "interrupted; the same command goes on from here\n"),
    ],
)
def test_mistakes_and_interrupts(error, status, message, monkeypatch, capsys):
    raising(monkeypatch, error)
    assert Resumable.main([]) == status
    assert capsys.readouterr().err == message


def test_errors_of_our_own_keep_their_traceback(monkeypatch):
    for error in (KeyError("image"), RuntimeError("broken"), TypeError("broken")):
        raising(monkeypatch, error)
        with pytest.raises(type(error)):
            Some.main([])
    raising(monkeypatch, RuntimeError("said"))
    assert Resumable.main([]) == 2


def test_warnings_are_one_line(monkeypatch, capsys):
    def run(self):
        warnings.warn("look\n out", UserWarning, stacklevel=1)
        return 1

    monkeypatch.setattr(Some, "run", run)
    assert Some.main([]) == 1
    assert capsys.readouterr().err == "warning: look out\n"


def test_the_process_ends_with_the_status():
    run = subprocess.run(
        [sys.executable, "-m", "torch_denkf", "train", "--out", "x"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 2
    assert run.stderr.startswith("error: nothing to learn from: pass --root FOLDER, or --rendered N")
    assert "Traceback" not in run.stderr


def test_info(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_DENKF_CACHE", str(tmp_path))
    (tmp_path / "entry").write_bytes(bytes(2_000_000))
    assert main(["info"]) == 0
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines["torch_denkf"] == torch_denkf.__version__
    for package in ("torch", "torchrl", "tensordict", "mujoco", "opencv-python-headless"):
        assert lines[package][0].isdigit()
    assert lines["cache"].startswith(f"{tmp_path}, 2.0 MB")
    assert lines["OpenGL"].startswith(("yes", "no: "))
    assert lines["C++"].startswith("compiler")
    assert "CPU cores" in lines["devices"]


def test_options_are_read_with_either_dash_and_as_one_word(tmp_path, capsys):
    assert main(["cache", "clear", "--older_than", "1", f"--folder={tmp_path}"]) == 0
