"""The campaign's command, its page, and the summary of it in the docs."""

import pickle
from pathlib import Path

import pytest

from simulator.faults.injector import VOCABULARY
from tests.faults import __main__ as command
from tests.faults import page, results, table
from tests.faults.campaign import FaultRow, Observed
from tests.faults.results import AS_REQUIRED, Result
from tests.faults.state_machine import Outcome


def row(reaction: str) -> FaultRow:
    seen = Observed("HOLD", 0.003, "kept")
    return FaultRow(8, "", "x", "can.off", reaction, 0.1, lambda _row: seen)


def test_the_summary_in_the_docs_has_the_figures_of_the_table() -> None:
    remedy = "the table has changed: python -m tests.faults --summary"
    assert page.summary() in command.SUMMARY.read_text(encoding="utf-8"), remedy


def test_the_summary_counts_the_rows() -> None:
    assert f"{len(table.ROWS)} variants of 42 kinds of fault" in page.summary()
    assert "| servos | 22 to 27, 30 | 25 | 10 REJECT," in page.summary()


def test_the_figures_alone_are_written_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "page.md"
    path.write_text(f"# Campaign\n\n{page.BEGIN}\nold\n{page.END}\n\nafter\n")
    monkeypatch.setattr(command, "SUMMARY", path)
    command.main(["--summary"])
    assert path.read_text() == f"# Campaign\n\n{page.summary()}\nafter\n"


@pytest.mark.parametrize(
    ("reaction", "defect", "complaint"),
    [
        ("HOLD", "", None),
        ("NOTE", "", "not as required: 08"),
        ("HOLD", "seed 1001: force", "DEFECT"),
    ],
)
def test_the_page_is_written_and_what_is_wrong_fails_the_command(
    reaction: str,
    defect: str,
    complaint: str | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[int, float]] = []

    def run_all(steps: int, *, seconds: float, **_: object) -> Outcome:
        asked.append((steps, seconds))
        return Outcome(steps=12_345, seconds=2.0, defect=defect)

    monkeypatch.setattr(table, "ROWS", (row(reaction),))
    monkeypatch.setattr(command, "run_all", run_all)
    monkeypatch.setenv("STATE_STEPS", "1000000")
    monkeypatch.setenv("STATE_SECONDS", "40")
    path = tmp_path / "out" / "page.md"
    arguments = ["--jobs", "1", "--page", str(path)]
    if complaint is None:
        command.main(arguments)
    else:
        with pytest.raises(SystemExit, match=complaint):
            command.main(arguments)
    assert asked == [(1_000_000, 40.0)]
    text = path.read_text(encoding="utf-8")
    assert "12,345 steps" in text
    assert ("no invariant was broken" in text) == (not defect)
    assert all(f"| `{name}` |" in text for name in VOCABULARY)
    verdict = "as required" if reaction == "HOLD" else "**differs**"
    assert f"| 8 | x | `can.off` | {reaction} | 100 ms | 3 ms | kept | {verdict}" in text


def test_a_row_is_run_by_its_name_in_another_process() -> None:
    run = pickle.loads(pickle.dumps(results._run_named))
    observed, failure, seconds = pickle.loads(pickle.dumps(run("38-NaN")))
    (named,) = (row for row in table.ROWS if row.name == "38-NaN")
    assert Result(named, observed, failure, seconds).verdict == AS_REQUIRED
