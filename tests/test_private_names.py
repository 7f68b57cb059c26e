"""Private names of torch are used in one package alone, so that a new version of torch can break only that one."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1] / "torch_denkf"
#: Documented in spite of their underscore: torch.export's ahead-of-time compiler, and modes of dispatch.
DOCUMENTED = {
    "torch._inductor.aoti_compile_and_package",
    "torch._inductor.aoti_load_package",
    "torch.utils._python_dispatch.TorchDispatchMode",
}


def private_names(path):
    """Yields names of torch with a part that begins with one underscore."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "torch":
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names if alias.name.split(".")[0] == "torch"]
        elif isinstance(node, ast.Attribute):
            dotted = ast.unparse(node)
            names = (
                [dotted] if dotted.startswith("torch.") and dotted.replace(".", "").replace("_", "").isalnum() else []
            )
        for name in names:
            if any(part.startswith("_") and not part.startswith("__") for part in name.split(".")):
                yield name


def test_private_names_of_torch_are_used_in_compilation_only():
    found = {
        (str(path.relative_to(ROOT)), name)
        for path in ROOT.rglob("*.py")
        if path.parts[-2] != "compilation"
        for name in private_names(path)
        if not any(known.startswith(name) or name == known for known in DOCUMENTED)
    }
    assert not found
    assert any(True for path in (ROOT / "compilation").glob("*.py") for _ in private_names(path)), "found none"
