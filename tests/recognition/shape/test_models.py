"""The surfaces that are fitted: heights, lengths, and what they are called."""

import numpy as np
import pytest

from recognition.shape.models import SHAPE_MODELS

OWN = {
    "sphere": [],
    "oval": [np.log(1.5)],
    "cylinder": [np.log(2.5)],
    "flat": [np.log(1.4), np.log(0.8)],
    "dumbbell": [np.log(1.3), 0.0],
}


def surface(kind: str, u_m: float, v_m: float, h_m: float = 4e-3) -> tuple[float, float]:
    model = SHAPE_MODELS[kind]
    lag_m, share = model.surface(
        np.full((1, 1, 1), h_m),
        np.array(OWN[kind], dtype=float).reshape(1, -1, 1, 1),
        np.full((1, 1, 1), u_m),
        np.full((1, 1, 1), v_m),
        1e-4,
    )
    return float(lag_m[0, 0, 0]), float(share[0, 0, 0])


@pytest.mark.parametrize("kind", ["sphere", "oval", "cylinder"])
def test_round_shapes_fall_away_as_their_circle_does(kind: str) -> None:
    lag_m, share = surface(kind, 0.0, 2e-3)
    assert lag_m == pytest.approx(4e-3 - np.sqrt(4e-3**2 - 2e-3**2))
    assert share == 1.0
    assert surface(kind, 0.0, 4.2e-3)[1] == 0.0


def test_along_them_they_differ() -> None:
    assert surface("sphere", 2e-3, 0.0)[0] == pytest.approx(4e-3 - np.sqrt(12e-6))
    assert surface("oval", 3e-3, 0.0)[0] == pytest.approx(4e-3 * (1 - np.sqrt(0.75)))
    assert surface("cylinder", 9e-3, 0.0) == (0.0, 1.0)
    assert surface("cylinder", 10.1e-3, 0.0)[1] == 0.0
    assert surface("flat", 6.9e-3, 3.9e-3) == (0.0, 1.0)
    assert surface("flat", 6.9e-3, 4.1e-3)[1] == 0.0
    assert surface("dumbbell", 1e-3, 0.0)[1] == 0.0
    assert surface("dumbbell", 4e-3, 0.0) == (0.0, 1.0)


def test_an_end_covers_a_part_of_its_cell() -> None:
    assert surface("cylinder", 10e-3, 0.0)[1] == pytest.approx(0.5)


def test_dimensions_have_the_names_of_drawings() -> None:
    sizes = {
        kind: SHAPE_MODELS[kind].dimensions_m(4e-3, np.array(OWN[kind])) for kind in SHAPE_MODELS
    }
    assert sizes["sphere"] == {"diameter": 8e-3}
    assert sizes["cylinder"]["length"] == pytest.approx(20e-3)
    assert sizes["flat"]["length"] == pytest.approx(14e-3)
    assert sizes["flat"]["width"] == pytest.approx(8e-3)
    assert sizes["dumbbell"]["waist_length"] == pytest.approx(0.5 * sizes["dumbbell"]["length"])


@pytest.mark.parametrize("kind", sorted(SHAPE_MODELS))
def test_priors_and_starts_fit_the_parameters(kind: str) -> None:
    model = SHAPE_MODELS[kind]
    assert len(model.mean) == len(model.sd) == model.n_own == 1 + len(OWN[kind])
    starts = model.starts(4e-3, 8e-3, 3e-3)
    assert starts
    assert all(len(start) == model.n_own - 1 for start in starts)
