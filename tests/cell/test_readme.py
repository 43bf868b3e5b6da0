"""The README's example is the one in docs/examples and runs; what the README names exists."""

import re
import runpy
from pathlib import Path

import pytest

from benchmarks.__main__ import modules

ROOT = Path(__file__).parents[2]


def test_readme_shows_the_example_that_is_run() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    example = (ROOT / "docs/examples/host_program.py").read_text(encoding="utf-8")
    assert shown == example.split("\n\n", 1)[1]
    assert len(shown.splitlines()) <= 30


def test_the_example_teaches_and_identifies(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(ROOT / "docs/examples/host_program.py"), run_name="__main__")
    printed = capsys.readouterr().out
    assert printed.count("robot:") >= 19
    name, shape, kept = printed.splitlines()[-3:]
    assert name.startswith("box, ")
    assert re.match(r"it feels like: flat, (9\.[7-9]|10\.[0-3]) mm", shape)
    assert kept == "  robot: to the bin of box, the part in the grip: True"


def test_files_that_the_pages_at_the_root_name_exist() -> None:
    for page in ROOT.glob("*.md"):
        for target in re.findall(r"\]\(([^)#:]+)[^)]*\)", page.read_text(encoding="utf-8")):
            assert (ROOT / target).exists(), f"{page.name} names {target}"


def test_benchmarks_that_the_docs_name_exist() -> None:
    pages = [ROOT / "README.md", *ROOT.glob("docs/*/*.md")]
    named = [
        (page.name, name)
        for page in pages
        for names in re.findall(r"`python -m benchmarks ([a-z_ ]+)`", page.read_text("utf-8"))
        for name in names.split()
    ]
    assert len(named) > 8
    assert not [found for found in named if found[1] not in modules()]


def test_the_readme_begins_with_the_three_commands() -> None:
    lines = [line for line in (ROOT / "README.md").read_text().splitlines() if line.strip()]
    assert lines[1].split("#")[0].strip() == "make run"
    assert lines[2].split("#")[0].strip() == "make test"
    assert lines[3].split("#")[0].strip() == "make serve"
