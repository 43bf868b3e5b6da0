"""The next grasp: chosen for what it is expected to tell, or drawn, as hard as allowed, or fixed.

Simulated grasps at twice the paper's noise. Every way to choose meets the same candidates; the
grasps that teach, those that are chosen from, and the sequences are drawn anew with each seed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_softmax

from benchmarks._cell_grasps import configured
from benchmarks._measure import line, repeats
from benchmarks._posed_grasps import Placing, Sensing, draw_placing, posed_grasp
from cell.jobs.drawing import teach_drawing
from cell.simulation import drawn_shape
from recognition.dependence import evidence, independent_share
from recognition.grasp import Grasp
from recognition.next_pose import best_of
from recognition.pose_memory import PoseMemory, remember
from recognition.recognizer import Posterior, Recognizer
from recognition.recognizers import make_trainer
from simulator.shapes import PAPER_OBJECTS

PAPER = {name: name for name in PAPER_OBJECTS}
SIMILAR = {
    "ball 9.5": "sphere:diameter=9.5mm",
    "ball 10.5": "sphere:diameter=10.5mm",
    "rod 6": "cylinder:diameter=6mm,length=20mm",
    "rod 7": "cylinder:diameter=7mm,length=20mm",
}
TURNED = {
    "box 15.9": "box:length=15.9mm,width=10mm,height=10mm",
    "box 14": "box:length=14mm,width=10mm,height=10mm",
    "oval 14": "ellipsoid:length=14mm,diameter=11.7mm",
    "oval 13": "ellipsoid:length=13mm,diameter=11.7mm",
    "dumbbell": "dumbbell:length=13mm,diameter=10mm",
    "cylinder": "cylinder:diameter=10mm,length=13mm",
}
"""Objects of which some are told apart at some rotations only."""
DRAWN = {
    "oval": "ellipsoid:length=14mm,diameter=11.7mm",
    "cylinder": "cylinder:diameter=6mm,length=20mm",
    "box": "box:length=15.9mm,width=10mm,height=10mm",
    "ball": "sphere:diameter=9.5mm",
    "dumbbell": "dumbbell:length=13mm,diameter=10mm",
}
"""The paper's objects as drawings."""
SEEDS = (11, 12, 13)
NOISE = 2.0
_CANDIDATES = 24
_LONGEST = 10
_RUNS = 60
_TAUGHT = 20
_DRAWN = 60
_POOL = 100
_FIXED = 8
_SHOWN = (1, 2, 3, 5, 10)
_COMPARED = ("random", "largest force", "active")


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """Objects, and what is known of them."""

    name: str
    shapes: dict[str, str]
    aperture: bool
    drawn: bool = False


CASES = (
    Case(name="paper's objects, touch alone", shapes=PAPER, aperture=False),
    Case(name="similar objects, opening too", shapes=SIMILAR, aperture=True),
    Case(name="rotation matters, opening too", shapes=TURNED, aperture=True),
    Case(name="rotation matters, touch alone", shapes=TURNED, aperture=False),
    Case(name="from drawings, opening too", shapes=DRAWN, aperture=True, drawn=True),
)

TWO = Case(name="two balls", shapes=dict(list(SIMILAR.items())[:2]), aperture=True)


class Asked:
    """Grasps and what a recogniser says of them, before anybody chooses."""

    def __init__(self, grasps: Sequence[Grasp], recognizer: Recognizer) -> None:
        self.posteriors = [recognizer.posterior(grasp) for grasp in grasps]
        self.labels = recognizer.labels
        self.told = evidence(np.stack([p.probability for p in self.posteriors]))
        self.placings = np.array([g.placing.values for g in grasps if g.placing])
        self.classes = np.array([self.labels.index(g.label) for g in grasps])


def drawn_placings(
    case: Case, n: int, sensing: Sensing, seed: Sequence[int], repeat: int = 1
) -> list[Grasp]:
    """Return n grasps of each object at drawn placings, each repeated with other noise."""
    rng = np.random.default_rng([*seed, 0])
    grasps = []
    for label, shape in case.shapes.items():
        for _ in range(n):
            placing: Placing = draw_placing(rng)
            grasps += [
                posed_grasp(label, shape, placing, int(rng.integers(2**62)), sensing)
                for _ in range(repeat)
            ]
    return grasps


def taught(case: Case, n: int, sensing: Sensing, seed: int) -> list[Grasp]:
    """Return the grasps that teach: of the objects, or of their drawings."""
    if not case.drawn:
        return drawn_placings(case, n, sensing, [seed, 1])
    config = configured(case.shapes, 1)
    noisy = config.simulator.model_copy(update={"noise_level": sensing.noise})
    config = config.model_copy(update={"simulator": noisy})
    return [
        grasp
        for number, (label, text) in enumerate(case.shapes.items())
        for grasp in teach_drawing(config, label, drawn_shape(text), n, seed=100 * seed + number)
    ]


def right_after(pool: Asked, choose: str | PoseMemory, n_runs: int) -> NDArray[np.float64]:
    """Return whether the answers after 1, 2, ... grasps are right, (runs, longest)."""
    rng = np.random.default_rng(7)
    rows_right = []
    for truth in range(len(pool.labels)):
        rows = np.flatnonzero(pool.classes == truth)
        for _ in range(n_runs):
            taken: list[int] = []
            for _ in range(_LONGEST):
                offered = rng.permutation(rows)[:_CANDIDATES]
                left = offered[~np.isin(offered, taken)]
                place = 0
                if isinstance(choose, PoseMemory):
                    so_far: list[Posterior] = [pool.posteriors[row] for row in taken]
                    place = best_of(choose, so_far, pool.placings[left])
                elif choose == "largest force":
                    place = int(np.argmax(pool.placings[left, -1]))
                taken.append(int(left[place]))
            rows_right.append(answers_right(pool, taken, truth))
    return np.array(rows_right, dtype=np.float64)


def answers_right(pool: Asked, taken: Sequence[int], truth: int) -> list[bool]:
    """Say whether the answer is right after each further grasp."""
    dependence = pool.posteriors[0].dependence
    sums = np.cumsum(pool.told[list(taken)], axis=0)
    return [
        int(np.argmax(log_softmax(independent_share(k + 1, dependence) * row))) == truth
        for k, row in enumerate(sums)
    ]


def fixed_pose(asked: Asked) -> NDArray[np.float64]:
    """Return whether the answers of sequences that repeat one placing are right."""
    runs = np.arange(len(asked.classes)).reshape(-1, _LONGEST)
    return np.array([answers_right(asked, run, int(asked.classes[run[0]])) for run in runs])


def measure(case: Case, seed: int, effort: float) -> dict[str, NDArray[np.float64]]:
    """Return right answers of each way to choose, for one draw of all grasps."""
    sensing = Sensing(noise=NOISE, aperture_known=case.aperture)
    n_taught = repeats(_DRAWN if case.drawn else _TAUGHT, effort, least=8)
    train = taught(case, n_taught, sensing, seed)
    trainer = make_trainer("force_ramp", use_aperture=case.aperture)
    recognizer = trainer.fit(train)

    def asked(n: int, least: int, use: int, repeat: int = 1) -> Asked:
        number = repeats(n, effort, least=least)
        grasps = drawn_placings(case, number, sensing, [seed, use], repeat)
        return Asked(grasps, recognizer)

    pool = asked(_POOL, _LONGEST + 2, 2)
    n_runs = repeats(_RUNS, effort, least=2)
    return {
        "fixed pose": fixed_pose(asked(_FIXED, 1, 4, _LONGEST)),
        "random": right_after(pool, "random", n_runs),
        "largest force": right_after(pool, "largest force", n_runs),
        "active": right_after(pool, remember(trainer, train), n_runs),
    }


def show(case: Case, seeds: Sequence[int], effort: float) -> dict[str, int]:
    """Print right answers after some grasps, the number to 99 %, and active against the others.

    Returns
    -------
    Wrong answers after three grasps of each way to choose.
    """
    found = [measure(case, seed, effort) for seed in seeds]
    for name in found[0]:
        share = np.mean([runs[name].mean(axis=0) for runs in found], axis=0)
        enough = np.flatnonzero(share >= 0.99)
        need = f"{enough[0] + 1}" if len(enough) else f"more than {_LONGEST}"
        shown = " ".join(f"{100 * share[k - 1]:.1f}" for k in _SHOWN)
        shown_at = ", ".join(map(str, _SHOWN))
        line(f"    {name}", f"{shown} % after {shown_at}; grasps to 99 %: {need}")
    for name in ("random", "largest force"):
        parts = []
        for k in _SHOWN[:4]:
            by_seed = [
                100 * float(np.mean(runs["active"][:, k - 1] - runs[name][:, k - 1]))
                for runs in found
            ]
            parts.append(f"{np.mean(by_seed):+.1f} ({min(by_seed):+.1f} to {max(by_seed):+.1f})")
        line(f"    active minus {name}", "; ".join(parts) + " over the seeds")
    return {name: int(sum(np.sum(1.0 - runs[name][:, 2]) for runs in found)) for name in _COMPARED}


def main(effort: float = 1.0) -> None:
    line(
        "compared",
        f"ways to choose the next of {_CANDIDATES} placings, twice the noise, seeds {SEEDS}",
    )
    cases, seeds = (CASES, SEEDS) if effort >= 0.2 else ((TWO,), SEEDS[:1])
    wrong = dict.fromkeys(_COMPARED, 0)
    for case in cases:
        line(f"  {case.name}", f"{len(case.shapes)} objects")
        for name, n in show(case, seeds, effort).items():
            wrong[name] += n
    line("  ratio", f"wrong after three grasps, all cases: {wrong}")


if __name__ == "__main__":
    main()
