"""Fuzz targets of what people write: configs, requests, shapes, meshes."""

import itertools
import json
import math
import random
import struct
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._fuzz_archives import Folder
from benchmarks._fuzz_engine import Broken, Target
from benchmarks._fuzz_mutate import mutated
from cell.config import CellConfig
from cell.config_file import config_text, parse_config
from cell.errors import ConfigError
from simulator.assembly import CellDevices
from simulator.commands import CellCommands
from simulator.errors import SimulatorSettingsError
from simulator.mesh import load_mesh
from simulator.positioner_server import PositionerServer
from simulator.settings import SimulatorSettings
from simulator.shape_text import parse_shape
from simulator.shapes import PAPER_OBJECTS

_YAML = (
    "[", "]", "{", "}", "- ", ": ", "? ", "&a ", "*a", "<<: ", "!!binary ", "!!set ", "!!omap ",
    "!!timestamp ", "!!python/object/apply:os.system ", "!x ", "| ", "> ", "'", '"', "\\x", "# ",
    "%YAML 1.1\n", "---\n", "...\n", ".inf", ".nan", "1e999", "0x1F", "1_0", "2001-01-01", "~",
    "null", "yes", "true", "9" * 400, "\t", "\0", "\ud7ff", "\u2028", "\ufeff", "-1", "0o7",
)  # fmt: skip
_NUMBERS = (0, -1, 1, 0.5, 1e308, -1e308, 1e-320, 10**400, 1 << 64, True, None, "1", [], {})


class ConfigTrial:
    """Configs: whole ones and their sections, with damaged text and pieces of YAML."""

    def __init__(self) -> None:
        whole = config_text(CellConfig(), comments=False)
        lines = whole.splitlines(keepends=True)
        starts = [i for i, line in enumerate(lines) if line[0] not in " -\n#"] + [len(lines)]
        self.parts = [
            "".join(lines[a:b])
            for a, b in itertools.pairwise(starts)
            if sum(map(len, lines[a:b])) < 500
        ]
        if len(self.parts) < 3:
            raise Broken("the config has too few sections to change")

    def generate(self, rng: random.Random) -> str:
        text = rng.choice(self.parts)
        chance = rng.random()
        if chance < 0.35:
            return mutated(rng, text.encode()).decode("utf-8", errors="replace")
        if chance < 0.5:
            return "".join(rng.choices(_YAML, k=rng.randint(1, 12)))
        if chance < 0.52:
            return rng.choice("[{-?&") * rng.randint(1, 3000)
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(len(text))
            text = text[:at] + rng.choice(_YAML) + text[at + rng.randrange(3) :]
        return text

    def check(self, item: str) -> str:
        try:
            config = parse_config(item, source="x")
        except ConfigError:
            return "refused: ConfigError"
        _finite(config.model_dump())
        return "read: a valid config"


def _finite(value: Any) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise Broken(f"a config with {value}")
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list | tuple):
        for entry in value:
            _finite(entry)


class RequestTrial:
    """Lines for the positioner's socket, carried out by the commands of a simulated cell."""

    def __init__(self) -> None:
        self.folder = Folder()
        self._begin()
        self.requests = [
            {"state": True},
            {"remove": True},
            {"place": "ball", "pose": {"x_m": 0.001, "rotation_rad": 0.1}},
            {"fault": "can.drop_rate", "value": 0.01},
            {"fault": "servo_wire.delay_s", "value": 0.01},
            {"fault": "unit.stuck_taxels", "value": {"3": 5}},
            {"fault": "unit.dead_taxels", "value": [1, 2]},
            {"servo": 1, "do": "overheat", "value": 70.0},
            {"servo": 1, "do": "hardware_error", "value": 32},
            {"emergency": 0x8110},
            {"play": 0},
            {"power_cycle": True},
            {"unplug": "can"},
        ]
        self.lines = [json.dumps(request).encode() for request in self.requests]

    def _begin(self) -> None:
        self.used = 0
        self.devices = CellDevices(SimulatorSettings())
        self.devices.unit.connect(lambda ready_s, _can_id, _burst: ready_s)
        self.devices.unit.advance(0.1)
        nothing = (lambda: None, lambda: None)
        handle = CellCommands(self.devices, {"can": nothing}, lambda: 0.1)
        self.server = PositionerServer(self.folder.path / "socket", handle)

    def close(self) -> None:
        self.server.close()

    def generate(self, rng: random.Random) -> bytes:
        chance = rng.random()
        if chance < 0.4:
            return mutated(rng, rng.choice(self.lines[3:]), self.lines)
        if chance < 0.41:
            return rng.choice((b"[", b'{"a":', b"{")) * rng.choice((10, 30_000))
        request: dict[str, Any] = dict(
            rng.choice(self.requests[3:] if chance < 0.98 else self.requests)
        )
        key = rng.choice(list(request))
        if isinstance(request[key], dict) and request[key] and rng.random() < 0.7:
            inner = dict(request[key])
            inner[rng.choice([*inner, "y_m", "-1", "²"])] = rng.choice(_NUMBERS)
            request[key] = inner
        elif isinstance(request[key], list) and rng.random() < 0.7:
            request[key] = [rng.choice(_NUMBERS)]
        else:
            request[key] = rng.choice(_NUMBERS)
        return json.dumps(request).encode()

    def check(self, item: bytes) -> str:
        self.used += 1
        if self.used > 20_000:
            self.server.close()
            self._begin()
        reply = json.loads(self.server._answer(item))  # noqa: SLF001  what a line gives
        if not isinstance(reply, dict):
            raise Broken(f"the reply is {reply!r}")
        return "refused: an error reply" if "error" in reply else "carried out"


class ShapeTrial:
    """Shapes as text; a shape that is made must give heights."""

    def __init__(self) -> None:
        self.texts = [
            *PAPER_OBJECTS,
            "ball:diameter=9mm",
            "cylinder:diameter=6mm,length=20mm",
            "box:length=10mm,width=1.5cm,height=.01m",
            "ellipsoid:length=14mm,diameter=12mm",
            "ellipsoid:length=14mm,width=12mm,height=10mm",
            "dumbbell:length=13mm,diameter=10mm,waist_diameter=5mm,waist_length=4mm",
            "mesh:file=/nonexistent/x.stl",
        ]
        self.bytes = [text.encode() for text in self.texts]
        self.x_m, self.y_m = np.meshgrid(np.linspace(-0.01, 0.01, 5), np.linspace(-0.01, 0.01, 5))

    def generate(self, rng: random.Random) -> str:
        text = rng.choice(self.texts)
        if rng.random() < 0.5:
            digits = rng.choice(
                ("0", "9" * 400, "1", "0." + "0" * 330 + "1", "٣", "1e5", "-1", "nan")
            )
            at = rng.randrange(len(text))
            return text[:at] + rng.choice((digits, ",", "=", ":", "mm", "m")) + text[at + 1 :]
        return mutated(rng, text.encode(), self.bytes).decode("utf-8", errors="replace")

    def check(self, item: str) -> str:
        try:
            shape = parse_shape(item)
        except SimulatorSettingsError:
            return "refused: SimulatorSettingsError"
        low_m, high_m = shape.heights(self.x_m, self.y_m, 0.3)
        if np.any(np.isnan(low_m)) or np.any(np.isnan(high_m)):
            raise Broken("a shape with heights that are no numbers")
        return "read: a valid shape"


class MeshTrial:
    """STL files, binary and text."""

    def __init__(self) -> None:
        import trimesh

        self.folder = Folder()
        box = trimesh.creation.box((10.0, 6.0, 6.0))
        self.files = [box.export(file_type="stl"), box.export(file_type="stl_ascii").encode()]
        self.x_m, self.y_m = np.meshgrid(np.linspace(-0.01, 0.01, 5), np.linspace(-0.01, 0.01, 5))

    def generate(self, rng: random.Random) -> bytes:
        data: bytes = rng.choice(self.files)
        chance = rng.random()
        if chance < 0.1:
            return (
                data[:80]
                + struct.pack("<I", rng.choice((0, 1, 1 << 31, (1 << 32) - 1)))
                + data[84:]
            )
        if chance < 0.2:
            at = 84 + 4 * rng.randrange((len(data) - 88) // 4)
            bad = rng.choice((math.nan, math.inf, 3e38, -3e38, 1e-40))
            return data[:at] + struct.pack("<f", bad) + data[at + 4 :]
        return mutated(rng, data, self.files)

    def check(self, item: bytes) -> str:
        path: Path = self.folder.file(item, "x.stl")
        try:
            shape = load_mesh(path)
        except SimulatorSettingsError:
            return "refused: SimulatorSettingsError"
        low_m, _ = shape.heights(self.x_m, self.y_m, 0.0)
        if np.any(np.isnan(low_m)):
            raise Broken("a mesh with heights that are no numbers")
        return "read: a closed surface"


TARGETS = (
    Target(
        name="config",
        parser="cell.config_file",
        inputs="sections of a config: bytes changed, pieces of YAML put in, deep nesting",
        make=ConfigTrial,
        limit_s=3.0,
    ),
    Target(
        name="positioner",
        parser="simulator.positioner_server, simulator.commands",
        inputs="lines of JSON: bytes changed, other values and types, deep nesting",
        make=RequestTrial,
        limit_s=3.0,
    ),
    Target(
        name="shape",
        parser="simulator.shape_text, simulator.shapes",
        inputs="texts of shapes: bytes changed, huge and tiny lengths, other signs",
        make=ShapeTrial,
    ),
    Target(
        name="mesh",
        parser="simulator.mesh",
        inputs="STL files, binary and text: bytes changed, cut, counts and coordinates replaced",
        make=MeshTrial,
        limit_s=2.0,
    ),
)
