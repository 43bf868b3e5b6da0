"""The page that puts the paper beside ours: its physics, its rules, and that it stands."""

import json
import re

import numpy as np
import pytest

from benchmarks.paper import level_trials, page as job, reproduction as command
from benchmarks.paper.claims import claims, most_confused, paper_share
from benchmarks.paper.effort import Effort
from benchmarks.paper.grasps import (
    COMMON_N,
    PAPER_NOISE,
    REST_FRAMES,
    indent,
    noise_model,
    press,
    random_grasp,
    record,
)
from benchmarks.paper.level_trials import (
    CONDITIONS,
    LABELS,
    classify,
    levels_of,
    name_by_threshold,
    one_frame,
)
from benchmarks.paper.study import one_touch
from cell.errors import CellError
from cell.report.paper_table import FIGURE_2
from recognition.quadric.thresholds import find_thresholds
from simulator.world.shapes import ObjectPose
from simulator.world.taxels import resistance_mohm

EFFORT = 0.01


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper")
    found, page = job.reproduce_paper(folder / "new", effort=EFFORT)
    return found, page


@pytest.mark.parametrize("label", LABELS)
def test_both_pads_carry_the_grip_force_at_every_step(label):
    touch = press(label, ObjectPose(x_m=1e-3, y_m=-1e-3, rotation_rad=0.4), 6.0)
    both = touch.taxel_n.reshape(len(touch.force_n), 2, -1).sum(axis=2)
    assert both == pytest.approx(np.stack([touch.force_n] * 2, axis=1), rel=2e-3, abs=1e-9)
    assert np.all(np.diff(touch.aperture_m) < 0)


def test_a_ball_touches_at_its_diameter_and_a_far_one_is_refused():
    touch = press("ball", ObjectPose(), 5.0)
    assert touch.aperture_m[0] == pytest.approx(9.5e-3, abs=2e-5)
    with pytest.raises(CellError, match="beside the pads"):
        press("ball", ObjectPose(y_m=0.05), 5.0)
    with pytest.raises(CellError, match="choose less force"):
        press("ball", ObjectPose(), 500.0)


def test_a_record_rests_ramps_and_holds_within_its_noise():
    touch = press("oval", ObjectPose(), 5.0)
    silent = record(touch, np.random.default_rng(0), 0.0)
    assert not silent.counts[:REST_FRAMES].any()
    assert np.max(np.diff(silent.force_n)) <= 0.1 + 1e-9
    assert np.array_equal(silent.counts[-1], silent.counts[-15])
    noisy = record(touch, np.random.default_rng(0), PAPER_NOISE)
    added = noisy.counts.astype(float) - silent.counts
    assert added.min() >= 1
    assert added.max() <= 20.5
    assert noise_model(0.2).level == pytest.approx(2.5)


def test_an_indenter_shares_its_force_with_the_neighbours():
    found = indent(np.array([0.0, 2.0, 8.0]))
    assert found.taxel_n[1:] / found.force_n[1:] == pytest.approx([0.5, 0.5], abs=0.1)
    law_mohm = resistance_mohm(found.taxel_n)
    assert found.resistance_mohm == pytest.approx(law_mohm, abs=0.5 * 1.579 / 255)
    force_n, quoted = np.array(FIGURE_2).T
    assert 1e3 * resistance_mohm(force_n) == pytest.approx(quoted, rel=0.14)


def test_levels_follow_the_force_and_are_missing_without_contact():
    levels = levels_of(record(one_touch("ball"), np.random.default_rng(0), 0.0))
    by_condition = dict(zip(CONDITIONS, levels, strict=True))
    for condition, value in by_condition.items():
        assert bool(value > 0) is (condition.reading == "smallest_magnitude")
        assert 1e-3 < value < 1e-2 or value < -10
    # more force, a higher peak, a smaller eigenvalue
    at_full, at_common = (levels[CONDITIONS.index(c)] for c in (CONDITIONS[2], CONDITIONS[6]))
    assert CONDITIONS[6].force_n == COMMON_N
    assert at_full < at_common
    grasp = random_grasp("ball", np.random.default_rng(1), PAPER_NOISE)
    assert one_frame(grasp, COMMON_N).n_frames == REST_FRAMES + 1
    assert one_frame(grasp, COMMON_N).force_n[-1] == pytest.approx(COMMON_N)
    quiet = one_frame(grasp, 0.0)
    assert np.isnan(levels_of(quiet)).all()


def test_a_value_belongs_to_the_object_between_whose_thresholds_it_falls():
    levels = find_thresholds([[5.0, 6.0], [1.0, 2.0], [9.0, 10.0]])
    values = np.array([0.0, 3.4, 3.6, 7.4, 7.6, 99.0, np.nan])
    assert name_by_threshold(levels, values).tolist() == [1, 1, 0, 0, 2, 2, -1]


def test_outcomes_count_names_windows_and_closed_windows():
    taught = np.array([[i, i + 0.2] for i in range(1, 6)], dtype=float)
    tested = np.array([[i + 0.1, i + 0.9] for i in range(1, 6)], dtype=float)
    tested[4, 1] = np.nan
    found = classify([taught], [tested])
    assert found.counts.sum() == 10
    assert found.counts[:, -1].tolist() == [0, 0, 0, 0, 1]
    assert found.n_right == 5
    assert found.closed == 0.0
    assert found.windows_right == 5
    overlapping = taught.copy()
    overlapping[0, 1] = 2.1
    assert classify([overlapping], [tested]).closed == 1.0
    pair = most_confused(found, 1)[0]
    assert pair[2] == pytest.approx(0.25)


def test_thresholds_out_of_order_still_name_every_value():
    levels = find_thresholds([[1.0, 9.0], [4.0, 6.5], [5.4, 5.6]])
    assert set(name_by_threshold(levels, np.linspace(0, 10, 50)).tolist()) <= {0, 1, 2}


def test_little_effort_keeps_the_kind_and_full_effort_the_numbers():
    assert Effort().scaled(1.0) == Effort()
    small = Effort().scaled(EFFORT)
    assert small.table_tested < 10
    assert small.n_taught >= 4
    full = Effort()
    assert full.table_lessons * full.table_tested >= 1000
    assert full.repeats >= 1000


def test_the_study_finds_what_the_algebra_says(made):
    found, _ = made
    by_name = {part.name: part for part in found.invariance}
    magnitude, algebraic = level_trials.READINGS
    assert by_name["rotation about all axes"].ratio[algebraic] == pytest.approx(np.ones(5))
    assert by_name["scale 1 to 4"].ratio[magnitude] == pytest.approx(np.full(5, 16), rel=1e-2)
    assert by_name["translation in x and y"].ratio[magnitude].max() < 1.01
    assert by_name["translation in x and y"].ratio[algebraic].max() > 2
    assert by_name["all three"].overlaps[magnitude] == 10
    assert [point.noise_share for point in found.curve] == [0.0, 0.08, 0.2]
    silent = found.curve[0]
    assert all(np.array_equal(silent.adjusted[c].counts, silent.fixed[c].counts)
               for c in silent.adjusted)  # fmt: skip


def test_the_same_seed_gives_the_same_trials_in_one_process_or_two(made):
    effort = Effort(seed=2008).scaled(EFFORT)
    once = level_trials.lesson_levels(
        level_trials.Lesson(seed=2008, noise_share=PAPER_NOISE, n_taught=4, n_tested=4)
    )
    again = classify([once[:, :4, 6]], [once[:, 4:, 6]])
    assert np.array_equal(made[0].tables[6].counts, again.counts)
    assert effort == made[0].effort


def test_the_page_stands_alone_and_has_every_part(made):
    found, page = made
    text = page.read_text(encoding="utf-8")
    for part in ("claims", "fig2", "fig3", "fig4", "table1", "noise", "others", "how"):
        assert f'<section id="{part}">' in text
    assert text.count("<svg") == 4
    assert "<script" not in text
    assert not re.search(r'(?:src|href)="(?!#)', text)
    assert "Made with few trials" in text
    assert "nan" not in re.sub(r"<svg.*?</svg>", "", text, flags=re.DOTALL)
    assert len(found.contenders) == 5
    for contender in found.contenders:
        assert f"<code>{contender.name}</code>" in text


def test_the_command_prints_every_claim_and_the_page(made, capsys, monkeypatch):
    monkeypatch.setattr(command, "reproduce_paper", lambda folder, *, effort, workers: made)
    command.main(EFFORT)
    printed = capsys.readouterr().out
    assert printed.startswith("compared")
    assert str(made[1]) in printed
    assert "nan" not in printed
    for claim in claims(made[0]):
        assert claim.claim in printed


def test_figures_are_written_beside_the_page(made):
    found, page = made
    figures = json.loads((page.parent / job.FIGURES).read_text())
    assert [c["verdict"] for c in figures["claims"]] == [c.verdict for c in claims(found)]
    assert paper_share() == (48, 50)
    assert all(one["n"] == sum(map(sum, one["confusion"])) for one in figures["tables"].values())
    assert {c["verdict"] for c in figures["claims"]} <= {"holds", "in part", "does not hold"}


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(CellError, match="name another folder"):
        job.reproduce_paper(tmp_path / "file" / "below", effort=EFFORT)
