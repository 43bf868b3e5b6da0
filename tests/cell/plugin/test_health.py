"""Health of a cell: its levels follow the limits of the config."""

import pytest

from cell.data import retention
from cell.plugin.health import health_values
from tests.cell.conftest import small_config
from tests.cell.served import until


@pytest.mark.parametrize(
    ("limit_c", "level"), [(80.0, "ok"), (None, "watch"), (-1.0, "bad")], ids=str
)
def test_heat_is_judged_by_the_limit_and_where_the_current_is_lowered(
    make_bench, limit_c: float | None, level: str
) -> None:
    bench = make_bench().ready()
    warm_c = bench.controller.latest.cycle.state.temperature_c
    limits = {None: warm_c + 1.0, -1.0: warm_c - 1.0}
    limit = {"temperature_max_c": limits.get(limit_c, limit_c)}
    config = bench.config.model_copy(
        update={"gripper": bench.config.gripper.model_copy(update=limit)}
    )
    assert config.gripper.servo_care.derate_c > 1.0
    assert health_values(config, bench.cell, None)["servos"]["level"] == level


def test_lost_frames_are_judged_by_their_limit(make_bench) -> None:
    bench = make_bench(small_config(tactile__loss_max_share=0.5)).ready()
    assert health_values(bench.config, bench.cell, None)["can"]["level"] == "ok"
    bench.simulated.inject("can.lose_next=12")
    bench.idle(0.25)
    can = health_values(bench.config, bench.cell, None)["can"]
    assert can["level"] == "watch"
    strict = small_config(tactile__loss_max_share=0.001)
    assert health_values(strict, bench.cell, None)["can"]["level"] == "bad"


def test_too_little_space_for_the_recording_is_watched(make_bench, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(retention, "free_bytes", lambda _folder: 18_000_000)
    folder, notes = tmp_path / "run-20270115-080000", list[str]()
    folder.mkdir()
    config = small_config(recording__keep_gb=2.0)
    cell = make_bench(config, folder=folder, note=notes.append).cell
    until(lambda: cell.recording_problem)
    recording = health_values(config, cell, None)["recording"]
    assert (recording["level"], [recording["text"]]) == ("watch", notes)
    assert notes[0].startswith(f"the disk of {tmp_path} has less than 500 MB free")
    assert cell._retention._keep_bytes == 2e9
