"""Bad meshes."""

import math
import struct

import numpy as np
import trimesh
from hypothesis import strategies as st

from simulator.errors import SimulatorSettingsError
from simulator.world.shape_files import load_mesh
from tests.fuzz.harness import bad_input, damages, spoilt

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
    x_m, y_m = np.meshgrid(np.linspace(-0.01, 0.01, 5), np.linspace(-0.01, 0.01, 5))
    assert not np.any(np.isnan(shape.heights(x_m, y_m, 0.3)))
    return "read"
