"""Figures that README and docs quote, and transcripts of the tutorial, are those of today's run."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from docs.tools.pictures import TUTORIAL, today

ROOT = Path(__file__).parents[2]
PAGES = ("README.md", "docs/explanations/recognizer.md")
PROGRAM = Path(sys.executable).with_name("tactile-cell")
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def numbers(text: str) -> list[float]:
    return [float(number) for number in _NUMBER.findall(text.replace("95 %", ""))]


def quoted(page: str, command: str) -> list[str]:
    """Return the cells with figures of a page's table rows that belong to a command.

    A command stands in the last cell of a row, or in the paragraph above the table.
    """
    found, above, is_ended = [], "", False
    for line in page.splitlines():
        if not line.startswith("|"):
            if line.strip():
                above = line if is_ended else f"{above} {line}"
            is_ended = not line.strip()
            continue
        is_ended = True
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if command in cells[-1]:
            found.append(cells[-2])
        elif command in above:
            found += cells[1:]
    return [cell for cell in found if numbers(cell)]


def differing(cells: list[str], printed: str) -> list[str]:
    """Return the cells whose figures stand in no printed line together, in their order."""
    lines = [numbers(line) for line in printed.splitlines()]
    return [cell for cell in cells if not any(_in_order(numbers(cell), line) for line in lines)]


def _in_order(wanted: list[float], line: list[float]) -> bool:
    rest = iter(line)
    return all(number in rest for number in wanted)


def printed(*arguments: object) -> str:
    command = [PROGRAM, *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_a_figure_that_is_printed_no_more_is_named() -> None:
    page = "`x`:\n\n| | a |\n|---|---|\n| b | 97.7 % (95.5 to 98.8) |\n| c | 12 of 50 |\n"
    cells = quoted(page, "`x`")
    assert cells == ["97.7 % (95.5 to 98.8)", "12 of 50"]
    assert differing(cells, "r: one grasp 97.7, 95 % 95.5 to 98.8") == ["12 of 50"]
    assert differing(["27 of 50, 23 wrong"], "23 of 50 right, 27 wrong") == ["27 of 50, 23 wrong"]
    assert quoted("| b | 3 | `x` |", "`x`") == ["3"]
    assert quoted("By `x`, a\nparagraph:\n\n| b | 3 |\n\nOther:\n\n| c | 4 |", "`x`") == ["3"]


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("page", "command", "options", "n_cells"),
    [
        ("README.md", "`make run`", "", 2),
        (
            "docs/how-to/open-parallel-gripper.md",
            "`tactile-cell run",
            "-c open-parallel-gripper",
            4,
        ),
        (
            "docs/how-to/connect-uskin.md",
            "`tactile-cell run",
            "-c uskin --teach 10 --trials 4",
            2,
        ),
    ],
)
def test_the_run_of_today_prints_what_is_quoted(page, command, options, n_cells, tmp_path) -> None:
    given = re.sub(r"-c (\S+)", rf"-c {ROOT}/config/\1.yaml", options).split()
    text = printed("run", *given, "--out", tmp_path)
    cells = quoted((ROOT / page).read_text(encoding="utf-8"), command)
    assert len(cells) == n_cells
    assert differing(cells, text) == []


@pytest.mark.long
@pytest.mark.shared_data
@pytest.mark.timeout(900)
@pytest.mark.skipif(
    "TACTILE_CELL_DATA" not in os.environ,
    reason="TACTILE_CELL_DATA does not name the folder of recorded grasps",
)
def test_the_evaluation_of_today_prints_what_is_quoted() -> None:
    data = Path(os.environ["TACTILE_CELL_DATA"])
    first, later = data / "pinch36.npz", data / "pinch_november.npz"
    text = printed("model", "evaluate", first)
    text_later = printed("model", "evaluate", later, "--train", first, "--recognizer", "force_ramp")
    for name in PAGES:
        page = (ROOT / name).read_text(encoding="utf-8")
        assert differing(quoted(page, "`tactile-cell model evaluate FILE`"), text) == [], name
        assert differing(quoted(page, "`tactile-cell model evaluate LATER"), text_later) == [], name


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_tutorial_shows_what_is_printed_today() -> None:
    page = TUTORIAL.read_text(encoding="utf-8")
    shown, new = (re.sub(r"\d{8}-\d{6}", "TIME", text) for text in (page, today(page)))
    assert new == shown
