"""Figures of the force loop: each has a line that says what it is, and where it comes from."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import gripper

FOLDER = Path(gripper.__file__).parent / "force"
SOURCES = r"\[(tuned|chosen|assumed|resolution|statistics|vendor|log)\]"


def figures(text: str) -> Iterator[tuple[str, str]]:
    """Yield the names and the docstring of the numbers that a module sets, not derives."""
    body = ast.parse(text).body
    for node, after in zip(body, [*body[1:], None], strict=True):
        if not isinstance(node, ast.Assign):
            continue
        values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
        if any(type(getattr(value, "value", None)) in (int, float) for value in values):
            doc = after.value if isinstance(after, ast.Expr) else None
            names = ast.unparse(node.targets[0])
            yield names, str(doc.value) if isinstance(doc, ast.Constant) else ""


MOST_FIGURES = 165
"""A change of the law may remove figures; a new one needs the place of another."""


def test_each_figure_names_its_source_and_there_are_no_more_of_them() -> None:
    found, counted = {}, 0
    for path in FOLDER.rglob("*.py"):
        for names, doc in figures(path.read_text("utf-8")):
            counted += names.count(",") + 1
            source = re.search(rf"[\w)`%]\.\s{SOURCES}$", doc)
            found[f"{path.relative_to(FOLDER)}: {names}"] = source
    assert [name for name, source in found.items() if source is None] == []
    assert 100 < counted <= MOST_FIGURES


def test_a_figure_without_a_source_is_found() -> None:
    text = '_A, B_S = 1.0, 2\n"""Time in s."""\nC_N = 2.0 * B_S\nD = 3\nE = "text"\n'
    assert list(figures(text)) == [("(_A, B_S)", "Time in s."), ("D", "")]
