"""The campaign's command, its page, and the summary of it in the docs."""

import pickle
from pathlib import Path

import pytest

from tests.faults import __main__ as command, page, results, table
from tests.faults.campaign import FaultRow, Observed
from tests.faults.results import AS_REQUIRED, Result


def row(reaction: str) -> FaultRow:
    seen = Observed("HOLD", 0.003, "kept")
    return FaultRow(8, "", "x", "can.off", reaction, 0.1, lambda _row: seen)


def test_the_summary_in_the_docs_has_the_figures_of_the_table() -> None:
    remedy = "the table has changed: python -m tests.faults --summary"
    assert page.summary() in command.SUMMARY.read_text(encoding="utf-8"), remedy


def test_the_summary_counts_the_rows() -> None:
    assert f"{len(table.ROWS)} variants of 44 kinds of fault" in page.summary()
    assert "| servos | 22 to 27, 30 | 30 | 14 REJECT," in page.summary()


def test_the_figures_alone_are_written_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "page.md"
    path.write_text(f"# Campaign\n\n{page.BEGIN}\nold\n{page.END}\n\nafter\n")
    monkeypatch.setattr(command, "SUMMARY", path)
    command.main(["--summary"])
    assert path.read_text() == f"# Campaign\n\n{page.summary()}\nafter\n"


@pytest.mark.parametrize(
    ("reaction", "complaint"), [("HOLD", None), ("NOTE", "not as required: 08")]
)
def test_the_page_is_written_and_what_is_wrong_fails_the_command(
    reaction: str, complaint: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table, "ROWS", (row(reaction),))
    path = tmp_path / "out" / "page.md"
    arguments = ["--jobs", "1", "--page", str(path)]
    if complaint is None:
        command.main(arguments)
    else:
        with pytest.raises(SystemExit, match=complaint):
            command.main(arguments)
    text = path.read_text(encoding="utf-8")
    verdict = "as required" if reaction == "HOLD" else "**differs**"
    assert f"| 8 | x | `can.off` | {reaction} | 100 ms | 3 ms | kept | {verdict}" in text


def test_a_row_is_run_by_its_name_in_another_process() -> None:
    run = pickle.loads(pickle.dumps(results._run_named))
    observed, failure, seconds = pickle.loads(pickle.dumps(run("38-NaN")))
    (named,) = (row for row in table.ROWS if row.name == "38-NaN")
    assert Result(named, observed, failure, seconds).verdict == AS_REQUIRED
