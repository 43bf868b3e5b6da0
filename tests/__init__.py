"""Tests of all packages; a package itself so that `tests.faults` can be run from a checkout."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parents[1]
"""The checkout."""


def blocks(page: str, language: str) -> list[str]:
    """Return the blocks of code in a language of a page of docs."""
    text = (ROOT / "docs" / page).read_text("utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def commands(page: str) -> list[list[str]]:
    """Return the arguments of each of our commands on a page of docs."""
    lines = "".join(blocks(page, "sh")).splitlines()
    matches = (re.match(r"(?:sudo /\S+/)?tactile-cell (.*)", line) for line in lines)
    return [shlex.split(one[1], comments=True) for one in matches if one]
