"""What a drift costs: gain 0.7 and the opening 4 mm off, untold, in a shift, and after a gauge.

Taught with the first 60 per cent of each object's grasps and tested on the others, which are taken
to be of the next day. In a shift these
come in mixed order and nobody names them; ten go before the first that counts. The gauge takes the
first three tested grasps of one object, once for each object; the lowest figure is of the worst
choice. The ratio compares the wrong answers of the plain discriminant with those of the default.

The shifts are drawn within the first 60 per cent alone: of these the first 60 per cent teach, a
third of the objects is left out in turn, and 30 objects in turn with one to three grasps are
answered, each with what the earlier ones have shown of the drift.
"""

import numpy as np

from benchmarks._measure import line, repeats
from benchmarks.recognition._grasps import recorded, share_right, simulated
from benchmarks.recognition._posed_grasps import draw_placing, posed_grasp
from benchmarks.recognition._shifts import SEQUENCES, adversary, compare, make_benches
from recognition.drift.drift import Drift
from recognition.evaluation.evaluation import evaluate_shift
from recognition.evaluation.splits import a_day_later, chronological_split
from recognition.grasp import Grasp
from recognition.recognizers import make_trainer
from recognition.recognizers.force_ramp.recognizer import ForceRampTrainer

_DRIFT = Drift(gains=(0.7,), aperture_offset_m=-4e-3)
_GAUGE_GRASPS = 3


def made_shape(number: int) -> tuple[str, str]:
    """Return name and text of a made-up object: spheres, cylinders, boxes, ovals of all sizes."""
    rng = np.random.default_rng(number)
    a, b, c = rng.uniform(5.0, 14.0, 3)
    texts = (
        f"sphere:diameter={a:.2f}mm",
        f"cylinder:diameter={a:.2f}mm,length={b + 8:.2f}mm",
        f"box:length={a + 4:.2f}mm,width={b:.2f}mm,height={c:.2f}mm",
        f"ellipsoid:length={a + b / 2:.2f}mm,diameter={a:.2f}mm",
    )
    return f"object {number:03d}", texts[number % len(texts)]


def main(effort: float = 1.0) -> None:
    grasps = recorded()
    if grasps is None:
        grasps = simulated(2, repeats(20, effort, least=10))
    train, test = chronological_split(grasps, 0.6)
    drifted = [a_day_later(_DRIFT.apply(grasp)) for grasp in test]
    taught = ForceRampTrainer().fit(train)
    plain = make_trainer("shrinkage_lda").fit(train)
    line("compared", f"{len(taught.labels)} objects, {len(test)} grasps tested")
    line("  without drift", f"force_ramp {100 * share_right(taught, test):.1f} %")
    ours, theirs = share_right(taught, drifted), share_right(plain, drifted)
    line("  drift untold", f"force_ramp {100 * ours:.1f} %, shrinkage_lda {100 * theirs:.1f} %")
    told = [taught.posterior(grasp).unknown > 0.5 for grasp in drifted]
    line("", f"force_ramp calls {100 * sum(told) / len(told):.1f} % of them UNKNOWN")
    shift = evaluate_shift(taught, drifted, seed=0)
    if shift is not None:
        low, high = shift.interval
        line(
            "  in a shift",
            f"force_ramp {100 * shift.accuracy:.1f} % ({100 * low:.1f}-{100 * high:.1f}), "
            f"{100 * shift.known_rejected:.1f} % called UNKNOWN",
        )
    gauged = []
    for label in taught.labels[: repeats(len(taught.labels), effort)]:
        taken = [grasp for grasp in drifted if grasp.label == label][:_GAUGE_GRASPS]
        rest = [grasp for grasp in drifted if not any(grasp is one for one in taken)]
        gauged.append(share_right(taught.with_drift(taught.gauge(label, taken)), rest))
    mean = sum(gauged) / len(gauged)
    line("  gauged", f"force_ramp {100 * mean:.1f} % (worst choice {100 * min(gauged):.1f})")
    least = 0.5 / len(test)
    times = max(1 - theirs, least) / max(1 - mean, least)
    line("  ratio", f"shrinkage_lda errs {times:.1f} times as often as the gauged default")
    _shifts(list(train), effort)


def _shifts(first: list[Grasp], effort: float) -> None:
    n_shifts, n = repeats(2, effort), repeats(SEQUENCES, effort, least=3)
    with_new = len({grasp.label for grasp in first}) >= 3
    shares = (0.0, 0.15, 0.3, 0.5, 0.7) if with_new else (0.0,)
    benches = make_benches(first, 3 if with_new else 1)
    compare("recorded" if with_new else "few", benches, shares=shares, n_shifts=n_shifts, n=n)
    if with_new:
        adversary("recorded", benches, n_shifts=3 * n_shifts, n=20)
    if effort >= 0.2:
        rng = np.random.default_rng(1)
        simulated_ones = [
            posed_grasp(*made_shape(number), draw_placing(rng), 1000 * number + i)
            for number in range(9)
            for i in range(16)
        ]
        benches = make_benches(simulated_ones, 3)
        compare("simulated", benches, shares=(0.0, 0.3), n_shifts=n_shifts, n=n)
        adversary("simulated", benches, n_shifts=3 * n_shifts, n=20)


if __name__ == "__main__":
    main()
