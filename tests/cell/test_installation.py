"""What belongs together is found together: packages of one installation, extras, examples."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import cell
from cell import installation

ROOT = Path(cell.__file__).parents[1]


@pytest.mark.parametrize(
    ("name", "way"),
    [
        ("gripper", "from cell import build_cell"),
        ("tactile", "import cell.build"),
        ("motion", "from cell import TactileCellPlugin"),
        ("simulator", "import cell.runtime.plugin"),
        ("recognition", "from cell.interfaces.cli import main; main()"),
    ],
)
def test_a_module_that_hides_a_package_is_named_where_a_cell_is_wanted(
    name: str, way: str, tmp_path: Path
) -> None:
    hiding = tmp_path / f"{name}.py"
    hiding.write_text("")
    code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}]; import cell.errors; {way}"
    kind = "error" if "main" in way else "ImportError"
    ended = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 1
    assert f"{kind}: {hiding} hides the package {name!r} of tactile-cell" in ended.stderr


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert installation.missing_note("report", "report page") == ""
    monkeypatch.setitem(sys.modules, "jinja2", None)
    note = installation.missing_note("report", "report page")
    assert note.startswith("no report page: jinja2 missing; install this project with its extra")


def test_pages_install_what_exists_without_an_index() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    pages = [ROOT / "README.md", *ROOT.glob("docs/**/*.md"), *ROOT.glob("docs/**/*.toml")]
    commands = [
        (page.name, command.strip())
        for page in pages
        for command in re.findall(r"pip install ([^`#&\n]+)", page.read_text("utf-8"))
    ]
    assert len(commands) > 6
    for page, command in commands:
        what = command.split()[-1].strip("'")
        assert what.startswith(".") or "--find-links" in command, (page, command)
        extras = "".join(re.findall(r"\[(.*)\]", what)).split(",")
        assert {*extras} - {""} <= {*project["optional-dependencies"]}, (page, command)
