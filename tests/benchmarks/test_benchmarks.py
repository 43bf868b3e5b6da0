"""Each benchmark runs to its end and prints figures: what is quoted can be measured.

How fast anything is, is not tested here. Each benchmark itself ends with an error where its
alternatives do not give the same.
"""

import importlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from benchmarks import __main__ as command
from benchmarks.__main__ import MODULES
from benchmarks.paper.method import KINDS, SOLVERS, claims, column_sums, ramp_surface
from benchmarks.paper.reproduction import levels_of, one_frame, press, record
from benchmarks.performance import servo_logs, soak
from benchmarks.performance.servo_logs import Bench, Log, main, read_logs
from cell.recording.dataset import write_dataset
from gripper.dynamixel.models import XL330_M288, XM430_W350
from recognition.quadric.quadric import Reading, translation
from simulator.world.shapes import ObjectPose
from tests import ROOT
from tests.marks import LONG
from tests.recognition.conftest import make_grasps
from tests.values import make_pads

pytestmark = pytest.mark.no_cover  # to count lines takes as long again as to run them


@pytest.fixture(autouse=True)
def one_blas_thread() -> Iterator[None]:
    """Have one thread of BLAS, as the command of the benchmarks has it before numpy is loaded."""
    with threadpool_limits(1):
        yield


EFFORT = 0.01
OTHERWISE = {*command.WITH_DATA, "soak"}
"""Some need data, and the soak is run for a moment."""


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", sorted(MODULES.keys() - OTHERWISE))
def test_it_prints_its_figures(name, capsys, monkeypatch, tmp_path) -> None:
    monkeypatch.delenv("TACTILE_CELL_DATA", raising=False)
    monkeypatch.chdir(tmp_path)
    importlib.import_module(MODULES[name]).main(EFFORT)
    printed = capsys.readouterr().out
    assert printed.startswith("compared")
    assert len(printed.splitlines()) > 1
    assert "nan" not in printed


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_short_soak_leaves_no_file_and_no_thread(capsys, monkeypatch) -> None:
    rates = {"descriptors": 0.01, "threads": 0.01}
    monkeypatch.setattr(soak, "LIMITS", dict.fromkeys(soak.LIMITS, rates))
    monkeypatch.setattr(soak, "REST_S", 0.5)
    soak.main(connects=40, hours=0.05, starts=2)
    assert capsys.readouterr().out.count("descriptors grow by 0.0000 each") == 3


@pytest.mark.parametrize(("leak", "is_leak"), [(0.0, 0), (1.0, 1)])
def test_a_leak_is_found_and_one_step_of_the_allocator_is_none(leak, is_leak) -> None:
    samples = [{"done": 20 * i, "objects": 2000 * (i > 9) + 20 * i * leak} for i in range(50)]
    assert len(soak.judge(samples, {"objects": 0.5})) == is_leak


# -- Simulated servos against logs of real ones: a log outside its target is found -----------------


TIME_S = np.arange(0.0, 1.5, 0.01)
SWING_RAD = 0.5 * np.sin(4.0 * TIME_S)


def arm(late: bool) -> dict[str, np.ndarray]:
    """Return the log of one joint, its velocity as the register has it or without a delay."""
    speed = 2.0 * np.cos(4.0 * TIME_S)
    if late:
        speed, _ = Bench(Log("", XM430_W350, TIME_S, SWING_RAD, speed)).run()
    return {"t": TIME_S, "q3": SWING_RAD, "dq3": speed}


def pendulum(divisor: float) -> dict[str, np.ndarray]:
    """Return the log of a servo that holds still, with the P gain over a divisor."""
    zeros, goal = np.zeros_like(TIME_S), 0.1 + 0.2 * TIME_S
    log = Log("", XL330_M288, TIME_S, zeros, zeros)
    pwm = np.trunc(400 * np.rint(goal / log.model.rad_per_pulse) / divisor) % 0x10000
    meta = {"motor": "xl330", "kp": 400, "mass": 0.5, "length": 0.1, "trajectory": "other"}
    return {
        "meta": np.array(json.dumps(meta)),
        **{"timestamp": TIME_S, "position": zeros, "speed": zeros, "goal_position": goal},
        **{"load": pwm, "input_volts": zeros + 7.3, "torque_enable": zeros + 1.0},
    }


@pytest.mark.parametrize(
    ("log", "outside"),
    [
        (arm(late=True), ""),
        (arm(late=False), "3 .* velocity 0.2.* OUTSIDE"),
        (pendulum(256.0), ""),
        (pendulum(128.0), "PWM .* OUTSIDE"),
        ({"t": TIME_S, "q1": SWING_RAD}, "ERROR .*a.npz is no log of a servo: it lacks 'dq1'"),
        (pendulum(256.0) | {"load": TIME_S[:9]}, "ERROR .*a.npz .* length"),
        (arm(late=True) | {"t": TIME_S[::-1]}, "ERROR .*a.npz .* times"),
        (arm(late=True) | {"q3": TIME_S * np.nan}, "ERROR .*a.npz .* no number"),
    ],
)
def test_each_log_has_a_line_and_one_outside_ends_it_with_1(log, outside, tmp_path, capsys) -> None:
    np.savez(tmp_path / "a.npz", **log)
    if outside:
        with pytest.raises(SystemExit) as ended:
            main(folder=str(tmp_path))
        assert ended.value.code == 1
    else:
        main(folder=str(tmp_path))
    (line,) = (one for one in capsys.readouterr().out.splitlines() if one.startswith("a"))
    assert line.count("OUTSIDE") + line.count("ERROR") == bool(outside)
    if outside:
        assert re.search(outside, line)


def test_a_file_that_is_no_archive_is_named_and_so_is_an_empty_folder(tmp_path, capsys) -> None:
    with pytest.raises(SystemExit, match="has no log"):
        main(folder=str(tmp_path))
    for name, data in (("b.npz", b"nothing"), ("c.npz", b"PK\x03\x04 cut off")):
        (tmp_path / name).write_bytes(data)
    with pytest.raises(SystemExit):
        main(folder=str(tmp_path))
    assert capsys.readouterr().out.count("ERROR") == 2


@pytest.mark.slow
@pytest.mark.shared_data
def test_the_simulated_servos_follow_the_logs_of_real_ones(capsys) -> None:
    folder = os.environ.get("TACTILE_CELL_DATA")
    if folder is None:
        pytest.skip("TACTILE_CELL_DATA does not name the folder with servos/")
    servos = Path(folder) / "servos"
    main(folder=str(servos))
    printed = capsys.readouterr().out
    assert all(log.name in printed for path in servos.glob("*.npz") for log in read_logs(path))
    assert servo_logs.SPEED_RMS_RAD_S == {"430 size": 0.018, "330 size": 0.04}


# -- The paper's mathematics: "What holds" in docs/developers/paper.md -----------------------------


UNUSABLE = ("characteristic polynomial", "companion matrix")
TRUE = {
    "eq. (5), (6): the bound is the least eigenvalue",
    "eq. (4): descents end at it",
    "eq. (8): column sums give each scale",
    *(f"eq. (9): {kind} keeps the infimum" for kind in KINDS),
    *(
        f"{form}: rotation keeps the {one}"
        for form in ("full quadrics", "form (7)")
        for one in Reading
    ),
    "form (7): translation keeps the smallest_magnitude",
    "full quadrics: scale keeps the algebraic_minimum",
    *(f"{solver}: within 8 % in float64" for solver in SOLVERS),
    *(f"{solver}: within 8 % in float32" for solver in SOLVERS if solver not in UNUSABLE),
}


@pytest.mark.slow
def test_each_claim_of_the_paper_has_the_verdict_of_the_page() -> None:
    rows = {f"{where}: {claim}": (values(), most) for where, claim, values, most in claims(EFFORT)}
    assert {row for row, (residuals, limit) in rows.items() if residuals.max() <= limit} == TRUE
    assert rows["form (7): scale keeps the smallest_magnitude"][0] == pytest.approx(
        [15.0] * 5, abs=0.01
    )
    assert rows["bands: none overlap after the sweep"][0] == 1.0
    assert len(rows) == 41
    assert np.diag(column_sums(translation([3.0, 0.0, 0.0]))).tolist() == [1.0, 1.0, 1.0, 4.0]


def test_the_form_with_five_coordinates_is_the_fitted_surface() -> None:
    rng = np.random.default_rng(3)
    xy, share = rng.uniform(-1, 1, (40, 2)), rng.uniform(0, 1, 40)
    height = 3 * xy[:, 0] ** 2 - xy[:, 1] * share + 2 * share**2 - share + 5
    v = np.column_stack([xy, height, share, np.ones(40)])
    Q = ramp_surface(xy, share, height)
    assert np.einsum("ni,ij,nj->n", v, Q, v) == pytest.approx(np.zeros(40), abs=1e-9)


# -- The paper's claims beside ours: the levels of a grasp, and the names by thresholds ------------


def test_levels_follow_the_force_and_are_missing_without_contact():
    grasp = record(press("ball", ObjectPose(), 6.0), np.random.default_rng(0), 0.0)
    _, at_common, at_full = levels_of(grasp)
    # more force, a higher peak, a smaller eigenvalue
    assert 1e-3 < at_full < at_common < 1e-2
    assert np.isnan(levels_of(one_frame(grasp, 0.0))).all()


# -- Comparators: features of patches and curves of known form, and the command on a data set ------


METHODS = ("discriminant", "extra_trees", "raw_neighbours")


@pytest.fixture
def comparators() -> Any:
    """The module, imported only where it is used: scikit-learn takes seconds."""
    return importlib.import_module(MODULES["comparators"])


@pytest.mark.slow
@pytest.mark.parametrize("name", [METHODS[0], *map(LONG, METHODS[1:])])
def test_a_comparator_is_an_estimator_that_names_grasps(comparators, name):
    method = comparators.clone(comparators.METHODS[name])
    method.set_params(grid={key: values[:1] for key, values in method.grid.items()})
    if "n_estimators" in method.classifier.get_params():
        method.set_params(classifier__n_estimators=20)
    train, test = (make_grasps(n, seed=n, pads=make_pads()) for n in (6, 5))
    method.fit(train[::-1], [grasp.label for grasp in train[::-1]])
    assert np.mean(method.predict(test) == [grasp.label for grasp in test]) > 0.4
    held = [indices for _, indices in method.search_.cv]
    assert sorted(np.concatenate(held).tolist()) == list(range(len(train)))
    # In the order of time five objects have a grasp each: a block has two grasps of each.
    assert [np.unique(one // 10).tolist() for one in held] == [[0], [1], [2]]


@pytest.mark.long
def test_the_command_compares_all_methods_on_a_file(comparators, tmp_path, capsys):
    write_dataset(tmp_path / "x.npz", make_grasps(5, seed=1, pads=make_pads()))
    comparators.main(0.01, str(tmp_path / "x.npz"))
    first, *rows = capsys.readouterr().out.splitlines()
    assert "5 objects, 15 grasps teach, 10 test" in first
    assert len(rows) == 12  # the last four are drifts, alone and followed
    assert all(" of 10" in row for row in rows)


# -- Figures that README and docs quote, and transcripts, are those of today's run -----------------


PAGES = ("README.md", "docs/explanations/recognizer.md")
PROGRAM = Path(sys.executable).with_name("tactile-cell")
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def numbers(text: str) -> list[float]:
    return [float(number) for number in _NUMBER.findall(text.replace("95 %", ""))]


def quoted(page: str, command: str) -> list[str]:
    """Return the cells with figures of a page's table rows that belong to a command.

    A command stands in the last cell of a row, or in the paragraph above the table.
    """
    quotes, above, is_ended = [], "", False
    for line in page.splitlines():
        if not line.startswith("|"):
            if line.strip():
                above = line if is_ended else f"{above} {line}"
            is_ended = not line.strip()
            continue
        is_ended = True
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if command in cells[-1]:
            quotes.append(cells[-2])
        elif command in above:
            quotes += cells[1:]
    return [cell for cell in quotes if numbers(cell)]


def differing(cells: list[str], printed: str) -> list[str]:
    """Return the cells whose figures stand in no printed line together, in their order."""
    lines = [numbers(line) for line in printed.splitlines()]
    return [cell for cell in cells if not any(_in_order(numbers(cell), line) for line in lines)]


def _in_order(wanted: list[float], line: list[float]) -> bool:
    rest = iter(line)
    return all(number in rest for number in wanted)


def printed(*arguments: object) -> str:
    command = [PROGRAM, *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_a_figure_that_is_printed_no_more_is_named() -> None:
    page = "`x`:\n\n| | a |\n|---|---|\n| b | 97.7 % (95.5 to 98.8) |\n| c | 12 of 50 |\n"
    cells = quoted(page, "`x`")
    assert cells == ["97.7 % (95.5 to 98.8)", "12 of 50"]
    assert differing(cells, "r: one grasp 97.7, 95 % 95.5 to 98.8") == ["12 of 50"]
    assert differing(["27 of 50, 23 wrong"], "23 of 50 right, 27 wrong") == ["27 of 50, 23 wrong"]
    assert quoted("| b | 3 | `x` |", "`x`") == ["3"]
    assert quoted("By `x`, a\nparagraph:\n\n| b | 3 |\n\nOther:\n\n| c | 4 |", "`x`") == ["3"]


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("page", "command", "options", "n_cells"),
    [
        ("README.md", "`make run`", "", 2),
        (
            "docs/how-to/open-parallel-gripper.md",
            "`tactile-cell run",
            "-c open-parallel-gripper",
            4,
        ),
        ("docs/how-to/connect-uskin.md", "`tactile-cell run", "-c uskin --teach 10 --trials 4", 2),
    ],
)
def test_the_run_of_today_prints_what_is_quoted(page, command, options, n_cells, tmp_path) -> None:
    given = re.sub(r"-c (\S+)", rf"-c {ROOT}/config/\1.yaml", options).split()
    text = printed("run", *given, "--out", tmp_path)
    cells = quoted((ROOT / page).read_text(encoding="utf-8"), command)
    assert len(cells) == n_cells
    assert differing(cells, text) == []


@pytest.mark.long
@pytest.mark.shared_data
@pytest.mark.timeout(900)
@pytest.mark.skipif(
    "TACTILE_CELL_DATA" not in os.environ,
    reason="TACTILE_CELL_DATA does not name the folder of recorded grasps",
)
def test_the_evaluation_of_today_prints_what_is_quoted() -> None:
    data = Path(os.environ["TACTILE_CELL_DATA"])
    first, later = data / "pinch36.npz", data / "pinch_november.npz"
    text = printed("model", "evaluate", first)
    text_later = printed("model", "evaluate", later, "--train", first, "--recognizer", "force_ramp")
    for name in PAGES:
        page = (ROOT / name).read_text(encoding="utf-8")
        assert differing(quoted(page, "`tactile-cell model evaluate FILE`"), text) == [], name
        assert differing(quoted(page, "`tactile-cell model evaluate LATER"), text_later) == [], name


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_tutorial_shows_what_is_printed_today() -> None:
    from docs.tools.pictures import TUTORIAL, today  # it loads a browser's driver

    page = TUTORIAL.read_text(encoding="utf-8")
    stored, new = (re.sub(r"\d{8}-\d{6}", "TIME", text) for text in (page, today(page)))
    assert new == stored
