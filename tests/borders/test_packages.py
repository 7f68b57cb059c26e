"""Files that are no package of a step: refused with the file's name, in words of our own."""

import io
import json
import re
import zipfile

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import linear_kalman
from torch_denkf.deployment import export_step, load_step
from torch_denkf.deployment.package import SIGNATURE


def archive(path, **members):
    with zipfile.ZipFile(path, "w") as file:
        for name, data in members.items():
            file.writestr(name.replace("__", "/"), data)


def numbers(path):
    buffer = io.BytesIO()
    np.savez(buffer, state=np.zeros(3))
    path.write_bytes(buffer.getvalue())


OTHERS = {
    "a zip of text": lambda path: archive(path, readme="nothing"),
    "an empty zip": archive,
    "numbers": numbers,
    "weights": lambda path: torch.save({"weight": torch.zeros(2)}, path),
    "a name of a compiled one": lambda path: archive(path, data__aotinductor__model="nothing"),
    "an archive's version alone": lambda path: archive(path, archive__version="0", archive__models__model="x"),
}


@pytest.mark.parametrize("write", OTHERS.values(), ids=OTHERS)
def test_another_zip(tmp_path, write):
    path = tmp_path / "step.pt2"
    write(path)
    with pytest.raises(ValueError, match=rf"^{re.escape(str(path))} .*(export_step|export it again)"):
        load_step(path)


@pytest.mark.parametrize("text", ["{", "[]", json.dumps({"inputs": [], "outputs": []}), json.dumps({"inputs": 3})])
def test_a_damaged_description(tmp_path, text):
    frame = TensorDict({"observation": torch.zeros(2)})
    path = export_step(linear_kalman(), frame, tmp_path / "step.pt2", compiled=False)
    with zipfile.ZipFile(path) as file:
        members = {info.filename: file.read(info) for info in file.infolist()}
    names = [name for name in members if name.endswith(SIGNATURE)]
    assert names
    with zipfile.ZipFile(path, "w") as file:
        for name, data in members.items():
            file.writestr(name, text if name in names else data)
    with pytest.raises(ValueError, match=rf"^{re.escape(str(path))} has a damaged description .*; export it again"):
        load_step(path)
