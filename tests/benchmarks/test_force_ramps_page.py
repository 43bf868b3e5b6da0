"""The figures on the page of the force loop are those that its benchmark gives today."""

import pytest

from benchmarks.performance import force_ramps
from benchmarks.performance._force_plant import RampQuality
from benchmarks.performance.force_ramps import (
    CASES,
    OWN,
    SETUPS,
    Case,
    row,
    run,
    tables,
    write_page,
)

pytestmark = [pytest.mark.no_cover, pytest.mark.long]

RAN_AGAIN = (
    Case(part="steel ball, 200 N/mm", final_n=2.0, rate_n_s=10.0),
    Case(part="cork, 5 N/mm", final_n=4.0, rate_n_s=3.0),
    Case(part="foam ball, 0.2 N/mm", final_n=4.0, rate_n_s=10.0),
)
"""Some of the ramps: any change of the force loop or of its plant changes one of them."""
ROUNDING = 0.02
"""Difference in N that another mathematical library may make."""
REMEDY = "the force loop has changed: python -m benchmarks.performance.force_ramps --page"


def figures_n(text: str) -> list[float]:
    """Return overshoot and error in the hold of both plants; the time to settle leaps."""
    cells = [cell.strip() for cell in text.split("|")][4:]
    return [float(cells[at]) for at in (0, 2, 4, 6)]


def line_of(page: str, case: Case) -> str:
    none = RampQuality(overshoot_n=0.0, settling_s=0.0, holding_n=0.0)
    start = row(case, none, none).partition(" 0.00")[0]
    (found,) = [line for line in page.splitlines() if line.startswith(start)]
    return found


@pytest.mark.parametrize("case", RAN_AGAIN, ids=lambda case: case.part)
def test_the_page_has_the_figures_of_today(case) -> None:
    printed = line_of(force_ramps.PAGE.read_text(encoding="utf-8"), case)
    today_n: list[float] = []
    for name in (OWN, force_ramps.OWN_TRUTHS):
        quality = run(SETUPS[name], case)
        assert not quality.lost
        today_n += [quality.overshoot_n, quality.holding_n]
    assert figures_n(printed) == pytest.approx(today_n, abs=ROUNDING), REMEDY


def test_a_ramp_with_frames_alone_meets_its_aims() -> None:
    case = Case(part="cork, 5 N/mm", final_n=4.0, rate_n_s=3.0)
    quality = run(SETUPS["force loop, frames"], case)
    assert all(force_ramps.met(quality, case.final_n))


def test_the_figures_alone_are_written_anew(tmp_path, monkeypatch) -> None:
    path = tmp_path / "page.md"
    path.write_text(f"# Page\n\n{force_ramps.BEGIN}\nstale\n{force_ramps.END}\n\nafter\n")
    monkeypatch.setattr(force_ramps, "PAGE", path)
    good = RampQuality(overshoot_n=0.11, settling_s=0.02, holding_n=0.12)
    lost = RampQuality(overshoot_n=0.0, settling_s=1.5, holding_n=2.0, lost=True)
    found = {name: dict.fromkeys(CASES, good) for name in SETUPS}
    found[OWN][CASES[0]] = lost
    write_page(tables(found))
    page = path.read_text()
    assert page.startswith(f"# Page\n\n{force_ramps.BEGIN}\n| part |")
    assert page.endswith(f"{force_ramps.END}\n\nafter\n")
    assert "stale" not in page
    assert "| part lost |  |  | OSH | 0.11 | 0.02 | 0.12 |  |" in page
    n = len(CASES)
    mean_n = ((n - 1) * good.holding_n + lost.holding_n) / n
    assert f"| plain PI, frames | {n} | {n} | {n} | 0.12 N | 0 |" in page
    assert f"| {OWN} | {n - 1} | {n - 1} | {n - 1} | {mean_n:.2f} N | 1 |" in page
