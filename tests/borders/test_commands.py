"""Arguments and files of commands: the error names the option or the file."""

from torch_denkf.cli.main import main


def test_drives_without_a_root(tmp_path, capsys):
    assert main(["train", "--out", str(tmp_path), "--rendered", "3", "--test", "09"]) == 2
    err = capsys.readouterr().err
    assert "['09']" in err
    assert "--root" in err
    assert list(tmp_path.iterdir()) == []


def test_images_without_poses(tmp_path, capsys):
    (tmp_path / "sequences" / "town" / "image_2").mkdir(parents=True)
    assert main(["evaluate", "--root", str(tmp_path)]) == 2
    message = f"error: no drive below {tmp_path} has both images and poses: no poses/town.txt\n"
    assert capsys.readouterr().err == message
