"""What belongs together is found together: packages of one installation, extras, examples."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

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


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        ('{"url": "file://HERE", "dir_info": {"editable": true}}', ": pip install -e 'HERE[mesh]'"),
        ('{"url": "file://HERE", "dir_info": {}}', ": pip install 'HERE[mesh]'"),
        ('{"url": "file:///gone", "dir_info": {}}', ": pip install '.[mesh]' in its checkout"),
        ('{"url": "file:///x.whl", "archive_info": {}}', ": pip install '.[mesh]' in its checkout"),
        (
            '{"url": "https://host/x.whl", "archive_info": {}}',
            ": pip install 'tactile-cell[mesh] @ https://host/x.whl'",
        ),
        (
            '{"url": "https://host/x", "vcs_info": {"vcs": "git", "commit_id": "1"}}',
            ": pip install 'tactile-cell[mesh] @ git+https://host/x'",
        ),
        ("", ": pip install '.[mesh]' in its checkout"),
        ("not JSON", ": pip install '.[mesh]' in its checkout"),
    ],
)
def test_an_extra_is_added_to_the_installation_that_is_there(
    origin: str, command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = origin.replace("HERE", str(tmp_path)) or None
    installed = SimpleNamespace(read_text={"direct_url.json": text}.get)
    monkeypatch.setattr(installation, "distribution", {"tactile-cell": installed}.__getitem__)
    assert installation.remedy("mesh") == (
        "install this project with its extra `mesh`" + command.replace("HERE", str(tmp_path))
    )


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
