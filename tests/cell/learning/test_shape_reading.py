"""Shape and size as they are told to people and to host programs."""

import pytest

from cell.control.answer import Answer
from cell.learning.shape_reading import beside, in_words
from recognition.recognizer import UNKNOWN
from recognition.shape.answer import UNCLEAR, ShapeAnswer, Thickness

THIN = Thickness(size_m=10e-3, low_m=9.6e-3, high_m=10.4e-3)
THICK = Thickness(size_m=15.9e-3, low_m=15.5e-3, high_m=16.3e-3, n_grasps=2)


def shape(kind: str, *thicknesses: Thickness) -> ShapeAnswer:
    main = thicknesses[-1]
    return ShapeAnswer(
        kind=kind,
        probability={"flat": 0.75, "oval": 0.25},
        size_m=main.size_m,
        low_m=main.low_m,
        high_m=main.high_m,
        dimensions_m={"height": main.size_m, "length": 20e-3},
        misfit=1.0,
        thicknesses=thicknesses,
    )


def test_what_has_no_name_is_described() -> None:
    pin = shape("cylinder", THIN)
    assert beside(UNKNOWN, pin) == ": a cylinder of 10.0 mm (9.6 to 10.4)"
    assert beside("pin", pin) == "; cylinder, 10.0 mm (9.6 to 10.4)"
    assert beside(UNKNOWN, None) == ""
    assert in_words(shape(UNCLEAR, THIN)) == "an unclear shape of 10.0 mm (9.6 to 10.4)"


def test_all_thicknesses_are_told() -> None:
    told = "10.0 mm (9.6 to 10.4) and 15.9 mm (15.5 to 16.3)"
    assert in_words(shape("flat", THIN, THICK)) == f"a flat object of {told}"
    assert str(shape("flat", THIN, THICK)) == f"flat, {told}"


def test_a_host_gets_millimetres() -> None:
    answer = Answer(shape=shape("flat", THIN, THICK))
    assert answer.size_mm == pytest.approx(15.9)
    assert isinstance(hash(answer), int)
