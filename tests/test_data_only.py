"""Nothing that the library, its studies or its examples read from a file is unpickled."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("torch_denkf", "benchmarks", "examples", "docs")
#: Calls that run code which the file names. A packaged step is one: its docstring says that it is a program.
UNPICKLING = ("pickle.load", "pickle.loads", "joblib.load", "load_memmap", "torch.jit.load", "dill.load", "read_pickle")


def calls(text):
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}


def unpickles(name, keywords):
    if name == "torch.load":
        return keywords.get("weights_only") != "True"
    if name in ("np.load", "numpy.load"):
        return keywords.get("allow_pickle", "False") != "False"
    return name.endswith(UNPICKLING)


@pytest.mark.parametrize("text", ["torch.load(f)", "TensorDict.load_memmap(f)", "np.load(f, allow_pickle=True)"])
def test_search_finds_files(text):
    assert any(unpickles(*call) for call in calls(text))


def test_no_file_is_unpickled():
    found = [
        f"{path.relative_to(ROOT)}: {name}"
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*.py")
        if "_build" not in path.parts and "gallery" not in path.parts
        for name, keywords in calls(path.read_text())
        if unpickles(name, keywords)
    ]
    assert not found
