"""A relay damages both lines: the right label or a named error, and the grip is kept."""

import re
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from cell.config.file import changed_config, config_text
from tests.hil.damage import DAMAGES, SMALL, Bench, Damage
from tests.hil.program import LIMIT_S, run

pytestmark = pytest.mark.real_time


@pytest.fixture(scope="module")
def bench(free_machine: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with Bench(tmp_path_factory.mktemp("damage")) as one:
        yield one


def named(damage: Damage) -> str:
    return damage.name if damage.name in SMALL else f"further-{damage.name}"


@pytest.mark.parametrize("damage", DAMAGES, ids=named)
def test_a_job_under_damage_gives_the_right_label_or_a_named_error(
    bench: Bench, damage: Damage
) -> None:
    found = bench.run(damage)
    print(f"{damage.name}: {found}")
    assert found.seconds < LIMIT_S


def test_a_port_on_which_a_gps_receiver_speaks_is_named_with_what_was_heard(
    bench: Bench, tmp_path: Path
) -> None:
    config = tmp_path / "cell.yaml"
    gps = changed_config(bench.config, {"recording.directory": str(tmp_path)})
    config.write_text(config_text(gps))
    bench.drop_plugin()
    relay = bench.relays["servos"]
    relay.order("instead 0.03 sentence")
    began_s = time.monotonic()
    try:
        text = run("release", "--confirm", "-c", config, code=1)
    finally:
        relay.order("pass")
    assert time.monotonic() - began_s < LIMIT_S
    assert f"the servo line ({gps.gripper.port})" in text
    assert re.search(r"heard were \d+ bytes that are no packet, the first are .* \(b'", text), text
    assert "Traceback" not in text
