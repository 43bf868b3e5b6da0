"""The README's example program is the one in docs/examples, and it runs."""

import re
import runpy
from pathlib import Path

import pytest

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
    name, shape = printed.splitlines()[-2:]
    assert name.startswith("box, ")
    assert shape.startswith("it feels like: flat, 10")


def test_the_readme_begins_with_the_two_commands() -> None:
    lines = [line for line in (ROOT / "README.md").read_text().splitlines() if line.strip()]
    assert lines[1].split("#")[0].strip() == "make run"
    assert lines[2].split("#")[0].strip() == "make test"
