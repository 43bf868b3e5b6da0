"""How many grasps of an object have to be taught: accuracy after 3, 5, 10 and 20 of each.

The first grasps of each object in time are taught, the same later ones are always tested: of the
recorded grasps the last 40 per cent of each object, of the simulated ones the second half. The
ratio compares the wrong answers of the plain discriminant with those of the default recogniser.
"""

from collections.abc import Sequence

from benchmarks._grasps import first_of_each, recorded, share_right, simulated
from benchmarks._measure import line, repeats
from recognition.grasp import Grasp
from recognition.metrics import wilson_interval
from recognition.recognizers import make_trainer
from recognition.splits import chronological_split

_TAUGHT = (3, 5, 10, 20)


def curve(title: str, train: Sequence[Grasp], test: Sequence[Grasp]) -> None:
    """Print one line for each number of taught grasps, and the ratio at the last."""
    line("compared", f"{title}: {len(test)} grasps tested")
    most = max(len([g for g in train if g.label == label]) for label in {g.label for g in train})
    wrong = {}
    for use_aperture in (True, False):
        for n in sorted({min(n, most) for n in _TAUGHT}):
            part = first_of_each(train, n)
            figures = []
            for name in ("force_ramp", "shrinkage_lda"):
                taught = make_trainer(name, use_aperture=use_aperture).fit(part)
                share = share_right(taught, test)
                wrong[name] = max(1.0 - share, 0.5 / len(test))
                low, high = wilson_interval(round(share * len(test)), len(test))
                figures.append(f"{name} {100 * share:.1f} ({100 * low:.1f}-{100 * high:.1f})")
            what = "touch and opening" if use_aperture else "touch alone"
            line(f"  {n} taught", f"{what}: {', '.join(figures)}")
        times = wrong["shrinkage_lda"] / wrong["force_ramp"]
        line("  ratio", f"shrinkage_lda errs {times:.1f} times as often")


def main(effort: float = 1.0) -> None:
    grasps = recorded()
    if grasps is not None:
        curve("36 recorded objects", *chronological_split(grasps, 0.6))
    n = 2 * repeats(20, effort, least=3)
    curve("5 simulated objects", *chronological_split(simulated(5 if n > 10 else 2, n), 0.5))


if __name__ == "__main__":
    main()
