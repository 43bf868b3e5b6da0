"""The page on archives: each command is typed here, in order, and each example of Python runs."""

from pathlib import Path

import numpy as np
import pytest
from joblib.externals.loky import get_reusable_executor

from cell.data.dataset import write_dataset
from tests.cell.archive.fleet import FIRST_DAY, SIZES_MM, ramp, record_fleet
from tests.cell.test_operation_pages import blocks, typed

PAGE = "archive-a-fleet.md"


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.timeout(400)
def test_the_page_can_be_typed(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    get_reusable_executor().shutdown()  # processes of another test are in its folder
    record_fleet(Path("out"), n_days=2, n_each=1)
    rng, start_ms = np.random.default_rng(4), int(1e3 * FIRST_DAY.timestamp()) + 900_000_000
    write_dataset(
        "parts.npz",
        [ramp(name, rng, cell="", start_ms=start_ms + i) for i in range(4) for name in SIZES_MM],
    )
    added, more, report, *others, again = typed(PAGE)
    assert "24 grasps of 4 files added to fleet; 0 files" in added
    assert "12 grasps of 1 files added to fleet; 4 files" in more
    assert "no object was confused" in report
    assert "no object needs more grasps" in report
    assert Path("archive.html").exists()
    assert "press 4" in Path("press-4.html").read_text()
    assert any("left out in turn: named rightly" in one for one in others)
    assert any("more of 8 grasps rightly" in one for one in others)
    assert "0 grasps of 0 files added to fleet; 4 files" in again
    capsys.readouterr()
    for example in blocks(PAGE, "python"):
        exec(compile(example, PAGE, "exec"), {})
    printed = capsys.readouterr().out
    assert "press 4" in printed
    assert printed.splitlines()[-1] == "12"
