"""Pages with commands, on operation and on hardware: each command is typed here, in order."""

import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from cell.build import build_cell
from cell.config.file import changed_config, config_text, load_config, parse_config
from cell.control.plan import GraspStep, Pose
from cell.interfaces.cli.app import app
from cell.service.history import History
from gripper.values.outcome import GraspResult
from tests import ROOT
from tests.cell.conftest import small_config

PAGES = ROOT / "docs/how-to"


def blocks(page: str, language: str) -> list[str]:
    """Return the blocks of code of a page in a language."""
    text = (PAGES / page).read_text("utf-8")
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def typed(page: str) -> Iterator[str]:
    """Type each of our commands on a page, and yield what each prints."""
    for line in "".join(blocks(page, "sh")).splitlines():
        program, *arguments = shlex.split(line, comments=True)
        if program == "tactile-cell":
            # A person says yes where it asks.
            found = CliRunner().invoke(app, arguments, input="y\n", catch_exceptions=False)
            assert found.exit_code == 0, (line, found.output)
            yield found.output


@pytest.mark.slow
def test_the_program_has_each_command_and_option_of_the_pages() -> None:
    commands: dict[frozenset[str], list[str]] = {}
    for page in (ROOT / "README.md", *ROOT.glob("docs/**/*.md")):
        text = page.read_text("utf-8").replace("\\\n", "")
        code = "".join(re.findall(r"(?s:```(?:sh|text)\n.*?```)|^    .*\n", text, re.MULTILINE))
        for line in re.findall(r"^(?:\$ |    )?tactile-cell (.*)", code, re.MULTILINE):
            words = shlex.split(line, comments=True)
            commands[frozenset(one for one in words if one[0] == "-") | {words[0]}] = words
    assert len(commands) > 40
    for words in commands.values():
        assert CliRunner().invoke(app, [*words, "--help"]).exit_code == 0, words


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, taught: Any) -> Path:
    """Go to the folder of a simulated cell with a model."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    config = small_config(name="press 4")
    Path("tactile-cell.yaml").write_text(config_text(config))
    model = Path(taught.result.model)
    Path("parts.model.npz").write_bytes(model.read_bytes())
    return Path.cwd()


def test_the_config_of_the_page_on_keys_is_valid() -> None:
    (shown,) = blocks("../reference/config.md", "yaml")
    assert parse_config(shown, source="page").gripper.port.startswith("/dev")


@pytest.mark.long
def test_the_page_on_updates_can_be_typed(here) -> None:
    Path("commissioning.md").write_text("signed")
    back_up, put_back, *_ = blocks("update.md", "sh")
    subprocess.run(["bash", "-ec", back_up + put_back], check=True)
    for name in ("commissioning.md", "parts.model.npz", "tactile-cell.yaml"):
        assert Path("../press-4", name).read_bytes() == Path(name).read_bytes()
    assert re.search(r"\b(ball|box)\b", list(typed("update.md"))[-1])


@pytest.mark.slow
def test_the_page_on_recordings_can_be_typed(here) -> None:
    (config,) = blocks("keep-recordings.md", "yaml")
    Path("of-the-page.yaml").write_text(config)
    kept = load_config(Path("of-the-page.yaml")).recording
    assert kept == type(kept)()  # the page shows the defaults
    recording = Path("out/serve-20270115-080000/recording.mcap")
    recording.parent.mkdir(parents=True)
    recording.touch()
    listed, marked, unmarked = typed("keep-recordings.md")
    assert str(recording) in listed
    assert (marked, unmarked) == (f"{recording}: marked\n", f"{recording}: not marked\n")
    history = History(Path("out/history-press-4.sqlite3"), lambda: STATE)
    history.update()
    history._close_link()
    found: dict[str, Any] = {}
    (example,) = blocks("keep-recordings.md", "python")
    exec(example, found)
    assert [row["kind"] for row in found["rows"]] == ["start"]


class STATE:
    """A cell without a fault."""

    n_faults = 0
    fault = None


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", ["open-parallel-gripper", "rh-p12-rn", "connect-flexitac", "connect-uskin"]
)
def test_the_page_on_hardware_can_be_typed(page, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    *_, checked = typed(f"{page}.md")
    assert "valid" in checked
    (written,) = Path().glob("*.yaml")
    config = load_config(written)
    if page == "rh-p12-rn":
        # The example says it: `tactile-cell hand zero` first, or the friction is unknown.
        config = changed_config(config, {"self_zero": "always"})
    cell = build_cell(config)
    try:
        cell.controller.start()
        cell.controller.moves.present("box")
        record = cell.controller.grasp(GraspStep(pose=Pose(), force_n=4.0))
    finally:
        cell.close()
    assert record.outcome.result is not GraspResult.PART_LOST
    assert record.outcome.final_force_n == pytest.approx(4.0, abs=1.0)
