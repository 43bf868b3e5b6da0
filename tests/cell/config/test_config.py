import json
import os
from pathlib import Path

import jsonschema
import pytest
from ruamel.yaml import YAML

from cell.config.file import (
    MAX_BYTES,
    config_text,
    load_config,
    parse_config,
    recorded_config,
    schema_text,
)
from cell.config.model import CellConfig
from cell.errors import ConfigError

CONFIG_FOLDER = Path(__file__).parents[3] / "config"


def complaint(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, source="cell.yaml")
    return str(caught.value)


def test_without_a_file_it_is_the_simulated_cell() -> None:
    assert load_config(None) == parse_config("", source="x") == CellConfig()
    assert CellConfig().simulated


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["flexitac", "paper-gripper", "pinch-13x6", "two-axes-and-wrist", "uskin"]
)
def test_an_example_is_written_in_full_with_the_schema_named(name) -> None:
    config = load_config(CONFIG_FOLDER / f"{name}.yaml")
    text = config_text(config)
    for written in (text, config_text(config, comments=False)):
        assert parse_config(written, source=name) == config
    assert text.startswith("# yaml-language-server: $schema=tactile-cell.schema.json\n")
    jsonschema.validate(YAML(typ="safe", pure=True).load(text), json.loads(schema_text()))


def test_every_key_of_the_schema_says_what_it_means() -> None:
    def walk(node: object) -> None:
        if isinstance(node, dict):
            for name, entry in node.get("properties", {}).items():
                assert entry.get("description"), f"{name} has no description"
            for entry in node.values():
                walk(entry)

    walk(json.loads(schema_text()))


def test_a_list_with_a_bad_entry_is_not_called_empty() -> None:
    message = complaint("gripper: {servos: [{id: 1, model: XL430-W250}]}\n")
    assert "at least 1 item" not in message


def test_the_written_config_shows_every_key_of_the_schema() -> None:
    text = config_text(CellConfig())
    sections = json.loads(schema_text())
    keys = {
        key
        for section in (sections, *sections["$defs"].values())
        for key in section.get("properties", ())
    }
    assert [key for key in sorted(keys) if f"{key}:" not in text] == []
    assert "One of: parallel_linkage, rack_pinion." in text
    assert "# host_timeout_s:" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("gripper:\n  baud_rate: 9600\n", ["cell.yaml:2", "gripper.baud_rate", "9600"]),
        (
            "gripper:\n  linkage: {kind: rack_pinion, pinion_radius_mm: 9, link_mm: 3}\n",
            ["gripper.linkage.link_mm: unknown key; it is a key of gripper.linkage of kind"],
        ),
        ("tactile: {layout: papr}\n", ["tactile.layout: ", "'papr'", "'paper', 'pinch'"]),
        ("gripper: {servos: [{id: 1, model: XL430-W250}]}\n", ["no Goal Current", "XM430-W350"]),
        ("gripper: {current_max_a: 2.4}\n", ["current_max_a 2.4", "servo 1 (XM430-W350)", "2.3 A"]),
        (
            "tactile: {calibration: {kind: linear, force_per_count_n: 0.001}}\n",
            ["asks for 8 N", "taxel saturates at 0.255 N", "up to 2.04 N"],
        ),
        ("tactile:\n  node_id: '5'\n", ["cell.yaml:2", "tactile.node_id", "'5'"]),
        ("gripper:\n  force_max_n: .nan\n", ["cell.yaml:2", "gripper.force_max_n", "finite"]),
        (
            "gripper:\n  servos:\n    - id: 1\n    - id: 300\n",
            ["cell.yaml:4", "gripper.servos.1.id", "252"],
        ),
        ("gripper:\n  servos:\n    - id: 1\n    - id: 1\n", ["gripper", "[1, 1] repeat"]),
        ("gripper:\n  linkage: {kind: rack_pinion}\n", ["pinion_radius_mm", "required"]),
        ("gripper:\n  contact_force_n: 4\n  force_max_n: 3\n", ["contact_force_n", "force_max_n"]),
        ("gripper:\n  force_max_n: 8.2\n", ["sequence asks for 8 N", "ramps up to 7.81 N"]),
        (
            "gripper: {approach_speed_mm_s: 4.0, contact_timeout_s: 1.0}\n",
            [
                "gripper.contact_timeout_s is 1, but from aperture_open_mm = 18",
                "close in 4.7 s, with approach_speed_mm_s = 4. Write contact_timeout_s 5 or more",
            ],
        ),
        (
            "gripper: {force_max_n: 9, contact_timeout_s: 3, contact: {pad_stiffness_n_mm: 1e3}}\n",
            ["with 6.0 mm/s, the limit by force_max_n, contact.approach_force_n", "timeout_s 4 or"],
        ),
        (
            "gripper: {baud_rate: 115200}\n",
            ["gripper.loop_rate_hz is 200, but gripper.baud_rate = 115200 allows", "most 64 Hz"],
        ),
        (
            "tactile: {bitrate: 250000}\n",
            [
                "at tactile.bitrate = 250000 the control unit loads the bus by up to 171%",
                "85% of tactile.sync_period_ms = 20",
                "Write tactile.bitrate 250000 with tactile.sync_period_ms 43 or more, "
                "or tactile.bitrate 1000000 with tactile.sync_period_ms 10 or more",
            ],
        ),
        (
            "tactile: {bitrate: 125000, force_period_ms: 1}\n",
            ["force_period_ms = 1. Write tactile.bitrate 1000000 with tactile.sync_period_ms 11"],
        ),
        ("sequence:\n  x_mm: [3, 1]\n", ["x_mm", "[3, 1]", "low"]),
        ("sequence:\n  kind: list\n", ["poses"]),
        ("gripper: {port: /dev/ttyUSB0}\n", ["both be `simulated` or both be real"]),
        (
            "gripper: {port: /dev/ttyUSB0}\ntactile: {interface: socketcan}\n",
            ["tactile.channel is empty"],
        ),
        (
            "gripper: {port: /dev/ttyUSB0}\ntactile: {interface: socketcan, channel: can0}\n",
            ["positioner.kind is simulated but the cell is not"],
        ),
        (
            "gripper: {port: /dev/ttyUSB0}\ntactile: {interface: socketcan, channel: can0}\n"
            "positioner: {kind: operator}\nsimulator: {faults: [can.off]}\n",
            ["faults are for the simulated cell, but this cell has real ports"],
        ),
        (
            "simulator:\n  objects:\n    - {label: a, shape: s}\n    - {label: a, shape: s}\n",
            ["repeat"],
        ),
        ("gripper:\n  baud_rate: 1\nseed: -1\n", ["baud_rate", "\n", "cell.yaml:3:1: seed"]),
        ("gripper:\n  force_max_n: 99\n", ["cell.yaml:2:3: gripper.force_max_n: "]),
        ("gripper:\n  forc_max_n: 3\n", ["yaml:2:3: gripper.forc_max_n: unknown key; did "]),
        (
            "gripper:\n  servos:\n    - {id: 1, modl: x}\n",
            ["cell.yaml:3:15: gripper.servos.0.modl: unknown key; did you mean model? "],
        ),
        ("sort: &x {places: [*x]}\n", ["cell.yaml: a key or value is not plain: Circular"]),
        (f"seed: 0x{'f' * 5000}\n", ["cell.yaml: a key or value is not plain: Exceeds the lim"]),
        ("- 1\n", ["cell.yaml:1:1: a config is a mapping"]),
        ("name: !!python/object:os.system x\n", ["not YAML"]),
        ("gripper: {pads_meet: yes}\n", ["gripper.pads_meet: write true or false (found: 'yes')"]),
        ("gripper: {aperture_open_mm: 0.018}\n", ["greater than or equal to 2 mm", "0.018"]),
        ("gripper: {servos: [{id: 1, model: xm430w350}]}\n", ["did you mean XM430-W350?"]),
        ("serve: {modbus_port: 5, http_port: 5}\n", ["are 5, 5: write another port for each"]),
        ("name: " + "[" * 1000 + "]" * 1000 + "\n", ["not YAML", "recursion"]),
    ],
)
def test_complaints_name_line_key_and_limit(text, parts) -> None:
    message = complaint(text)
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("text", "place", "remedy"),
    [
        ('name: "paper\ngripper:\n  force_max_n: 3\n', "1:7", "the closing quote is missing"),
        ("name: 'paper\ngripper:\n  port: '/dev/x'\n", "1:7", "the closing quote is missing"),
        ('gripper:\n  port: "x\n  a: {b: "c"}\n', "2:9", "the closing quote is missing"),
        ('name: "x', "1:7", "the closing quote is missing"),
        ('name: "a" b\n', "1:11", "put the whole value in quotes"),
        ("name: cell: left\n", "1:7", "a colon within a value; put the value in quotes"),
        ("gripper:\n  port:x\n  baud_rate: 57600\n", "2:3", "a colon and a space are missing"),
        ("name: a\nseed 3\nsort: {}\n", "2:1", "a colon and a space are missing"),
        ("gripper:\n  port: x\n   force_max_n: 3\n", "3:4", "the indent fits no line above"),
        ("gripper:\n   port: x\n  force_max_n: 3\n", "3:3", "the indent fits no line above"),
        ("  name: a\nseed: 3\n", "2:1", "the indent fits no line above"),
        ("name: a\n- b\n", "2:1", "the indent fits no line above"),
        ("gripper:\n\tport: x\n", "2:1", "the indent has a tab; use spaces"),
        ("gripper:\n  \tport: x\n", "2:3", "the indent has a tab; use spaces"),
        ("gripper: {port: x\nseed: 3\n", "1:10", "this bracket is not closed"),
        ("gripper: {port: x}}\n", "1:19", "} is not expected here"),
        ("name: @a\n", "1:7", "a value cannot begin with '@'; put the value in quotes"),
        ("name: *a\n", "1:7", "have a meaning in YAML; put the value in quotes"),
        ("name: a\nname: b\n", "2:1", 'the key "name" is written twice; remove one'),
        ('name: "C:\\path"\n', "1:11", "a backslash between double quotes; use single quotes"),
        ("name: a\n---\nname: b\n", "2:1", "one document; remove the line with ---"),
        ("%YAML 1.1\n---\nseed: 010\n", "1:1", "only `%YAML 1.2` is read"),
        ("%YAML 1.3\n---\nseed: 3\n", "1:1", "only `%YAML 1.2` is read"),
        ("name: !!binary aGVsbG8=\n", "1:7", "have a meaning in YAML"),
        ("gripper: !!set {a, b}\n", "1:10", "have a meaning in YAML"),
        ("name: a\nseed: \0\n", "2:7", "save the file as UTF-8"),
    ],
)
def test_text_that_is_not_yaml_is_named_by_its_beginning_with_a_remedy(text, place, remedy):
    message = complaint(text)
    assert message.startswith(f"cell.yaml:{place}: not YAML 1.2: ")
    assert remedy in message


@pytest.mark.parametrize(
    "text",
    [
        "%YAML 1.2\n---\nseed: 3\t# comment\nname: 2001-1-1",
        "\t# comment\nname:\t2001-1-1\t\nseed: 3",
        "sort: {places: []}\t# comment\n\t\nname: '2001-1-1'\t# comment\nseed:\t3\n",
    ],
)
def test_tabs_between_values_dates_and_a_last_line_without_a_break_are_read(text, tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    assert (load_config(path).name, load_config(path).seed) == ("2001-1-1", 3)


@pytest.mark.parametrize(
    ("encoding", "line"), [("latin-1", 2), ("utf-16", 1), ("utf-16-le", 2), ("cp1252", 2)]
)
def test_another_encoding_is_named_with_its_line(encoding, line, tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_bytes("seed: 3\nname: Prüfzelle\n".encode(encoding))
    with pytest.raises(ConfigError, match=rf"cell.yaml:{line}:.* save the file as UTF-8"):
        load_config(path)


def test_missing_unreadable_and_oversized_files_are_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match=r"cannot read config .*check the path"):
        load_config(tmp_path / "none.yaml")
    large = tmp_path / "large.yaml"
    large.write_text("#" * (MAX_BYTES + 1))
    with pytest.raises(ConfigError, match="at most"):
        load_config(large)


def test_what_is_no_plain_file_is_refused_and_not_waited_for(tmp_path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "link.yaml").symlink_to(tmp_path / "pipe.yaml")
    for path in (tmp_path / "pipe.yaml", tmp_path / "link.yaml", Path("/dev/zero"), tmp_path):
        with pytest.raises(ConfigError, match="not a plain file"):
            load_config(path)


@pytest.mark.parametrize(
    "text",
    [
        'name: "a\\0b"',
        'name: "\\e[2Jempty screen"',
        'name: "two\\nlines"',
        'name: "\u202efdp.exe"',
        'sort: {reject: "\\a"}',
        'sort: {places: [{label: ball, place: "\\e[31m"}]}',
        'recording: {directory: "\\e]0;title\\a"}',
        'simulator: {faults: ["\\r"]}',
        'gripper: {port: "/dev/\\x9b"}',
    ],
)
def test_texts_that_a_terminal_would_obey_are_refused(text) -> None:
    said = complaint(text + "\n")
    assert "cannot be printed" in said or "not YAML" in said
    assert said.isprintable()


def test_a_config_of_no_format_is_refused_and_a_recorded_one_that_is_not_valid_is_none() -> None:
    assert parse_config("format: tactile-cell-config/1\n", source="x") == CellConfig()
    with pytest.raises(ConfigError, match=r"its format is '1', but .* reads tactile-cell-config/1"):
        parse_config("format: 1\n", source="x")
    assert [recorded_config(text) for text in ("", "[1]", '{"seed": "x"}')] == [None] * 3
