"""The faces of the packages, and the examples of the Python reference as they stand there."""

import ast
import re
from importlib import import_module
from pathlib import Path

import pytest

from tests.test_lazy_loading import CAN, SERVOS, loaded

PAGE = Path(__file__).parents[1] / "docs/reference/python-api.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
PRINTED = (
    r"force_reached (4\.[6-9]|5\.[0-4]) N\n",
    r"\(408,\) \(0\.0, 0\.0\)\n",
    "8 mm\n",
    "ball\n",
    r"\['(\[TxRxResult\] Communication success!)', '\1'\]\n2213 25\n",
)
FACES = ("gripper", "tactile", "motion", "recognition", "simulator", "cell")


@pytest.mark.slow
@pytest.mark.parametrize(("example", "printed"), list(zip(EXAMPLES, PRINTED, strict=True)))
def test_the_examples_run_as_they_are_printed(example, printed, capsys) -> None:
    exec(compile(example, PAGE.name, "exec"), {})
    assert re.fullmatch(printed, capsys.readouterr().out)


def test_one_package_takes_at_most_ten_lines() -> None:
    lines = [len([line for line in example.splitlines() if line.strip()]) for example in EXAMPLES]
    assert max(lines[:3]) <= 10


@pytest.mark.parametrize("package", FACES)
def test_each_name_of_a_face_is_what_type_checkers_see(package) -> None:
    module = import_module(package)
    stub = Path(str(module.__file__)).with_suffix(".pyi").read_text("utf-8")
    homes = {
        alias.name: f"{package}.{node.module}"
        for node in ast.parse(stub).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert set(module.__all__) == homes.keys() == set(dir(module))
    for name, home in homes.items():
        assert getattr(module, name) is getattr(import_module(home), name)


@pytest.mark.parametrize("package", FACES)
def test_a_package_imports_nothing_before_it_is_used(package) -> None:
    found = loaded(package)
    assert not found & {"numpy", "scipy", *SERVOS, *CAN, "pydantic"}
    assert {name for name in found if name.partition(".")[0] in FACES} == {package}
