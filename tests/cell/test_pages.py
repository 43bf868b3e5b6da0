"""Pages with commands, on operation and on hardware: each command is typed here, in order."""

import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from benchmarks.__main__ import MODULES
from cell.config.file import changed_config, config_text, load_config, parse_config
from cell.interfaces.cli.app import app
from cell.recording.retention import mark
from cell.service.history import History
from gripper.values.outcome import GraspResult
from tests import ROOT, blocks, commands
from tests.cell.cells import small_config
from tests.marks import LONG

PACKAGES = ("gripper", "tactile", "motion", "recognition", "simulator", "cell", "tests")


def typed(page: str) -> Iterator[str]:
    """Type each of our commands on a page, and yield what each prints."""
    for arguments in commands(page):
        # A person says yes where it asks.
        result = CliRunner().invoke(app, arguments, input="y\n", catch_exceptions=False)
        assert result.exit_code == 0, (arguments, result.output)
        yield result.output


@pytest.mark.slow
def test_the_program_has_each_command_and_option_of_the_pages() -> None:
    uses: dict[frozenset[str], list[str]] = {}
    for page in (ROOT / "README.md", *ROOT.glob("docs/**/*.md")):
        text = page.read_text("utf-8").replace("\\\n", "")
        code = "".join(re.findall(r"(?s:```(?:sh|text)\n.*?```)|^    .*\n", text, re.MULTILINE))
        for line in re.findall(r"^(?:\$ |    )?tactile-cell (.*)", code, re.MULTILINE):
            words = shlex.split(line, comments=True)
            uses[frozenset(one for one in words if one[0] == "-") | {words[0]}] = words
    assert len(uses) > 40
    for words in uses.values():
        assert CliRunner().invoke(app, [*words, "--help"]).exit_code == 0, words


def test_the_pages_for_maintainers_name_files_and_constants_that_exist() -> None:
    text = "".join((ROOT / page).read_text() for page in ("ARCHITECTURE.md", "docs/how-to/add.md"))
    rows = [re.findall(r"`([\w./]+)`", row) for row in re.findall(r"^\| .*", text, re.MULTILINE)]
    for row in rows:
        paths = [ROOT / name for name in row if name.split("/")[0] in PACKAGES and "/" in name]
        code = "".join(path.read_text() for path in paths if path.suffix == ".py")
        constants = [name for name in row if re.fullmatch(r"[A-Z_]{4,}", name)] if code else []
        assert [str(path) for path in paths if not path.exists()] == []
        assert [name for name in constants if not re.search(rf"\b{name}\b", code)] == []
    assert len(rows) > 20


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, taught: Any) -> Path:
    """Go to the folder of a simulated cell with a model."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    Path("tactile-cell.yaml").write_text(config_text(small_config(name="press 4")))
    Path("parts.model.npz").write_bytes(Path(taught.result.model).read_bytes())
    return Path.cwd()


def test_the_config_of_the_page_on_keys_is_valid() -> None:
    (block,) = blocks("reference/config.md", "yaml")
    assert parse_config(block, source="page").gripper.port.startswith("/dev")


@pytest.mark.long
def test_the_page_on_updates_can_be_typed(here) -> None:
    Path("commissioning.md").write_text("signed")
    back_up, put_back, *_ = blocks("how-to/update.md", "sh")
    subprocess.run(["bash", "-ec", back_up + put_back], check=True)
    for name in ("commissioning.md", "parts.model.npz", "tactile-cell.yaml"):
        assert Path("../press-4", name).read_bytes() == Path(name).read_bytes()
    assert re.search(r"\b(ball|box)\b", list(typed("how-to/update.md"))[-1])


def test_the_page_on_recordings_can_be_typed(here) -> None:
    (config,) = blocks("how-to/keep-recordings.md", "yaml")
    settings = parse_config(config, source="the page").recording
    assert settings == type(settings)()  # the page shows the defaults
    recording = Path("out/serve-20270115-080000/recording.mcap")
    recording.parent.mkdir(parents=True)
    recording.write_bytes(bytes(2_000_000))
    os.utime(recording, 2 * (datetime(2027, 1, 15, 8, 30).timestamp(),))
    mark(recording)
    listed, marked = typed("how-to/keep-recordings.md")
    assert f"  {recording}: MB 2.0, last write 2027-01-15 08:30, marked yes\n" in listed
    assert marked == f"{recording}: marked by recording.mcap.keep beside it\n"
    assert recording.with_name("recording.mcap.keep").is_file()
    well = SimpleNamespace(n_faults=0, fault=None)
    history = History(Path("out/history-press-4.sqlite3"), lambda: well)
    history.update()
    history._close_link()
    names: dict[str, Any] = {}
    (example,) = blocks("how-to/keep-recordings.md", "python")
    exec(example, names)
    assert [row["kind"] for row in names["rows"]] == ["start"]


@pytest.mark.parametrize(
    "page", ["open-parallel-gripper", "rh-p12-rn", "connect-flexitac", "connect-uskin"]
)
def test_the_page_on_hardware_can_be_typed(page, make_bench, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    *_, checked = typed(f"how-to/{page}.md")
    assert "valid" in checked
    (written,) = Path().glob("*.yaml")
    config = load_config(written)
    if page == "rh-p12-rn":
        # The example says it: `tactile-cell hand zero` first, or the friction is unknown.
        config = changed_config(config, {"self_zero": "always"})
    outcome = make_bench(config).ready("box").grasp(4.0).outcome
    assert outcome.result is not GraspResult.PART_LOST
    assert outcome.final_force_n == pytest.approx(4.0, abs=1.0)


# -- The README's test is that of a page; the example of hosts runs; what the README names exist----


README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_readme_shows_the_test_that_is_run() -> None:
    assert blocks("../README.md", "python") == blocks("how-to/test-your-cell.md", "python")


@pytest.mark.slow
@pytest.mark.long
def test_the_example_teaches_and_identifies(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(ROOT / "docs/examples/host_program.py"), run_name="__main__")
    printed = capsys.readouterr().out
    assert printed.count("robot:") >= 19
    name, shape, in_grip = printed.splitlines()[-3:]
    assert name.startswith("box, ")
    assert re.match(r"measured shape: flat, (9\.[7-9]|10\.[0-3]) mm", shape)
    assert in_grip == "  robot: to the bin of box, the part in the grip: True"


QUICK_START = README.partition("## Quick start")[2].partition("\n## ")[0]


def test_the_quick_start_installs_what_its_commands_need() -> None:
    (extras,) = re.findall(r"`pip install '\.\[(.*)\]'`", QUICK_START)
    assert extras == "report,serve"


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_quick_start_does_what_its_comments_say(tmp_path: Path) -> None:
    *lines, _serve = re.findall(r"^    (.+)$", QUICK_START.partition("```")[0], re.MULTILINE)
    folder = str(Path(sys.executable).parent)
    env = os.environ | {"PATH": f"{folder}:{os.environ['PATH']}", "COLUMNS": "200"}

    def typed_in_a_shell(command: str) -> str:
        return subprocess.check_output(["bash", "-c", command], cwd=tmp_path, env=env, text=True)

    init, teach, draw, train, identify, sort = map(typed_in_a_shell, lines)
    assert "wrote tactile-cell.yaml" in init
    for part in ("ball", "box", "cylinder"):
        assert f"6 of 6 grasps of {part} added" in teach
    assert "virtual grasps of pin added to parts.npz (18 before)" in draw
    assert "4 objects taught" in train
    assert "answer: ball" in identify
    assert "20 parts sorted" in sort
    assert "mistakes: none" in sort
    assert not re.search(r"teach (oval|dumbbell)", sort)


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
    assert not [match for match in named if match[1] not in MODULES]


# -- What belongs together is found together: packages of one installation, extras, examples -------


@pytest.mark.parametrize(
    ("name", "way"),
    [
        ("gripper", "from cell import build_cell"),
        LONG("tactile", "import cell.build"),
        LONG("motion", "from cell import TactileCellPlugin"),
        LONG("simulator", "import cell.runtime.plugin"),
        ("recognition", "from cell.interfaces.cli import main; main()"),
    ],
)
def test_a_module_that_hides_a_package_is_named_where_a_cell_is_wanted(name, way, tmp_path) -> None:
    hiding = tmp_path / f"{name}.py"
    hiding.write_text("")
    code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}]; import cell.errors; {way}"
    kind = "error" if "main" in way else "ImportError"
    ended = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 1
    assert f"{kind}: {hiding} hides the package {name!r} of tactile-cell" in ended.stderr


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
