"""All sub-commands answer alike: help with an example, one-line mistakes, exit statuses."""

import subprocess
import sys
import warnings
from importlib import import_module

import pytest

import torch_denkf
from torch_denkf.cli._command import Command
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
    assert f"\nexample:\n  denkf {name}" in out
    example = out.split("\nexample:\n  denkf ")[1].split()
    command = import_module(commands()[name][0]).main
    command.parser.parse_args(example[1:])  # it is a command that works


def test_version_and_unknown_commands(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"denkf {torch_denkf.__version__}\n"
    assert main(["fly"]) == 2
    assert capsys.readouterr().err.startswith("error: unknown command 'fly'; there are info, ")


def test_wrong_words_are_one_line(capsys):
    for words in (["train"], ["train", "--out"], ["evaluate", "--fly", "x"], ["odometry", "x", "--fps", "fast"]):
        assert main(words) == 2
        err = capsys.readouterr().err
        assert err.startswith("error: ")
        assert err.count("\n") == 1
        assert err.endswith(f"see denkf {words[0]} --help\n")


@pytest.mark.parametrize("command", ["train", "evaluate", "odometry"])
def test_numbers_out_of_range_are_mistakes(command, capsys):
    for word, value, text in (("--threads", "0", "at least 1, got 0"), ("--seed", "-1", "at least 0, got -1")):
        assert main([command, word, value]) == 2
        assert f"error: argument {word}: must be {text}; see denkf {command} --help" in capsys.readouterr().err
    assert main([command, "--seed", "x"]) == 2
    assert "argument --seed: invalid whole number value: 'x'" in capsys.readouterr().err


def test_a_device_that_is_not_there(tmp_path, capsys):
    assert main(["train", "--out", str(tmp_path), "--rendered", "3", "--device", "nowhere"]) == 2
    assert "error: --device nowhere cannot be used here: " in capsys.readouterr().err


def raising(error):
    def run(args):
        raise error

    return run


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
def test_mistakes_and_interrupts(error, status, message, capsys):
    assert Command("x", "", "", lambda parser: None, raising(error), resumable=True)([]) == status
    assert capsys.readouterr().err == message


def test_errors_of_our_own_keep_their_traceback():
    for error in (KeyError("image"), RuntimeError("broken"), TypeError("broken")):
        with pytest.raises(type(error)):
            Command("x", "", "", lambda parser: None, raising(error))([])
    assert Command("x", "", "", lambda parser: None, raising(RuntimeError("said")), mistakes=(RuntimeError,))([]) == 2


def test_warnings_are_one_line(capsys):
    def run(args):
        warnings.warn("look\n out", UserWarning, stacklevel=1)
        return 1

    assert Command("x", "", "", lambda parser: None, run)([]) == 1
    assert capsys.readouterr().err == "warning: look out\n"


def test_the_process_ends_with_the_status():
    run = subprocess.run(
        [sys.executable, "-m", "torch_denkf.cli.main", "train", "--out", "x"],
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
