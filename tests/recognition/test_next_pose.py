"""The chooser finds the settings that separate what is still possible."""

import numpy as np
import pytest

from recognition.next_pose import PoseMemory, remember
from recognition.recognizer import Posterior
from recognition.recognizers import make_trainer

LABELS = ("a", "b", "c")


def memory(n: int = 240, *, seed: int = 0) -> PoseMemory:
    """Setting 0 separates a from b where it is large, setting 1 separates c from the others."""
    rng = np.random.default_rng(seed)
    classes = np.arange(n) % 3
    settings = rng.uniform(-1.0, 1.0, (n, 3))
    told = np.zeros((n, 3))
    told[np.arange(n), classes] += 0.2
    ab = classes < 2
    told[ab, classes[ab]] += 2.0 * (settings[ab, 0] + 1.0)
    told[~ab, 2] += 2.0 * (settings[~ab, 1] + 1.0)
    return PoseMemory(settings=settings, told=told, classes=classes)


def posterior(*p: float) -> Posterior:
    return Posterior(labels=LABELS, probability=np.array(p), unknown=0.1)


CORNERS = np.array([[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])


def test_what_separates_the_likely_labels_is_chosen() -> None:
    known = memory()
    assert known.best_of([posterior(0.5, 0.49, 0.01)], CORNERS) == 0
    turned = PoseMemory(
        settings=known.settings[:, [1, 0, 2]], told=known.told, classes=known.classes
    )
    assert turned.best_of([posterior(0.5, 0.49, 0.01)], CORNERS) == 1


def test_without_a_grasp_all_labels_count_alike() -> None:
    loss = memory().expected_loss([], CORNERS)
    assert loss.shape == (3,)
    assert loss[2] == loss.max()
    assert loss[0] < loss[1]


def test_a_setting_that_never_changed_does_not_matter() -> None:
    known = memory()
    fixed = known.settings.copy()
    fixed[:, 2] = 4.0
    same = PoseMemory(settings=fixed, told=known.told, classes=known.classes)
    near, far = (same.expected_loss([], np.add(CORNERS, [0.0, 0.0, x])) for x in (4.0, 99.0))
    assert near == pytest.approx(far)


def test_it_is_kept_as_arrays() -> None:
    known = memory()
    again = PoseMemory.from_arrays(known.to_arrays())
    ask = [posterior(0.4, 0.3, 0.3)]
    assert again.expected_loss(ask, CORNERS) == pytest.approx(known.expected_loss(ask, CORNERS))


def test_what_does_not_fit_is_refused() -> None:
    known = memory()
    with pytest.raises(ValueError, match="taught were 3 settings"):
        known.expected_loss([], [[1.0, 2.0]])
    two = Posterior(labels=("a", "b"), probability=np.array([0.5, 0.5]), unknown=0.1)
    with pytest.raises(ValueError, match="3 taught labels"):
        known.expected_loss([two], CORNERS)
    with pytest.raises(ValueError, match="at least one grasp"):
        PoseMemory(settings=np.zeros((0, 1)), told=np.zeros((0, 2)), classes=np.zeros(0, int))
    with pytest.raises(ValueError, match="2 settings"):
        PoseMemory(settings=known.settings[:2], told=known.told, classes=known.classes)
    with pytest.raises(ValueError, match="not finite"):
        PoseMemory(settings=known.settings * np.nan, told=known.told, classes=known.classes)


def test_remembering_asks_about_each_taught_grasp(train) -> None:
    settings = np.arange(2.0 * len(train)).reshape(-1, 2)
    trainer = make_trainer("shrinkage_lda")
    known = remember(trainer, train, settings)
    assert len(known.classes) == len(train)
    assert np.mean(known.told.argmax(axis=1) == known.classes) > 0.8
    with pytest.raises(ValueError, match="1 settings"):
        remember(trainer, train, settings[:1])
