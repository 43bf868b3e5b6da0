import math

import numpy as np
import pytest
import trimesh

from simulator.errors import SimulatorSettingsError
from simulator.world import shapes
from simulator.world.shapes import (
    PAPER_OBJECTS,
    Box,
    Ellipsoid,
    ObjectPose,
    load_mesh,
    parse_shape,
    posed_heights,
    resting_pose,
    thicknesses_m,
)

AXIS_M = np.linspace(-15e-3, 15e-3, 121)
GRID = np.meshgrid(AXIS_M, AXIS_M, indexing="ij")


def test_rotation_is_counted_from_x_to_y() -> None:
    pose = ObjectPose(rotation_rad=math.radians(30.0))
    low, _ = posed_heights(PAPER_OBJECTS["cylinder"], pose, *GRID)
    covered = np.isfinite(low)
    direction = np.linalg.svd(np.cov(GRID[0][covered], GRID[1][covered]))[0][:, 0]
    assert math.degrees(math.atan(direction[1] / direction[0])) == pytest.approx(30.0, abs=0.5)


def test_an_ellipsoid_rolls_like_its_cross_section() -> None:
    shape = Ellipsoid(length_m=14e-3, width_m=6e-3, height_m=10e-3)
    tilted = shape.heights(np.zeros(1), np.zeros(1), 0.3)
    expected_m = 1.0 / math.hypot(math.sin(0.3) / 3e-3, math.cos(0.3) / 5e-3)
    assert tilted[0] == pytest.approx([expected_m])
    low, high = shape.heights(np.zeros(1), np.array([1e-3]), 0.3)
    assert low[0] != pytest.approx(high[0])
    assert low == pytest.approx(shape.heights(np.zeros(1), np.array([-1e-3]), 0.3)[1])


@pytest.mark.parametrize(
    ("shape", "asked_deg", "reached_deg"),
    [
        (PAPER_OBJECTS["box"], 37.0, 0.0),
        (PAPER_OBJECTS["box"], 50.0, 90.0),
        (PAPER_OBJECTS["box"], -100.0, -90.0),
        (PAPER_OBJECTS["ball"], 37.0, 37.0),
        (PAPER_OBJECTS["cylinder"], 37.0, 37.0),
        (Ellipsoid(length_m=9e-3, width_m=5e-3, height_m=7e-3), 80.0, 90.0),
    ],
)
def test_an_object_comes_to_rest_on_its_nearest_side(shape, asked_deg, reached_deg) -> None:
    pose = resting_pose(shape, ObjectPose(x_m=1e-3, roll_rad=math.radians(asked_deg)))
    assert math.degrees(pose.roll_rad) == pytest.approx(reached_deg)
    assert pose.x_m == 1e-3


@pytest.mark.parametrize(
    ("text", "shape"),
    [
        ("ball", PAPER_OBJECTS["ball"]),
        ("sphere:diameter=9.5mm", PAPER_OBJECTS["ball"]),
        ("ellipsoid:length=14mm,diameter=11.7mm", PAPER_OBJECTS["oval"]),
        ("box:length=15.9mm,width=1cm,height=10000um", PAPER_OBJECTS["box"]),
        ("cylinder:diameter=6mm,length=.02m", PAPER_OBJECTS["cylinder"]),
        ("dumbbell:length=13mm,diameter=10mm", PAPER_OBJECTS["dumbbell"]),
    ],
)
def test_shapes_are_read_from_text(text, shape) -> None:
    # Off the grid's points, so that none lies on a rim.
    x_m, y_m = (a + 0.013e-3 for a in GRID)
    read, wanted = (one.heights(x_m, y_m, 0.0) for one in (parse_shape(text), shape))
    np.testing.assert_allclose(read, wanted, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cube", "unknown shape 'cube'"),
        ("ellipsoid: length=14 mm, width=1cm, height=9e-3m", "unit"),
        ("cylinder:diameter=6mm", "needs diameter, length"),
        ("cylinder:diameter=6mm,length=20mm,width=3mm", "needs diameter, length"),
        ("cylinder:diameter=6,length=20mm", "unit"),
        ("cylinder:diameter=6mm,diameter=7mm", "twice"),
        ("ball:diameter=0mm", "positive"),
        ("ball:diameter=" + "9" * 400 + "m", "length_m is inf"),
        ("ellipsoid:length=3mm", "width and height"),
        ("dumbbell:length=13mm,diameter=10mm,waist_diameter=11mm", "smaller"),
        ("mesh:file=/nowhere/part.stl", "there is no file"),
    ],
)
def test_texts_that_are_no_shape_are_refused(text, message) -> None:
    with pytest.raises(SimulatorSettingsError, match=message):
        parse_shape(text)


BOX = trimesh.creation.box(extents=(16.0, 10.0, 6.0))
BOX_TEXT = BOX.export(file_type="stl_ascii")


@pytest.fixture
def stl(tmp_path):
    """Return what writes a mesh, or the text of one, to a file."""

    def write(mesh):
        path = tmp_path / "part.stl"
        path.write_bytes(mesh.encode() if isinstance(mesh, str) else mesh.export(file_type="stl"))
        return path

    return write


def test_a_mesh_of_a_box_is_that_box(stl) -> None:
    mesh = BOX.copy()
    mesh.apply_translation((100.0, 5.0, -3.0))
    shape = parse_shape(f"mesh:file={stl(mesh)}")
    box = Box(length_m=16e-3, width_m=10e-3, height_m=6e-3)
    x_m, y_m = (a + 0.01e-3 for a in GRID)
    for roll_rad in (0.0, 0.5 * math.pi):
        heights, wanted = (one.heights(x_m, y_m, roll_rad) for one in (shape, box))
        np.testing.assert_allclose(heights, wanted, atol=1e-9)
    assert shape.roll_step_rad == box.roll_step_rad


@pytest.mark.parametrize(
    ("mesh", "thicknesses_mm"),
    [
        (trimesh.creation.box(extents=(6.0, 10.0, 16.0)), [6.0, 10.0]),
        (trimesh.creation.cylinder(radius=3.0, height=16.0), [6.0]),
        (trimesh.creation.cylinder(radius=5.0, height=16.0, sections=6), [8.7]),
    ],
    ids=["box", "pin", "hexagon"],
)
def test_a_mesh_lies_along_the_pads_and_rests_on_its_sides(stl, mesh, thicknesses_mm) -> None:
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.3, (0.0, 0.0, 1.0)))
    shape = load_mesh(stl(mesh))
    assert np.ptp(shape.triangles_m[:, :, 0]) == pytest.approx(16e-3)
    assert [1e3 * one for one in thicknesses_m(shape)] == pytest.approx(thicknesses_mm, abs=0.2)


def test_a_mesh_is_the_same_whole_and_in_pieces(stl, monkeypatch) -> None:
    mesh = load_mesh(stl(trimesh.creation.icosphere(radius=5.0)))
    whole = mesh.heights(*GRID, 0.3)
    exact = Ellipsoid(length_m=10e-3, width_m=10e-3, height_m=10e-3).heights(*GRID, 0.3)
    within = np.hypot(*GRID) < 4.5e-3
    for height, right in zip(whole, exact, strict=True):
        assert height[within] == pytest.approx(right[within], abs=0.1e-3)
    monkeypatch.setattr(shapes, "_PAIRS", 100)
    assert np.array_equal(mesh.heights(*GRID, 0.3), whole)


SHRUNK = (
    "facet normal 0 0 0\nouter loop\nvertex 8 5 3\nvertex 8 5 3\nvertex -8 5 3\n"
    "endloop\nendfacet\nendsolid"
)
"""A triangle that has shrunk to a line, at the end of a solid."""


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + BOX_TEXT.replace("endsolid", SHRUNK).upper(),
        BOX_TEXT.replace("normal -1.0", "normal nan").replace("0.0", "-nan(ind)", 2),
        BOX_TEXT.replace("endfacet\n", "endfacet\nendsolid a\nsolid b\n", 1),
    ],
    ids=["capitals, byte order mark", "normals", "two solids"],
)
def test_a_mesh_as_programs_export_it_is_read(stl, text) -> None:
    assert text != BOX_TEXT
    low, high = load_mesh(stl(text)).heights(np.zeros(1), np.zeros(1), 0.0)
    assert low[0] + high[0] == pytest.approx(6e-3)


def box(*extents: float, at_m: float = 0.0, inside_out: bool = False) -> trimesh.Trimesh:
    made = trimesh.creation.box(extents=extents)
    made.apply_translation((at_m, 0.0, 0.0))
    if inside_out:
        made.invert()
    return made


@pytest.mark.parametrize(
    ("mesh", "says"),
    [
        (box(0.6, 0.4, 0.2), r"0\.6 x 0\.4 x 0\.2 mm .* export it in mm"),
        (box(1e5, 5.0, 5.0), r"1e\+05 x 5 x 5 mm .* export it in mm"),
        (box(9, 9, 9) + box(8, 8, 8, at_m=30.0), "2 bodies or cavities, but a gripper holds"),
        (box(9, 9, 9) + box(8, 8, 8, inside_out=True), "2 bodies or cavities, but a gripper"),
        (trimesh.Trimesh(BOX.vertices, BOX.faces[:-2]), "no closed surface"),
        (trimesh.Trimesh(BOX.vertices, [[0, 0, 1]]), "no closed surface"),
    ],
)
def test_a_mesh_that_is_no_part_is_refused(stl, mesh, says) -> None:
    with pytest.raises(SimulatorSettingsError, match=says):
        load_mesh(stl(mesh))


@pytest.mark.parametrize(
    ("place", "piece"), [(-7, b""), (0, b""), (80, b"\xff\xff\xff\xff"), (96, b"\0\0\xc0\x7f")]
)
def test_a_file_that_is_cut_or_has_a_wrong_count_or_no_number_is_refused(stl, place, piece) -> None:
    path = stl(BOX)
    data = path.read_bytes()
    path.write_bytes(data[:place] + piece + (data[place + 4 :] if piece else b""))
    with pytest.raises(SimulatorSettingsError, match=r"no closed surface|cannot be read"):
        load_mesh(path)


@pytest.mark.parametrize(
    ("text", "sizes_mm"),
    [
        ("ball", [9.5]),
        ("dumbbell", [10.0]),
        ("cylinder:diameter=6mm,length=20mm", [6.0]),
        ("box:length=16mm,width=10mm,height=12mm", [10.0, 12.0]),
    ],
)
def test_a_thickness_is_that_of_each_side_it_rests_on(text, sizes_mm) -> None:
    assert thicknesses_m(parse_shape(text)) == pytest.approx([1e-3 * mm for mm in sizes_mm])
