"""The campaign's page: its vocabulary is the simulator's, its totals are those of the rows."""

from pathlib import Path

import pytest

from benchmarks import fault_campaign
from benchmarks.fault_campaign import FaultRow, Observed, page
from benchmarks.fault_campaign.machine import Outcome

PAGE = Path(__file__).parents[2] / "docs" / "fault-campaign.md"
SEEN = Observed(reaction="HOLD", detected_after_s=0.003, outcome="kept")


def row(reaction: str) -> FaultRow:
    return FaultRow(
        row=8, fault="x", injected="can.off", reaction=reaction, limit_s=0.1, run=lambda: SEEN
    )


def test_the_committed_page_has_the_vocabulary_of_the_simulator() -> None:
    remedy = "the vocabulary has changed: python -m benchmarks.fault_campaign.page"
    assert page.vocabulary_section() in PAGE.read_text(encoding="utf-8"), remedy


def test_the_vocabulary_alone_is_written_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "page.md"
    path.write_text(f"# Rows\n\n{page.BEGIN}\nold\n{page.END}\n\nafter\n")
    monkeypatch.setattr(page, "PAGE", path)
    page.update_vocabulary()
    assert path.read_text() == f"# Rows\n\n{page.vocabulary_section()}after\n"


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

    monkeypatch.setattr(page, "ROWS", (row(reaction),))
    monkeypatch.setattr(page, "run_all", run_all)
    monkeypatch.setattr(page, "PAGE", tmp_path / "page.md")
    monkeypatch.setenv("STATE_STEPS", "1000000")
    monkeypatch.setenv("STATE_SECONDS", "40")
    if complaint is None:
        fault_campaign.main()
    else:
        with pytest.raises(SystemExit, match=complaint):
            fault_campaign.main()
    assert asked == [(1_000_000, 40.0)]
    text = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert "12,345 steps in this run" in text
    assert ("no invariant was broken" in text) == (not defect)
    assert page.vocabulary_section() in text
    verdict = "as required" if reaction == "HOLD" else "**differs**"
    assert f"| 8 | x | `can.off` | {reaction} | 100 ms | 3 ms | kept | {verdict}" in text
