"""Bad text of people and other programs: configs, meshes, and lines that are no request."""

import itertools
import json
import math
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import strategies as st

from cell.config.file import config_text, parse_config
from cell.config.model import CellConfig
from cell.errors import ConfigError
from simulator.errors import SimulatorSettingsError
from simulator.world.shape_files import load_mesh
from simulator.world.shapes import Shape
from tests.fuzz.harness import bad_input, damages, spoilt

YAML = (
    "[", "]", "{", "}", "- ", ": ", "? ", "&a ", "*a", "<<: ", "!!binary ", "!!set ", "!!omap ",
    "!!timestamp ", "!!python/object/apply:os.system ", "!x ", "| ", "> ", "'", '"', "\\x", "# ",
    "%YAML 1.1\n", "---\n", "...\n", ".inf", ".nan", "1e999", "0x1F", "1_0", "2001-01-01", "~",
    "null", "yes", "true", "9" * 400, "\t", "\0", "\ud7ff", "\u2028", "\ufeff", "-1", "0o7",
)  # fmt: skip


def sections() -> list[str]:
    """Return the short sections of the built-in config."""
    lines = config_text(CellConfig(), comments=False).splitlines(keepends=True)
    starts = [i for i, line in enumerate(lines) if line[0] not in " -\n#"] + [len(lines)]
    whole = ["".join(lines[a:b]) for a, b in itertools.pairwise(starts)]
    return [section for section in whole if len(section) < 500]


def put_in(text: str, places: list[tuple[int, int, str]]) -> str:
    """Return the text with pieces put in, instead of some characters."""
    for place, size, piece in places:
        at = place % len(text)
        text = text[:at] + piece + text[at + size :]
    return text


configs = st.builds(
    put_in,
    st.sampled_from(sections()),
    st.lists(st.tuples(st.integers(0, 999), st.integers(0, 2), st.sampled_from(YAML)), max_size=3),
) | st.builds(
    lambda section, harm: spoilt(section.encode(), harm).decode(errors="replace"),
    st.sampled_from(sections()),
    damages(),
)


@pytest.mark.slow
@bad_input(text=configs, examples=120)
def test_a_config_is_refused_or_of_plain_numbers(text):
    try:
        config = parse_config(text, source="x")
    except ConfigError:
        return "refused"
    json.dumps(config.model_dump(mode="json"), allow_nan=False)
    return "read"


def assert_heights(shape: Shape) -> None:
    """Fail if a shape has heights that are no numbers."""
    x_m, y_m = np.meshgrid(np.linspace(-0.01, 0.01, 5), np.linspace(-0.01, 0.01, 5))
    low_m, high_m = shape.heights(x_m, y_m, 0.3)
    assert not np.any(np.isnan(low_m))
    assert not np.any(np.isnan(high_m))


BOX = trimesh.creation.box((10.0, 6.0, 6.0))
MESHES = (BOX.export(file_type="stl"), BOX.export(file_type="stl_ascii").encode())
counts = st.tuples(
    st.just(80), st.sampled_from([0, 1, 1 << 31, (1 << 32) - 1]).map(struct.Struct("<I").pack)
)
coordinates = st.tuples(
    st.integers(0, 140).map(lambda n: 84 + 4 * n),
    st.sampled_from([math.nan, math.inf, 3e38, -3e38, 1e-40, 0.0, 1.0]).map(
        struct.Struct("<f").pack
    ),
)


@bad_input(
    data=st.sampled_from(MESHES),
    words=st.lists(counts | coordinates, max_size=2),
    harm=damages(),
    sound={"data": MESHES[0], "words": [], "harm": []},
    limit_s=2.0,
)
def test_a_mesh_is_refused_or_has_heights(tmp_path, data, words, harm):
    for at, word in words:
        data = data[:at] + word + data[at + 4 :]
    (tmp_path / "x.stl").write_bytes(spoilt(data, harm))
    try:
        shape = load_mesh(tmp_path / "x.stl")
    except SimulatorSettingsError:
        return "refused"
    assert_heights(shape)
    return "read"
