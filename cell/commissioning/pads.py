"""The pads: zero, noise and broken taxels at rest, the position of each, the law of its newtons.

A fingertip shows the position of a pad; weights or a kitchen scale check the law, which is
corrected. Functions of frames and loads judge: `judge_rest`, `pressed_at`, `mounts_of`,
`judge_law`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Step, StepFailed
from cell.commissioning.findings import Notes
from cell.commissioning.unit import unit_sensor
from cell.config.tactile import TactileConfig
from cell.errors import raised_as
from cell.hand.local import sensor_settings
from tactile.control_unit.node import Mounting
from tactile.errors import TareRefused
from tactile.layout import PadMount, TaxelLayout
from tactile.sensor.calibration import Calibration
from tactile.sensor.filters import Neighbourhood
from tactile.sensor.sensor import TactileSensor
from tactile.sensor.settings import SensorSettings
from tactile.sensor.tare import assess_health, compute_tare

_REST_FRAMES = 100
"""Number of frames at rest, the same as for the zero of a cell."""
_NOISY_FACTOR = 2.0
"""Least reported noise of a pad, relative to the quietest one: pads of one make differ by less than
a third in the simulated cell."""
_NOISE_PER_CONTACT = 1.5
"""Largest noise of a pad's force over the contact force: above it no contact can be detected; the
same limit as for simulated noise."""
_PRESS_N = 0.5
"""Force in N on a pad that counts as pressed by a fingertip, by any law."""
_PRESS_FRAMES = 10
"""Frames whose mean shows a resting fingertip: 0.2 s."""
_OFF_MIDDLE = 0.15
"""Least distance from the pad's middle, in half extents, of a patch on one side."""
_LOOK_FRAMES = 5
"""Frames between two texts on the screen: ten a second."""

_TAXELS_NAMED = 6
"""Most taxels that are named individually; further taxels are counted."""

Counts = NDArray[np.uint16]


def taxel_names(layout: TaxelLayout, taxels: Sequence[int]) -> str:
    """Return the names of taxels by pad, row and column; of many taxels only the first."""
    named = [layout.place(taxel) for taxel in taxels[:_TAXELS_NAMED]]
    if (more := len(taxels) - len(named)) > 0:
        named.append(f"and {more} more")
    return ", ".join(named)


def judge_rest(
    layout: TaxelLayout,
    calibration: Calibration,
    frames: Counts,
    notes: Notes,
    *,
    limits: SensorSettings,
    contact_force_n: float,
) -> None:
    """Note zero and noise of untouched pads, and why they are not suitable for grasps.

    Parameters
    ----------
    layout, calibration, frames
        The taxels, their law, and frames (n, n_taxels) at rest.
    limits
        Limits of the zero.
    contact_force_n
        Force in N that must be detected.
    """
    zero_counts, health = frames.mean(axis=0), assess_health(frames, layout.adc_max)
    zero, noise = layout.medians(zero_counts), layout.medians(frames.std(axis=0))
    n, averaged = len(frames) // limits.mean_frames, limits.mean_frames
    tared = np.where(health.bad, 0.0, frames[: n * averaged] - zero_counts)
    force_n = calibration.force_n(tared.reshape(n, averaged, -1).mean(axis=1))
    noises_n = {
        layout.pads[pad].name: float(force_n[:, layout.taxels_of(pad)].sum(axis=1).std(ddof=1))
        for pad in layout.gripping_pads
    }
    first_n, second_n = noises_n.values()
    notes.fact(
        f"{layout.n_taxels} taxels read: zero {min(zero):.1f} to {max(zero):.1f}, noise "
        f"{min(noise):.1f} to {max(noise):.1f} counts of {layout.adc_max} by pad; at rest the "
        f"force of the inner pads varies by {first_n:.2f} and {second_n:.2f} N."
    )
    for name, mask in health.kinds.items():
        if taxels := np.flatnonzero(mask).tolist():
            are = "1 taxel is" if len(taxels) == 1 else f"{len(taxels)} taxels are"
            names = taxel_names(layout, taxels)
            notes.warn(f"{are} {name}: {names}. Their neighbours replace them.")
    if not health.lively:
        notes.warn("The counts hardly change at rest: press each pad to find dead or stuck taxels.")
    quiet = max(min(noise), 1.0)
    for pad, counts in zip(layout.pads, noise, strict=True):
        if counts > _NOISY_FACTOR * quiet:
            notes.warn(
                f"{pad.name} is noisy: {counts:.1f} counts, the quietest pad {quiet:.1f}. Check "
                "the shield of its cable, its ground and its plug."
            )
    for name, noise_n in noises_n.items():
        if noise_n > _NOISE_PER_CONTACT * contact_force_n:
            notes.fail(
                f"The force of {name} at rest varies by {noise_n:.2f} N, too much for a contact "
                f"at {contact_force_n:g} N: reduce its noise, or raise gripper.contact_force_n."
            )
    if not notes.failed:
        try:
            compute_tare(Neighbourhood(layout), frames, limits, 0.0)
        except TareRefused as why:
            notes.fail(f"No zero can be taken: {why}.")


def measure_rest(bench: Bench, dialog: Dialog, notes: Notes) -> None:
    """Read the taxels for two seconds while nothing touches the pads.

    This gives zero, noise, dead and stuck taxels, and whether the forces of the config can be
    measured. Nothing moves.
    """
    dialog.say("Keep your hands and everything else off the pads for two seconds.")
    with unit_sensor(bench) as sensor:
        frames = np.stack([sensor.read(timeout_s=1.0).frame.counts for _ in range(_REST_FRAMES)])
        layout, calibration = sensor.layout, sensor.calibration
        boards = (0, 0) if sensor.identity is None else sensor.identity.boards
    judge_rest(
        layout,
        calibration,
        frames,
        notes,
        limits=sensor_settings(bench.tactile()),
        contact_force_n=bench.gripper().contact_force_n,
    )
    alike = boards[0] == boards[1]
    notes.settings["tactile.board_serial_numbers"] = None if alike else list(boards)
    if alike:
        notes.warn(
            "The boards of both fingers have no different serial numbers, so exchanged pads are "
            "not detected: press each pad after every work on their cables."
        )
    notes.values["board_serial_numbers"] = list(boards)


PADS_AT_REST = Step(measure_rest, "pads_at_rest", "Pads at rest", needs=("unit",))


@dataclass(frozen=True, slots=True, kw_only=True)
class Patch:
    """Patch of a fingertip, in the order of the unit's taxels."""

    pad: int
    """Pad whose taxels show it."""
    along: float
    across: float
    """Position on that pad, -1 to 1 along its rows and its columns."""
    force_n: float
    """Force in N by the law so far."""


def pressed_at(layout: TaxelLayout, force_n: NDArray[np.float64]) -> Patch | None:
    """Return the patch on the most loaded pad; None if no pad is pressed.

    ``force_n`` is (n_taxels,) float64: the force on each touched taxel in N.
    """
    sums = [float(force_n[layout.taxels_of(pad)].sum()) for pad in range(layout.n_pads)]
    number = int(np.argmax(sums))
    if sums[number] < _PRESS_N:
        return None
    pad, taxels_n = layout.pads[number], force_n[layout.taxels_of(number)]
    half_m = 0.5 * np.array([pad.rows * pad.pitch_x_m, pad.columns * pad.pitch_y_m])
    along, across = (taxels_n @ pad.taxel_xy_m() / sums[number] / half_m).tolist()
    return Patch(pad=number, along=along, across=across, force_n=sums[number])


def corner_text(layout: TaxelLayout, pad: int) -> str:
    """Return the corner of the last row and column of a pad as text, for a person facing it."""
    geometry = layout.pads[pad]
    # Finger 1's frame is left-handed: left of finger 0 is right there.
    side = "left" if geometry.finger == 0 else "right"
    if abs(geometry.x_axis[0]) > 0.5:
        return f"near the tip and at the {side} edge, as you look at it with the tip upwards"
    return (
        f"at the edge towards the other finger and on the {side}, as you look at the inner face "
        "with the tip upwards"
    )


def mounts_of(layout: TaxelLayout, patches: Mapping[int, Patch]) -> tuple[PadMount, ...]:
    """Return the pads whose mounting differs from the layout.

    ``patches``: measured patch by pad, each pressed near its last row and column.
    """
    mounts = []
    for pad, patch in patches.items():
        mount = PadMount(
            pad=pad,
            sent_as=patch.pad,
            rows_mirrored=layout.pads[pad].rows > 1 and patch.along < 0.0,
            columns_mirrored=layout.pads[pad].columns > 1 and patch.across < 0.0,
        )
        if mount != PadMount(pad=pad, sent_as=pad):
            mounts.append(mount)
    return tuple(mounts)


def mount_lines(layout: TaxelLayout, mounts: Sequence[PadMount]) -> list[str]:
    """Return differences of the mounting from the layout as text."""
    lines, moved = [], []
    for mount in mounts:
        name = layout.pads[mount.pad].name
        if mount.sent_as != mount.pad:
            moved.append(f"{name} in that of {layout.pads[mount.sent_as].name}")
        if mount.rows_mirrored and mount.columns_mirrored:
            lines.append(f"{name} is turned by 180 degrees: set in tactile.mounting.")
        elif mount.rows_mirrored or mount.columns_mirrored:
            what = "rows" if mount.rows_mirrored else "columns"
            lines.append(f"The {what} of {name} run the other way: set in tactile.mounting.")
    if moved:
        lines.append(
            f"Pads are plugged in the places of others, {', '.join(moved)}: set in "
            "tactile.mounting. Or exchange their cables at the unit and run this step again."
        )
    return lines


def find_mounting(bench: Bench, dialog: Dialog, notes: Notes) -> None:
    """Press each pad with a fingertip, one after another.

    Exchanged fingers, turned and mirrored pads are found and set in the config. Nothing moves.
    """
    dialog.say(
        "Finger 0 is the one that the first servo drives. Nothing may touch the pads at first."
    )
    with unit_sensor(bench, mounted=False) as sensor:
        layout = sensor.layout
        sensor.tare(bench.tactile().tare_frames)
        grip = layout.gripping_pads
        patches: dict[int, Patch] = {}
        for pad in sorted(range(layout.n_pads), key=lambda pad: pad not in grip):
            force_n = _pressed(sensor, dialog, pad, patches)
            if force_n is not None and (patch := pressed_at(layout, force_n)):
                patches[pad] = patch
        dialog.say("Lift the fingertip.")
    names = [pad.name for pad in layout.pads]
    mounts = mounts_of(layout, patches)
    notes.fact(f"{len(patches)} pads were pressed, one after another.")
    for line in mount_lines(layout, mounts):
        notes.warn(line, corrected=True)
    if bench.tactile().sends_forces and not Mounting(layout, mounts).unit_can_sum:
        notes.warn(
            "The inner pads have different mountings, so the force comes from whole frames, which "
            "is slower: turn one pad, or set gripper.approach_speed_mm_s to 12."
        )
    for pad in (pad for pad in range(layout.n_pads) if pad not in patches):
        (notes.fail if pad in grip else notes.warn)(
            f"{names[pad]} was not found: no other pad of its size showed a patch. Check its plug "
            "and cable."
        )
    notes.values["patches"] = {names[pad]: asdict(patch) for pad, patch in patches.items()}
    notes.settings["tactile.mounting"] = [asdict(mount) for mount in mounts]


PADS_PRESSED = Step(find_mounting, "pads_pressed", "Which pad is where", needs=("pads_at_rest",))


def _pressed(
    sensor: TactileSensor, dialog: Dialog, pad: int, patches: Mapping[int, Patch]
) -> NDArray[np.float64] | None:
    """Ask for a press on a pad until its patch can be that of the pad; None if it shows nothing.

    Returns (n_taxels,) float64: the force on each taxel in N. ``patches`` are those of other pads.
    """

    def force_n(n_frames: int) -> NDArray[np.float64]:
        forces = [sensor.read(timeout_s=1.0).force_n for _ in range(n_frames)]
        return np.asarray(np.mean(forces, axis=0))

    layout = sensor.layout
    while True:
        answer = dialog.choose(
            "pads_pressed.press",
            f"Press {layout.pads[pad].name} with a fingertip {corner_text(layout, pad)}; hold it.",
            {"done": "it is pressed", "skip": "it shows nothing: continue without it"},
            "done",
            watch=lambda: _patch_text(layout, pressed_at(layout, force_n(_LOOK_FRAMES))),
        )
        if answer == "skip":
            return None
        found_n = force_n(_PRESS_FRAMES)
        complaint = _complaint(layout, pad, pressed_at(layout, found_n), patches)
        if not complaint:
            return found_n
        dialog.say(complaint)


def _complaint(
    layout: TaxelLayout, pad: int, patch: Patch | None, patches: Mapping[int, Patch]
) -> str:
    """Return why a patch cannot be that of the requested pad, or an empty text."""
    if patch is None:
        return "No pad shows a fingertip."
    asked, seen = layout.pads[pad], layout.pads[patch.pad]
    for other, earlier in patches.items():
        if earlier.pad == patch.pad:
            return f"The patch is where {layout.pads[other].name} was found: press {asked.name}."
    if (asked.rows, asked.columns) != (seen.rows, seen.columns):
        return f"The patch is on {seen.name}, a pad of another size: press {asked.name}."
    places = ((patch.along, asked.rows), (patch.across, asked.columns))
    if min((abs(place) for place, n in places if n > 1), default=1.0) < _OFF_MIDDLE:
        return "The patch is in the middle of the pad: press nearer to the corner."
    return ""


def _patch_text(layout: TaxelLayout, patch: Patch | None) -> str:
    if patch is None:
        return "nothing"
    pad = layout.pads[patch.pad]
    row = round((patch.along + 1.0) * 0.5 * pad.rows + 0.5)
    column = round((patch.across + 1.0) * 0.5 * pad.columns + 0.5)
    return (
        f"{patch.force_n:.1f} N at row {row} of {pad.rows}, column {column} of {pad.columns} of "
        f"the place of {pad.name}"
    )


# The law from counts to newtons


GRAVITY_N_KG = 9.80665
"""Standard acceleration of free fall (ISO 80000-3), which a kitchen scale assumes for its grams."""
_TABLE_SHARES = (0.0, 0.0625, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0)
"""Nodes of a table of counts and forces, as shares of the full scale."""
_STEPS = 3
"""Loads on each inner pad."""
_LOAD_FRAMES = 25
"""Frames whose mean is a load: half a second."""
_WATCH_FRAMES = 4
"""Frames between two values on the screen."""
_RIGHT_SHARE = 0.05
"""Largest deviation of the factor from 1 of a correct law: a kitchen scale held by hand varies by
2 %, the simulated cell by up to 3 %."""
_RESIDUAL_SHARE = 0.12
"""Root mean square residual over the largest load above which a factor cannot correct the law."""
_FINGERS_APART = 0.12
"""Least reported difference of the factors of both pads."""
_LEAST_LOAD_N = 0.2
"""Smallest load in N that counts: the noise is a tenth of smaller ones."""


Load = tuple[float, ...]
"""True force and force shown in N, and the parts of `table_parts`."""


def fit_factor(loads: Sequence[Load]) -> tuple[float, float]:
    """Return the factor that fits the shown forces of loads best to the true ones.

    With it comes the root of the mean squared residual in N. Raises ValueError without shown
    forces or loads.
    """
    true, measured = np.array([load[:2] for load in loads]).reshape(-1, 2).T
    power = float(measured @ measured)
    if not power > 0.0:
        raise ValueError("the pads show no force under these loads")
    factor = float(true @ measured) / power
    return factor, float(np.sqrt(np.mean((true - factor * measured) ** 2)))


def table_parts(tared_counts: ArrayLike, adc_max: int) -> list[float]:
    """Return the counts of a pad in each part of the full scale, summed over taxels.

    A law of straight lines over these parts gives the pad's force as their sum, each times its
    slope. ``tared_counts`` is (n,).
    """
    counts = np.asarray(tared_counts, dtype=np.float64)[:, np.newaxis]
    nodes = adc_max * np.array(_TABLE_SHARES)
    parts = np.clip(counts - nodes[:-1], 0.0, np.diff(nodes))
    # The first line continues below zero: noise averages out.
    parts[:, 0] = np.minimum(counts[:, 0], nodes[1])
    return [float(part) for part in parts.sum(axis=0)]


def fit_table(
    true_n: ArrayLike, parts: ArrayLike, adc_max: int
) -> tuple[list[float], list[float], float]:
    """Return counts and forces in N of the table that fits the loads, and its residual in N.

    A pressed taxel is less sensitive, so each line is at least as steep as the one before. The
    table ends with the last part that has counts of the loads. Raises ValueError if no table fits.

    Parameters
    ----------
    true_n
        (n,): loads in N.
    parts
        (n, n_parts): `table_parts` of each load.
    """
    loads, counted = np.asarray(true_n), np.asarray(parts)
    used = int(np.count_nonzero(counted.max(axis=0) > 0.0))
    if not used:
        raise ValueError("the loads show no counts")
    # Rising slopes are sums of non-negative steps.
    steps = np.cumsum(counted[:, :used][:, ::-1], axis=1)[:, ::-1]
    rises, _ = nnls(steps, loads)
    slopes = np.cumsum(rises)
    if not slopes[0] > 0.0:
        raise ValueError("the loads show no law that rises with the counts")
    nodes = adc_max * np.array(_TABLE_SHARES[: used + 1])
    force_n = np.cumsum(slopes * np.diff(nodes))
    residual_n = float(np.sqrt(np.mean((steps @ rises - loads) ** 2)))
    return np.round(nodes[1:], 1).tolist(), np.round(force_n, 5).tolist(), residual_n


def measure_law(bench: Bench, dialog: Dialog, notes: Notes) -> None:
    """Load each inner pad three times with a weight or against a kitchen scale.

    Type the reading in grams: the law from counts to newtons is checked, and its factor or a table
    set. Nothing moves.
    """
    answer = dialog.choose(
        "pads_law.with",
        "Do you have weights of up to a kilogram, or a kitchen scale? Nothing may touch the pads "
        "while you answer: their zero is taken next.",
        {"scale": "yes", "skip": "no: forces stay unchecked"},
        "scale",
    )
    if answer == "skip":
        notes.warn(
            "The forces of the pads were not checked: they may be wrong by a fifth and more. Run "
            "this step again with a kitchen scale before parts that can break."
        )
        return
    dialog.say(
        "Lay a flat stamp of about 10 mm across on the middle of the pad. Press it against the "
        "scale, or lay the weight on it, and keep it so until the next question."
    )
    with unit_sensor(bench) as sensor:
        sensor.tare(bench.tactile().tare_frames)
        loads = [_loads(sensor, dialog, finger, _targets_n(bench)) for finger in (0, 1)]
        adc_max = sensor.layout.adc_max
    judge_law(bench.tactile(), loads, notes, adc_max)


LAW = Step(measure_law, "pads_law", "Newtons of the pads", needs=("pads_pressed",))


def _targets_n(bench: Bench) -> list[float]:
    """Return the planned loads in N: even steps over the forces of the config's sequence."""
    least_n, most_n = bench.base.sequence.forces_n
    return [round(float(n), 1) for n in np.linspace(min(least_n, 0.5 * most_n), most_n, _STEPS)]


def _loads(
    sensor: TactileSensor, dialog: Dialog, finger: int, targets_n: Sequence[float]
) -> list[Load]:
    """Return the true and shown forces of the loads on one inner pad."""
    loads = list[Load]()
    pad = sensor.layout.gripping_pads[finger]
    name = sensor.layout.pads[pad].name
    most_g = 2e3 * max(targets_n) / GRAVITY_N_KG
    for number, target_n in enumerate(targets_n, start=1):
        weight_g = dialog.number(
            f"pads_law.{finger}.{number}",
            f"Load {number} of {len(targets_n)} on {name}: about "
            f"{1e3 * target_n / GRAVITY_N_KG:.0f} g. Type the reading while it lies there.",
            (1.0, round(most_g), "g"),
            watch=lambda: (
                f"{name} shows {_force_n(sensor, pad, _counts(sensor, pad, _WATCH_FRAMES)):.2f} N"
            ),
        )
        true_n = 1e-3 * weight_g * GRAVITY_N_KG
        counts = _counts(sensor, pad, _LOAD_FRAMES)
        parts = table_parts(counts, sensor.layout.adc_max)
        loads.append((true_n, _force_n(sensor, pad, counts), *parts))
        dialog.say(f"{true_n:.2f} N on the scale, {loads[-1][1]:.2f} N by the pad.")
    dialog.say("Take the load off.")
    return loads


def _counts(sensor: TactileSensor, pad: int, n_frames: int) -> NDArray[np.float64]:
    """Return the tared counts of a pad's taxels, (n,), as the mean of some frames.

    The sensor itself omits taxels below the noise of three frames.
    """
    counts = np.mean([sensor.read(timeout_s=1.0).tared_counts for _ in range(n_frames)], axis=0)
    return np.asarray(counts[sensor.layout.taxels_of(pad)], dtype=np.float64)


def _force_n(sensor: TactileSensor, pad: int, counts: NDArray[np.float64]) -> float:
    """Return the force in N by the present law from the tared counts of a pad."""
    of_all = np.zeros(sensor.layout.n_taxels)
    taxels = sensor.layout.taxels_of(pad)
    of_all[taxels] = counts
    return float(sensor.calibration.force_n(of_all)[taxels].sum())


def judge_law(
    tactile: TactileConfig, loads: Sequence[Sequence[Load]], notes: Notes, adc_max: int = 0
) -> None:
    """Judge the law by the loads on both inner pads, and correct it.

    ``tactile`` has the law of the shown forces; ``loads`` are the true and the shown force in N of
    each load, by finger. Raises StepFailed if the loads show no law.
    """
    both = [load for of_finger in loads for load in of_finger if load[0] >= _LEAST_LOAD_N]
    where = "No law can be found; press on the middle of each pad"
    with raised_as(StepFailed, ValueError, where=where):
        *fits, (factor, residual_n) = (fit_factor(series) for series in (*loads, both))
    notes.values |= {"loads_n": [[*map(list, series)] for series in loads], "factor": factor}
    notes.fact(
        f"{len(both)} loads up to {max(both)[0]:.1f} N: the pads show "
        f"{1.0 / factor:.0%} of the scale's force, residual {residual_n:.2f} N."
    )
    bent = any(
        of_finger_n > _RESIDUAL_SHARE * max(series)[0]
        for series, (_, of_finger_n) in zip(loads, fits, strict=True)
    )
    (first, _), (second, _) = fits
    differ = abs(first - second) / factor > _FINGERS_APART
    shares = (first / factor, second / factor) if differ else (1.0, 1.0)
    gains = [gain * share for gain, share in zip(tactile.pad_gains, shares, strict=True)]
    off = abs(factor - 1.0) > _RIGHT_SHARE
    if bent and _rising(loads) and _set_table(loads, gains, adc_max, notes):
        bent = off = False
    if bent or not _rising(loads):
        raise StepFailed(
            "The loads do not fit one law: load the middle of the pad again. If they still do not "
            "fit, the pads need another calibration (tactile.calibration)."
        )
    if off:
        gains = [gain * factor for gain in gains]
        notes.warn(
            f"The law was {abs(1.0 / factor - 1.0):.0%} off: both factors of tactile.pad_gains are "
            f"{factor:.3g} times those of before",
            corrected=True,
        )
    if differ:
        notes.warn(
            f"The pads differ: factor {first:.2f} on finger 0, {second:.2f} on finger 1; set in "
            "tactile.pad_gains. Check whether both have the same foam.",
            corrected=True,
        )
    if off or differ:
        notes.settings["tactile.pad_gains"] = [round(gain, 4) for gain in gains]


def _set_table(
    loads: Sequence[Sequence[Load]], gains: Sequence[float], adc_max: int, notes: Notes
) -> bool:
    """Set the table of the loads, and return whether they lie on it."""
    true_n = [load[0] / gain for series, gain in zip(loads, gains, strict=True) for load in series]
    parts = [load[2:] for series in loads for load in series]
    try:
        counts, force_n, residual_n = fit_table(true_n, parts, adc_max)
    except ValueError:
        return False
    if residual_n > _RESIDUAL_SHARE * max(true_n):
        return False
    notes.settings["tactile.calibration"] = {"counts": counts, "force_n": force_n}
    notes.values["table_residual_n"] = residual_n
    notes.warn(
        f"The law is a table of {len(counts)} lines now (tactile.calibration), residual "
        f"{residual_n:.2f} N.",
        corrected=True,
    )
    return True


def _rising(loads: Sequence[Sequence[Load]]) -> bool:
    """Return whether more load always shows more force."""
    return all(
        more[1] > less[1]
        for of_finger in loads
        for less, more in pairwise(sorted(of_finger))
        if more[0] > 1.1 * less[0]
    )
