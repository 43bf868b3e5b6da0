"""Sentences of the wizard in German: one for each that a step shows, by its English pattern."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

import cell.checks
import cell.commissioning
import cell.interfaces.wizard
import gripper.dynamixel.models
from cell.interfaces.page import FOLDER

STEPS, CHECKS = (Path(package.__file__).parent for package in (cell.commissioning, cell.checks))
MODELS = Path(gripper.dynamixel.models.__file__)
NOT_SHOWN = ("backup", "bench", "figures", "record")
"""Modules whose texts are for the terminal, for logs, or on the record, which is English."""
ENGLISH = {"curves", "pads_figure", "CellError", "ValueError"}
"""Calls whose texts stay English: pictures and errors of programs."""
NO_SENTENCES = "gauge_again|changed_hardware"
"""Names of functions whose texts are for `doctor`."""
ELSEWHERE = {"title", "purpose"}
"""Names of texts that are translated by the key of their step."""


def pattern(text: ast.JoinedStr | ast.Constant) -> str:
    """Return a text with ``{0}`` and so on in the places of its figures."""
    if isinstance(text, ast.Constant):
        return str(text.value)
    numbers = iter(range(10))
    return "".join(
        str(part.value) if isinstance(part, ast.Constant) else f"{{{next(numbers)}}}"
        for part in text.values
    )


def texts(node: ast.AST) -> Iterator[str]:
    """Yield the patterns of the texts below a node that a person is shown."""
    for child in ast.iter_child_nodes(node):
        match child:
            case ast.Expr(value=ast.Constant()):
                continue
            case ast.Assign(targets=[ast.Name(id=name)]) if name in ELSEWHERE:
                continue
            case ast.Call(func=ast.Name(id=name)) if name in ENGLISH:
                continue
            case ast.FunctionDef(name=name) if re.match(NO_SENTENCES, name):
                continue
            case ast.Constant(value=str()):
                yield pattern(child)
            case ast.JoinedStr():
                yield pattern(child)
                for part in child.values:
                    if isinstance(part, ast.FormattedValue):
                        yield from texts(ast.Expr(part.value))
            case _:
                yield from texts(child)


def shown(*paths: Path) -> set[str]:
    return {text for path in paths for text in texts(ast.parse(path.read_text("utf-8")))}


def test_german_has_each_sentence_of_the_steps_and_no_other() -> None:
    german = json.loads((FOLDER / "sentences.de.json").read_text("utf-8"))
    steps = shown(*(path for path in STEPS.glob("*.py") if path.stem not in NOT_SHOWN))
    assert {text for text in steps if re.search(r"[a-z]{2}.* | [a-z]{2}", text)} - set(
        german
    ) == set()
    elsewhere = shown(Path(cell.interfaces.wizard.__file__), *CHECKS.glob("*.py"), MODELS)
    assert set(german) - steps - elsewhere == set()
    for english, text in german.items():
        assert text.strip()
        # Figures, keys of the config and commands stand in both.
        for kept in (r"\{\d\}", r"`[^`]+`", r"\b\w+(?:[._]\w+)*_\w+\b"):
            assert sorted(re.findall(kept, text)) == sorted(re.findall(kept, english)), english
