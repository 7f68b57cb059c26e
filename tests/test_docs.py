"""The pages: each of their Python blocks runs, by itself, and each file that they name exists.

A reader copies one block, not a page: a block gets a namespace of its own, and must import what it uses. In front of a
block that cannot run here stands ``<!-- not run: why -->``.
"""

import re
import runpy
from pathlib import Path

import pytest

from torch_denkf.transforms import DEnKFTransform

ROOT = Path(__file__).parents[1]
PAGES = sorted(path for path in [ROOT / "README.md", *ROOT.glob("docs/**/*.md")] if "_build" not in path.parts)
BLOCK = re.compile(r"(?:^<!-- not run: (?P<why>.+?) -->\n+)?^```python\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)\s]+)\)")
FILE = re.compile(r"`((?:torch_denkf|tests|examples|benchmarks|docs)/[\w./-]+\.\w+)`")


def name(path):
    return str(path.relative_to(ROOT))


#: Pages whose programs train for more than eight seconds.
LONG = {"train_motion_first", "own_log", "three_ways", "labels_by_hand", "own_dynamics", "own_loss", "outliers"}


def blocks():
    for path in PAGES:
        text = path.read_text()
        for match in BLOCK.finditer(text):
            line = text.count("\n", 0, match.start("code"))
            marks = [pytest.mark.skip(reason=match["why"])] if match["why"] else []
            marks += [pytest.mark.slow] if path.stem in LONG else []
            yield pytest.param(path, line, match["code"], id=f"{name(path)}:{line}", marks=marks)


@pytest.mark.parametrize(("path", "line", "code"), list(blocks()))
def test_block_runs(path, line, code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile("\n" * line + code, str(path), "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_named_files_exist(path):
    text = path.read_text()
    linked = [target.split("#")[0] for target in LINK.findall(text) if "://" not in target and "gallery" not in target]
    assert [file for file in FILE.findall(text) if not (ROOT / file).exists()] == []
    assert [file for file in linked if file and not (path.parent / file).exists()] == []


def test_the_readme_fits_on_two_screens():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 110
    assert len(text.encode()) <= 7500


def test_table_of_the_transform_names_its_own_methods():
    text = (ROOT / "docs" / "_ext" / "reference_pages.py").read_text()
    named = set(re.findall(r"^ +``(\w+)``  ", text, re.MULTILINE))
    assert len(named) > 10
    assert named <= set(vars(DEnKFTransform))


def test_the_list_of_public_names_is_up_to_date():
    pages = runpy.run_path(str(ROOT / "docs" / "_ext" / "reference_pages.py"))
    assert (ROOT / "docs" / "reference" / "names.md").read_text() == pages["names"]()


def test_pages_are_short_and_animations_small():
    written = [path for path in PAGES if "docs" in path.parts and path.name != "names.md"]  # names.md is generated
    assert sum(len(path.read_text().split()) for path in written) <= 28_000
    assert list(ROOT.glob("docs/*.png")) == list(ROOT.glob("docs/*.gif")) == []
    animations = [*ROOT.glob("docs/pictures/*.gif"), *ROOT.glob("benchmarks/*/results/*.gif")]
    assert [name(path) for path in animations if path.stat().st_size > 500_000] == []
