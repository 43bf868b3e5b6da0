import json
import os
import re
from collections.abc import Iterator
from contextlib import nullcontext
from operator import attrgetter
from pathlib import Path
from typing import Any, get_args

import jsonschema
import numpy as np
import pytest
from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from ruamel.yaml import YAML

from cell.config.file import (
    MAX_BYTES,
    SHORT_KEYS,
    changed_config,
    config_text,
    load_config,
    parse_config,
    recorded_config,
    schema_text,
)
from cell.config.model import CellConfig
from cell.config.positioner import ServoAxisConfig
from cell.config.section import Declared
from cell.config.tactile import LayoutName, PadConfig, PadsConfig, TactileConfig, layout_from_config
from cell.errors import ConfigError
from cell.files import CONFIG
from cell.sensors.flexitac import FlexiTacConfig
from cell.simulation import simulation_of
from tactile.flexitac import PROFILES
from tactile.layout import LAYOUTS
from tests.faults.campaign import (
    CHANGES,
    ROTATION_AXIS,
    WRIST,
    X_AXIS,
    campaign_cell,
    campaign_config,
)
from tests.marks import LONG

CONFIG_FOLDER = Path(__file__).parents[3] / "config"


def test_without_a_file_it_is_the_simulated_cell() -> None:
    assert load_config(None) == parse_config("", source="x") == CellConfig()
    assert CellConfig().simulated


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["two-axes-and-wrist", *map(LONG, ("flexitac", "paper-gripper", "pinch-13x6", "uskin"))]
)
def test_an_example_is_written_in_full_with_the_schema_named(name) -> None:
    changes = {"recording.keep_gb": None}
    config = changed_config(load_config(CONFIG_FOLDER / f"{name}.yaml"), changes)
    text = config_text(config)
    for written in (text, config_text(config, comments=False)):
        assert parse_config(written, source=name) == config
    assert text.startswith("# yaml-language-server: $schema=tactile-cell.schema.json\n")
    jsonschema.validate(YAML(typ="safe", pure=True).load(text), json.loads(schema_text()))


@pytest.mark.parametrize(
    ("section", "key", "names"),
    [(FlexiTacConfig, "profile", PROFILES), (CellConfig, "format", [str(CONFIG)])],
)
def test_choices_are_those_of_the_part_that_they_set(section, key, names) -> None:
    assert set(get_args(section.model_fields[key].annotation)) == set(names)
    assert set(get_args(LayoutName)) == set(LAYOUTS)


def test_an_axis_needs_a_servo_that_turns() -> None:
    axis = {"kind": "dynamixel", "moves": "roll", "low": 0.0, "high": 90.0}
    assert ServoAxisConfig(**axis, model="XL330-M288").model == "XL330-M288"
    with pytest.raises(ValueError, match="is a gripper: an axis needs a servo that turns"):
        ServoAxisConfig(**axis, model="RH-P12-RN(A)")


def test_the_written_config_shows_every_key_of_the_schema_and_each_says_what_it_means() -> None:
    text, sections = config_text(CellConfig()), json.loads(schema_text())
    for section in (sections, *sections["$defs"].values()):
        for key, described in section.get("properties", {}).items():
            assert f"{key}:" in text
            assert described.get("description"), f"{key} has no description"
    assert "One of: parallel_linkage, rack_pinion." in text
    assert "# host_timeout_s:" in text


def test_a_short_config_has_the_keys_that_users_set_with_their_meaning() -> None:
    text = config_text(CellConfig(), keys=SHORT_KEYS)
    assert parse_config(text, source="short") == CellConfig()
    keys = [line.split(":")[0] for line in text.splitlines() if re.match(r" *\w+:", line)]
    assert [key for key in SHORT_KEYS if key.rpartition(".")[2] not in map(str.strip, keys)] == [
        "serve.http_port"
    ]
    assert len(keys) < 40 < text.count("#")
    assert "# http_port:" in text
    assert "baud_rate" not in text


PORT = "gripper: {port: /dev/ttyUSB0}\n"
CAN = PORT + "tactile: {interface: socketcan, channel: can0}\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("gripper:\n  baud_rate: 9600\n", ["cell.yaml:2", "gripper.baud_rate", "9600"]),
        (
            "gripper:\n  linkage: {kind: rack_pinion, pinion_radius_mm: 9, link_mm: 3}\n",
            ["gripper.linkage.link_mm: unknown key; keys here are kind, pinion_radius_mm"],
        ),
        ("tactile: {layout: papr}\n", ["tactile.layout: ", "'papr'", "'paper', 'pinch'"]),
        ("gripper: {servos: [{id: 1, model: XL430-W250}]}\n", ["no Goal Current", "XM430-W350"]),
        ("gripper: {current_max_a: 2.4}", ["a is 2.4 A, servo 1 (XM430-W350) makes at most 2.3 A"]),
        (
            "tactile: {calibration: {counts: [1], force_n: [0.001]}}\n",
            ["asks for 8 N", "taxel saturates at 0.255 N", "up to 2.04 N"],
        ),
        ("gripper:\n  force_max_n: .nan\n", ["cell.yaml:2", "gripper.force_max_n", "finite"]),
        ("gripper:\n  servos:\n    - id: 1\n    - id: 300\n", ["yaml:4", "servos.1.id", "252"]),
        ("gripper: {approach_speed_mm_s: 4, contact_timeout_s: 1}\n", ["1:35: ", "4.7 s", "5 or"]),
        ("gripper: {loop_rate_hz: 100, bus_loss_ms: 20}\n", ["s is 0.02,", "at least 0.04"]),
        (
            "gripper: {temperature_max_c: 75, servos: [{id: 1, model: XL330-M288}]}\n",
            ["temperature_max_c is 75.0, must be finite and at most 70"],
        ),
        ("gripper: {baud_rate: 115200}\n", ["1:11: gripper.b", "115200 allows", "most 64 Hz"]),
        (
            "sequence:\n  max_grasps: 3\n  force_n: [1, 14]\n",
            ["3:3: sequence.force_n: ", "at most 13.64 N", "asks for 14.0 N: lower it, or raise"],
        ),
        ("sequence: {carry_force_n: 14}\n", ["1:12: sequence.carry_force_n: ", "14.0 N: lower it"]),
        ("tactile: {bitrate: 250000}\n", ["up to 171%", "period_ms 43 or", "period_ms 10 or more"]),
        ("recording: {directory: ~/out}\n", ["recording.directory: ~ is not your home folder"]),
        ("sequence:\n  x_mm: [3, 1]\n", [".x_mm: [3, 1] is not [low, high] with -100 <= low"]),
        ("sequence: {regrasp: none, force_n: [1.7, 8]}\n", ["contact_force_n = 0.6 N times 3"]),
        ("gripper: {port: /dev/ttyUSB0}\n", ["must all be `simulated` or all be real"]),
        (PORT + "tactile: {interface: socketcan}\n", ["tactile.channel is empty"]),
        (CAN, ["positioner.kind is simulated but the cell is not"]),
        (CAN + "simulator: {faults: [can.off]}\n", ["faults are not for a cell with real ports"]),
        ("simulator: {objects: [{label: a, shape: s}, {label: a, shape: s}]}\n", ["repeat"]),
        ("gripper:\n  baud_rate: 1\nseed: -1\n", ["baud_rate", "\n", "cell.yaml:3:1: seed"]),
        ("gripper:\n  forc_max_n: 3\n", ["yaml:2:3: gripper.forc_max_n: unknown key; did "]),
        ("gripper:\n  servos:\n    - {id: 1, modl: x}\n", ["yaml:3:15: gripper", "mean model? "]),
        ("sort: &x {places: [*x]}\n", ["cell.yaml: a key or value is not plain: Circular"]),
        (f"seed: 0x{'f' * 5000}\n", ["cell.yaml: a key or value is not plain: Exceeds the lim"]),
        ("- 1\n", ["cell.yaml:1:1: a config is a mapping"]),
        ("name: !!binary aGVsbG8=\n", ["a key or value is not plain", "bytes"]),
        ("name: a\nseed: \0\n", ["not YAML 1.2: unacceptable character #x0000"]),
        ("name: cell: left\n", ["cell.yaml:1:11: not YAML 1.2: mapping values are not allowed"]),
        ("name: a\nname: b\n", ["cell.yaml:2:1: not YAML", 'found duplicate key "name"']),
        ("gripper: {pads_meet: yes}", ["meet: Input should be a valid boolean (found: 'yes')"]),
        ("gripper: {servos: [{id: 1, model: xm430w350}]}\n", ["did you mean XM430-W350?"]),
        ("serve: {modbus_port: 5, http_port: 5}\n", ["http_port repeat 5: write another one"]),
        ("name: " + "[" * 600 + "]" * 600 + "\n", ["not YAML", "recursion"]),
        # What a terminal would obey.
        ('name: "\\e[2Jempty screen"', ["cannot be printed"]),
        ('gripper: {port: "/dev/\\x9b"}', ["cannot be printed"]),
        ("serve: {hosts: ['cell.lan:80']}", ["'cell.lan:80' is not a host name"]),
        ("serve: {listen: 0.0.0.0}", ["serve.listen is 0.0.0.0 and serve.allow is empty"]),
        ("serve: {listen: localhost}", ["serve.listen: 'localhost' does not appear to be an IPv4"]),
        ("serve: {allow: [everyone]}", ["serve.allow.0: 'everyone' does not appear to be an IPv4"]),
        ("serve: {tls_key: key.pem}", ["set both serve.tls_certificate and serve.tls_key"]),
        ("serve: {objects: [ball, ball]}", ["labels of serve.objects repeat ball"]),
        ("serve: {modbus_port: 65536}", ["less than or equal to 65535"]),
    ],
)
def test_complaints_name_line_key_and_limit(text, parts) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, source="cell.yaml")
    message = str(caught.value)
    assert "at least 1 item" not in message
    assert message.replace("\n", "").isprintable()
    for part in parts:
        assert part in message


def test_dates_and_a_last_line_without_a_break_are_read(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text("# comment\nseed: 3 # comment\ngripper: {port: simulated}\nname: 2001-1-1")
    assert (load_config(path).name, load_config(path).seed) == ("2001-1-1", 3)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("seed: 3\nname: Prüfzelle\n".encode("latin-1"), "cell.yaml:2:.* save the file as UTF-8"),
        ("seed: 3\n".encode("utf-16"), "cell.yaml:1:.* save the file as UTF-8"),
        (b"#" * (MAX_BYTES + 1), "at most"),
        (None, "cannot read config .*check the path"),
        # A real cell whose file was cut, or emptied.
        (b"name: press 4\n", "gripper.port is missing"),
        (b"", "gripper.port is missing"),
    ],
)
def test_files_that_are_no_text_or_too_large_are_refused(content, says, tmp_path):
    if content is not None:
        (tmp_path / "cell.yaml").write_bytes(content)
    with pytest.raises(ConfigError, match=says):
        load_config(tmp_path / "cell.yaml")


def test_what_is_no_plain_file_is_refused_and_not_waited_for(tmp_path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "link.yaml").symlink_to(tmp_path / "pipe.yaml")
    for path in (tmp_path / "pipe.yaml", tmp_path / "link.yaml", Path("/dev/zero"), tmp_path):
        with pytest.raises(ConfigError, match="not a plain file"):
            load_config(path)


def test_a_config_of_no_format_is_refused_and_a_recorded_one_that_is_not_valid_is_none() -> None:
    assert parse_config("format: tactile-cell-config/1\n", source="x") == CellConfig()
    with pytest.raises(ConfigError, match=r"its format is '1', but .* reads tactile-cell-config/1"):
        parse_config("format: 1\n", source="x")
    assert [recorded_config(text) for text in ("", "[1]", '{"seed": "x"}')] == [None] * 3


# -- Sections: gripper, pads and axes; what reaches them, and what is refused ----------------------


def declared(section: BaseModel, path: str) -> Iterator[tuple[str, FieldInfo, Declared]]:
    """Return each key below a path that stands for a setting of the gripper."""
    for name, key in type(section).model_fields.items():
        value, here = getattr(section, name), f"{path}.{name}"
        if isinstance(value, BaseModel):
            yield from declared(value, here)
        yield from ((here, key, link) for link in key.metadata if isinstance(link, Declared))


KEYS = [*declared(CellConfig().gripper, "gripper"), *declared(CellConfig().loop, "loop")]


@pytest.mark.parametrize(("path", "key", "link"), KEYS, ids=[path for path, _, _ in KEYS])
def test_a_key_has_the_default_of_its_setting_and_reaches_it(path, key, link) -> None:
    plain, reached = getattr(link.owner(), link.name), attrgetter(f"gripper_settings.{link.name}")
    assert reached(CellConfig()) == pytest.approx(plain)
    other = key.default + 1 if isinstance(key.default, int) else 0.98 * key.default
    assert reached(changed_config(CellConfig(), {path: other})) == pytest.approx(other * link.unit)


def test_the_channel_of_an_adapter_may_be_its_number() -> None:
    assert parse_config("tactile: {channel: 0}", source="test").tactile.channel == "0"
    with pytest.raises(ConfigError, match=r"tactile\.channel"):
        parse_config("tactile: {channel: true}", source="test")


def pad(finger: Any, face: Any = "inner", rows: int = 4, columns: int = 3) -> PadConfig:
    return PadConfig(
        finger=finger, face=face, rows=rows, columns=columns, pitch_x_mm=2.0, pitch_y_mm=3.0
    )


def spelled(*pads: PadConfig, adc_max: int = 1023) -> TactileConfig:
    return TactileConfig(layout=PadsConfig(name="own", pads=pads, adc_max=adc_max))


def test_own_pads_become_a_layout() -> None:
    layout = layout_from_config(spelled(pad(0), pad(0, "tip", 2, 2), pad(1, rows=5)))
    assert (layout.name, layout.n_taxels) == ("own", 12 + 4 + 15)
    assert layout.pad_shape.tolist() == [[4, 3], [2, 2], [5, 3]]
    assert layout.gripping_pads == (0, 2)
    assert (layout.adc_max, layout.sample_bits) == (1023, 16)
    steps_m = np.diff(layout.taxel_xy_m[:4], axis=0)
    np.testing.assert_allclose(np.abs(steps_m[0]), [0.0, 3e-3], atol=1e-12)
    assert layout_from_config(spelled(pad(0), pad(1), adc_max=255)).sample_bits == 8


def test_pads_that_make_no_gripper_are_a_config_error() -> None:
    with pytest.raises(ConfigError, match=r"tactile\.layout: layout own"):
        layout_from_config(spelled(pad(0, "tip"), pad(1)))


REAL = {"gripper.port": "/dev/ttyUSB0", "tactile.interface": "socketcan", "tactile.channel": "can0"}
TURN = WRIST | {"port": "/dev/ttyUSB1"}


def positioner(*axes: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"positioner": {"kind": "axes", "axes": list(axes)} | more}


X, TURNED, ONLY = X_AXIS, ROTATION_AXIS, "positioner.kind axes needs positioner.axes; other"
ON_CAN1 = {"interface": "socketcan", "channel": "can1"}
PCAN = {"interface": "pcan", "channel": "PCAN_USBBUS1"}
ASKED = {"sequence.poses": [{"y_mm": 1.0}]}
SMALL = [{"id": number, "model": "XL330-M288"} for number in (1, 2)]
WEAK = {"gripper.servos": SMALL, "sequence.carry_force_n": 1.5}
SLOW_FRAMES = {"tactile.force_period_ms": 0, "tactile.sync_period_ms": 45.0}


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        (positioner(), ONLY),
        ({"positioner": {"kind": "operator", "axes": [X]}}, ONLY),
        (positioner(X, X | {"node_id": 3}), "moves of positioner.axes repeat x"),
        (positioner(X, TURNED | {"node_id": 11}), "node-IDs of positioner.axes repeat 11"),
        (positioner(X | {"low": 6.0}), "axis x has the limits 6 to 6; low must be below high"),
        (positioner(X | {"increments": 0.0}), "axis x has 0 increments per mm"),
        (positioner(X | {"increments": 9e8}), "limits that fit into 32 bits"),
        (positioner(WRIST | {"high": 351.0}), "more than one turn of its servo"),
        (positioner(X), r"sequence.rotation_deg asks for 0 to 90; no axis moves it: write"),
        (
            positioner(X | {"high": 1.0}, TURNED, WRIST),
            "sequence.x_mm asks for -2 to 2; its axis goes from -6 to 1",
        ),
        (ASKED, "sequence.y_mm asks for 1 to 1; no axis moves it"),
        ({"sort.reject_pose": {"x_mm": -18.0}}, "sort.reject_pose.x_mm asks for -18"),
        (WEAK | {"sequence.force_n": [0.7, 2.0]}, "gripper: moving the fingers takes"),
        (SLOW_FRAMES, "needs a frame every 40 ms: lower it, or set tactile.force_period_ms"),
        (positioner(X, TURNED, WRIST, can={"interface": "slcan"}), "must all be `simulated` or"),
        (
            REAL | positioner(X, TURNED, WRIST | {"port": "/dev/ttyUSB0"}, can=ON_CAN1),
            "gripper.port and port of the axis roll are /dev/ttyUSB0",
        ),
        (
            REAL | positioner(TURN, TURN | {"moves": "x", "high": 90.0}),
            "port of the axis roll and port of the axis x are /dev/ttyUSB1",
        ),
        (
            REAL | positioner(X | {"node_id": 5}, TURNED, TURN, can=ON_CAN1 | {"channel": "can0"}),
            "a drive of positioner and the control unit have the node-ID 5",
        ),
        (
            REAL | positioner(X, TURNED, TURN, can=PCAN) | {f"tactile.{k}": PCAN[k] for k in PCAN},
            "only socketcan shares it, this is pcan",
        ),
    ],
)
def test_what_does_not_fit_together_is_refused(changes: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        changed_config(CellConfig(), CHANGES | changes)


# -- The ends of the range of each key: the cell works there, or that key is refused ---------------


_ELSEWHERE = ("serve.", "positioner.", "sort.", "recognition.", "loop.", "seed", "host_timeout_s")
"""Keys of no effect on a grasp in virtual time; their ends are still read."""
_MINUTES = ("sequence.ramp.hold_s=60",)
"""Ends that do nothing but let time pass."""
_BOUND_S = 60.0
"""Longest simulated time of a start and a grasp in s."""
_MORE_KEYS: dict[str, dict[str, Any]] = {
    "gripper.aperture_open_mm=2": {
        "simulator.objects": [{"label": "ball", "shape": "box:length=20mm,width=10mm,height=1.5mm"}]
    },
    "sequence.ramp.rate_n_s=0.1": {"sequence.force_n": [1.0, 1.5]},
    "simulator.noise_level=2.5": {"gripper.contact_force_n": 1.5, "tactile.tare_frames": 50},
}
"""What an end needs beside it: because of the object, the short tare, or the time of a ramp."""
_USUAL = CellConfig()
_NEEDED_A = max(
    path.loading_current_a(max(_USUAL.sequence.forces_n))
    for path in _USUAL.mechanics.end_transmissions()
)
REFUSED = {
    "gripper.linkage.link_mm=5": "aperture_open_mm is beyond gripper.linkage, its lengths",
    "gripper.linkage.link_mm=500": "lower the force or shorten the lever of the linkage",
    "gripper.aperture_open_mm=400": "aperture_open_mm is beyond gripper.linkage",
    "gripper.aperture_min_mm=400": "aperture_min_mm 400 must be below aperture_open_mm 16",
    "gripper.contact_force_n=5": "gripper.contact_force_n = 5 N to hold a part",
    "gripper.contact_timeout_s=1": "contact_timeout_s is 1, but from aperture_open_mm = 16",
    "gripper.force_max_n=1": "gripper: force_max_n is 1 N: .* Raise force_max_n",
    "gripper.current_max_a=0.05": f"8.0 N take {_NEEDED_A:.3f} A, current_max_a is 0.05 A",
    "sequence.carry_force_n=0.1": "carry_force_n is 0.1 N; it must be at least",
    "sequence.carry_force_n=50": "at most 13.64 N, .* the ramp asks for 50.0 N",
}
"""Ends that the defaults of other keys forbid, and what is said of them."""


def ends(section: BaseModel, path: str = "") -> Iterator[tuple[str, float]]:
    """Return the lowest and the highest value of each number; just inside of what is excluded."""
    for name, key in type(section).model_fields.items():
        value, here = getattr(section, name), f"{path}{name}"
        if isinstance(value, BaseModel):
            yield from ends(value, f"{here}.")
        for bound in key.metadata:
            if isinstance(bound, Ge | Le):
                limit: Any = bound.ge if isinstance(bound, Ge) else bound.le
                yield here, limit
            elif isinstance(bound, Gt | Lt):
                yield here, bound.gt + 1e-6 if isinstance(bound, Gt) else bound.lt - 1e-6


ENDS = {f"{path}={value:g}": {path: value} for path, value in ends(_USUAL)}
"""Change of the config by the name of each end."""


def changes_at(end: str) -> dict[str, Any]:
    """Return the changes of a config with short jobs and a key at its end."""
    return {"gripper.aperture_open_mm": 16.0} | _MORE_KEYS.get(end, {}) | ENDS[end]


GRASPED = tuple(
    end for end in ENDS if not end.startswith(_ELSEWHERE) and end not in (*_MINUTES, *REFUSED)
)
"""Accepted ends that matter for a grasp."""


@pytest.mark.slow
def test_all_ends_are_accepted_but_those_that_others_forbid() -> None:
    complaints = dict(REFUSED)
    for end in ENDS:
        complaint = complaints.pop(end, "")
        with pytest.raises(ConfigError, match=complaint) if complaint else nullcontext():
            config = campaign_config(changes_at(end))
            if end.startswith("simulator."):
                simulation_of(config).close()
    assert complaints == {}


@pytest.mark.long
@pytest.mark.parametrize("end", GRASPED)
def test_a_grasp_is_done_at_the_end(end) -> None:
    with campaign_cell(changes_at(end)) as cell, cell.monitor.bounded(_BOUND_S):
        cell.start()
        cell.grasp(cell.config.sequence.forces_n[0])


@pytest.mark.parametrize(("bitrate", "period_ms"), [(250_000, 43), (500_000, 20), (1_000_000, 10)])
def test_each_frame_is_through_in_the_shortest_period_of_a_bit_rate(
    make_bench, bitrate, period_ms
) -> None:
    keys = {"self_zero": "never", "tactile.bitrate": bitrate, "tactile.tare_frames": 50}
    with pytest.raises(ConfigError, match=f"tactile.sync_period_ms {period_ms} or more"):
        changed_config(CellConfig(), keys | {"tactile.sync_period_ms": period_ms - 1.0})
    config = changed_config(CellConfig(), keys | {"tactile.sync_period_ms": float(period_ms)})
    assert make_bench(config).start().controller.hand.statistics.source.frames.lost == 0
