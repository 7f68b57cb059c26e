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


@pytest.mark.parametrize("words", [["render-kitti", "--out", "x"], ["demo"], ["evaluate", "--root", "x"]])
def test_numbers_out_of_range_are_mistakes(words, capsys):
    assert main([*words, "--seed", "-1"]) == 2
    assert "error: --seed must be a whole number, at least 0; got -1\n" in capsys.readouterr().err
    assert main([*words, "--seed", "x"]) == 2
    assert "parsing --seed: invalid literal for int() with base 10: 'x'" in capsys.readouterr().err


def test_no_threads_are_a_mistake(capsys):
    assert main(["evaluate", "--root", "x", "--threads", "0"]) == 2
    assert capsys.readouterr().err == "error: --threads must be a whole number, at least 1; got 0\n"


def test_a_device_that_is_not_there(tmp_path, capsys):
    assert main(["train", "--out", str(tmp_path), "--rendered", "3", "--device", "nowhere"]) == 2
    assert "error: --device nowhere cannot be used here: " in capsys.readouterr().err


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


def doing(monkeypatch, work):
    monkeypatch.setattr(Some, "run", lambda self: work())


def raising(monkeypatch, error):
    def work():
        raise error

    doing(monkeypatch, work)


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
    def work():
        warnings.warn("look\n out", UserWarning, stacklevel=1)
        return 1

    doing(monkeypatch, work)
    assert Some.main([]) == 1
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


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ["odometry", "--fpss", "3"],
            "error: unknown option --fpss; did you mean --fps?",
        ),  # and frames are missing, too
        (["demo", "--oot", "x"], "error: unknown option --oot; did you mean --"),
        (["dmo"], "error: unknown command 'dmo'; did you mean demo?"),
    ],
)
def test_a_misspelt_word_is_named_with_the_nearest_known(words, told, capsys):
    assert main(words) == 2
    assert capsys.readouterr().err.startswith(told)


def test_options_are_read_with_either_dash_and_as_one_word(tmp_path, capsys):
    assert main(["cache", "clear", "--older_than", "1", f"--folder={tmp_path}"]) == 0
