"""Size of the force loop: its lines, and its figures, each with its meaning and its source."""

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


def code_lines(text: str) -> int:
    """Return the number of lines without empty lines, comments and docstrings."""
    docs = {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    lines = enumerate(text.splitlines(), 1)
    return sum(bool(re.match(r"\s*[^\s#]", line)) for n, line in lines if n not in docs)


MOST_FIGURES, MOST_LINES = 83, 2665
"""A change may remove figures and lines; a new one needs the place of another."""


def test_each_figure_names_its_source_and_neither_figures_nor_lines_grow() -> None:
    by_file, counted, lines = {}, 0, 0
    for path in FOLDER.rglob("*.py"):
        text = path.read_text("utf-8")
        lines += code_lines(text)
        for names, doc in figures(text):
            counted += names.count(",") + 1
            source = re.search(rf"[\w)`%]\.\s{SOURCES}$", doc)
            by_file[f"{path.relative_to(FOLDER)}: {names}"] = source
    assert [name for name, source in by_file.items() if source is None] == []
    assert 0 < counted <= MOST_FIGURES
    assert 0 < lines <= MOST_LINES


def test_a_figure_without_a_source_is_found() -> None:
    text = '_A, B_S = 1.0, 2\n"""Time in s."""\nC_N = 2.0 * B_S\nD = 3\nE = "text"\n'
    assert list(figures(text)) == [("(_A, B_S)", "Time in s."), ("D", "")]
