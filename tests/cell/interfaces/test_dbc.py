"""An independent witness: cantools decodes a whole simulated grasp by our DBC file."""

from collections import Counter
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from canopen.emcy import EMCY_STRUCT
from typer.testing import CliRunner

from cell.config.file import config_text
from cell.interfaces.cli.app import app
from simulator.can.messages import BurstFormat, force_bytes
from tactile.frames.codec import FrameFormat, crc16_ccitt
from tactile.layout import Pad, TaxelLayout, paper_layout, pinch_layout
from tactile.source import ForceMessage, ForceStatus
from tactile.unit.dbc import dbc_text
from tests.cell.conftest import small_config

NODE = 5
HEARTBEAT_STATES = {0: "boot-up", 4: "stopped", 5: "operational", 127: "pre-operational"}


def database(layout: TaxelLayout) -> Any:
    """Return the file as cantools reads it, overlaps and lengths checked."""
    text = dbc_text(layout, node_id=NODE, sync_period_ms=20, heartbeat_ms=100, force_period_ms=3)
    assert text.isascii()
    return cantools.database.load_string(text, database_format="dbc", strict=True)


def whole_sample(found: dict[str, Any], name: str) -> int:
    if name in found:
        return int(found[name])
    return int(found[f"{name}_low"]) + 256 * int(found[f"{name}_high"])


class Listener:
    """Collects frames from decoded signals; knows nothing of the transport but the DBC file."""

    def __init__(self, layout: TaxelLayout) -> None:
        self.message = database(layout).get_message_by_name("TactileFrame")
        digits = len(str(layout.n_taxels - 1))
        self.names = [f"taxel_{i:0{digits}}" for i in range(layout.n_taxels)]
        self.found: dict[str, Any] = {}

    def take(self, data: bytes) -> dict[str, Any] | None:
        """Return all signals of a frame after its last message."""
        signals = self.message.decode(data, decode_choices=False)
        if signals["frame_index"] == 0:
            self.found = {}
        self.found |= signals
        return self.found if "frame_crc" in signals else None

    def counts(self, found: dict[str, Any]) -> np.ndarray:
        return np.array([whole_sample(found, name) for name in self.names], dtype=np.uint16)


@pytest.mark.parametrize("layout", [paper_layout(), pinch_layout()], ids=lambda one: one.name)
def test_a_whole_grasp_decodes_to_the_same_samples(layout: TaxelLayout, make_bench: Any) -> None:
    bench = make_bench(small_config(tactile__layout=layout.name))
    traffic: list[tuple[int, bytes]] = []
    bench.simulated.can_bus.capture.append(
        lambda _t_s, can_id, data: traffic.append((can_id, data))
    )
    record = bench.ready().grasp(4.0)
    frames = bench.cell.controller.hand.statistics.source.frames.complete
    bench.cell.close()
    bench.simulated.can_bus.flush()

    listener, known = Listener(layout), database(layout)
    names: Counter[str] = Counter()
    scans = []
    for can_id, data in traffic:
        decoded = known.decode_message(can_id, data)
        name = known.get_message_by_frame_id(can_id).name
        names[name] += 1
        if name == "Heartbeat":
            assert decoded["nmt_state"] == HEARTBEAT_STATES[data[0]]
        if name == "TactileFrame" and (found := listener.take(data)) is not None:
            scans.append(listener.counts(found))
    assert names["TactileFrame"] == FrameFormat.of(layout).n_messages * len(scans)
    assert set(names) == {
        *("NMT", "SYNC", "Heartbeat", "SdoRequest", "SdoResponse", "TactileFrame", "PadForces")
    }
    assert len(scans) in (frames, frames + 1)
    counts = np.stack(scans)
    assert counts.max() > 0.3 * layout.adc_max
    # What the job has kept of the grasp is among it, in order.
    last = np.flatnonzero((counts == record.grasp.counts[-1]).all(axis=1))[-1]
    np.testing.assert_array_equal(
        counts[last + 1 - record.grasp.n_frames : last + 1], record.grasp.counts
    )


LONG = TaxelLayout(
    name="long header",
    pads=tuple(
        Pad(
            name=f'finger{finger}."inner"',
            finger=finger,
            face="inner",
            rows=40,
            columns=20,
            pitch_x_m=1e-3,
            pitch_y_m=1e-3,
        )
        for finger in (0, 1)
    ),
    sample_bits=16,
    adc_max=65535,
)


@pytest.mark.parametrize("layout", [paper_layout(), pinch_layout(), LONG], ids=lambda one: one.name)
def test_any_samples_decode_and_carry_their_checksum(layout: TaxelLayout) -> None:
    form, listener = FrameFormat.of(layout), Listener(layout)
    rng = np.random.default_rng(7)
    for counter, status in ((0, 0), (0xFFFE, 3), (0x1235, 255)):
        counts = rng.integers(0, layout.adc_max + 1, layout.n_taxels).astype(np.uint16)
        messages = BurstFormat(form.n_taxels, form.sample_bytes).burst(counts, counter, status)
        *before, found = [listener.take(data) for data in messages]
        assert before == [None] * (form.n_messages - 1)
        assert found is not None
        np.testing.assert_array_equal(listener.counts(found), counts)
        assert (found["frame_counter"], found["frame_status"]) == (counter, status)
        assert found["frame_phase"] == counter % 4
        checked = b"".join(data[form.header_bytes :] for data in messages)[:-2]
        assert found["frame_crc"] == crc16_ccitt(checked)


def test_a_short_message_is_refused() -> None:
    with pytest.raises(cantools.database.DecodeError):
        database(paper_layout()).decode_message(0x380 + NODE, bytes(5))


def test_the_other_messages_say_what_they_mean() -> None:
    known = database(paper_layout())
    emergency = EMCY_STRUCT.pack(0xFF01, 0x81, b"\x01\0\0\0\0")
    decoded = known.decode_message(0x080 + NODE, emergency)
    assert str(decoded["emcy_code"]).startswith("a burst was cut short")
    assert (decoded["emcy_register"], decoded["emcy_manufacturer"]) == (0x81, 1)
    assert known.decode_message(0x000, bytes((1, NODE))) == {
        "nmt_command": "start",
        "nmt_node": NODE,
    }
    assert known.decode_message(0x080, b"") == {}
    assert known.get_message_by_name("SYNC").cycle_time == 20
    assert known.get_message_by_name("Heartbeat").cycle_time == 100
    request = known.decode_message(0x600 + NODE, bytes.fromhex("4018100100000000"))
    assert (request["sdo_request_index"], request["sdo_request_subindex"]) == (0x1018, 1)
    taxel = known.get_message_by_name("TactileFrame").get_signal_by_name("taxel_205")
    assert taxel.comment == "finger1.inner, row 0, column 1"
    assert (taxel.unit, taxel.maximum) == ("count", 255)


def test_a_force_message_decodes() -> None:
    data = force_bytes(
        ForceMessage(
            t_s=0.0,
            counter=9,
            status=ForceStatus.ZEROED | ForceStatus.SATURATED,
            force_n=(3.25, -0.014),
            centre_taxels=(-2.5, 0.75),
        )
    )
    assert database(paper_layout()).decode_message(0x280 + NODE, data) == {
        "force_counter": 9,
        "force_status": 3,
        "force_finger0": pytest.approx(3.25),
        "force_finger1": pytest.approx(-0.014),
        "centre_along": -2.5,
        "centre_across": 0.75,
        "force_crc": data[-1],
    }


def test_a_unit_without_force_messages_sends_its_frames_where_they_always_were() -> None:
    text = dbc_text(paper_layout(), node_id=NODE)
    known = cantools.database.load_string(text, database_format="dbc", strict=True)
    assert known.get_message_by_name("TactileFrame").frame_id == 0x180 + NODE
    assert "PadForces" not in text


def test_the_command_writes_the_file_of_a_config(tmp_path: Path) -> None:
    config, output = tmp_path / "cell.yaml", tmp_path / "cell.dbc"
    config.write_text(config_text(small_config(tactile__layout="pinch", tactile__node_id=9)))
    call = CliRunner().invoke
    assert call(app, ["dbc", "-c", str(config), "-o", str(output)]).exit_code == 0
    assert call(app, ["dbc", "-c", str(config)]).stdout == output.read_text(encoding="ascii")
    frame = cantools.database.load_file(output, strict=True).get_message_by_name("TactileFrame")
    assert frame.frame_id == 0x389
    assert frame.get_signal_by_name("taxel_155").multiplexer_ids == [44]


def test_a_node_that_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="node-ID is 128, must be 1 to 127"):
        dbc_text(paper_layout(), node_id=128)
