"""Differences of a cell from its commissioning, and the steps to repeat."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from cell.checks.findings import Finding, Verdict, check_result, kept_values
from tactile.layout import PadMount, TaxelLayout, taxel_order
from tactile.sensor.tare import assess_health
from tactile.source import SourceIdentity

_OPENING_MM = 0.3
"""Reported difference of the opening in mm. Placing the object by hand gives less: a box tilted by
1 degree over 15 mm is 0.26 mm wider."""
_FINGERS_SHARE = 0.15
"""Reported change of the difference of both fingers' forces, as a share of the grip force."""
_CURRENT_SHARE = 0.3
"""Reported change of the motors' current at the same force, as a share; more means wear."""
_ZERO_SHARE = 0.03
"""Reported change of a pad's zero, as a share of the full scale; drift of hours is a third of it.
"""
_NOISE_FACTOR = 2.0
"""Reported noise of a pad, as a multiple of its noise at commissioning."""
_LEAST_NOISE = 1.0
"""Noise in counts; smaller values are raised to it before the factor applies."""
_TAXELS_NAMED = 6
"""Most taxels that are named individually; further taxels are counted."""


Found = Mapping[str, Mapping[str, Any]]
"""Values of the findings by the key of the step."""


def _change(
    what: str, step: str, was: Any, now: Any, text: str = "{}", *, differs: bool | None = None
) -> list[Finding]:
    """Return the change of one value; empty if it is equal, or if ``differs`` is false.

    ``text`` formats both values; ``step`` is the step to repeat.
    """
    if (was == now) if differs is None else not differs:
        return []
    found = f"{text.format(now)}, at commissioning {text.format(was)}"
    return [Finding(what=what, verdict=Verdict.WARN, found=found, step=step)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Gauge:
    """Measured values of a gauge object."""

    gauge: str
    """Name of the object."""
    force_n: float
    """Requested force in N."""
    held_n: tuple[float, float]
    """Force on finger 0 and 1 during the hold, in N."""
    contact_mm: float
    held_mm: float
    """Opening at the contact and during the hold, in mm."""
    current_ma: float
    """Mean goal current of the motors during the hold, in mA."""
    patch_taxels: tuple[int, int]
    """Touched taxels of the inner pad of finger 0 and 1."""


def changed_unit(found: Found, now: SourceIdentity) -> list[Finding]:
    """Return the differences of a control unit and its pads from the commissioning."""
    unit, pads = found.get("unit", {}), found.get("pads_at_rest", {})
    serial, revision = unit.get("serial_number", now.serial), unit.get("revision", now.revision)
    firmware = "firmware of the control unit"
    changes = _change("control unit", "unit", serial, now.serial, "serial {}")
    changes = changes or _change(firmware, "unit", revision, now.revision, "revision {:#x}")
    was = tuple(pads.get("board_serial_numbers", now.boards))
    if was == now.boards[::-1] != now.boards:
        both = f"serial {was[0]} on finger 0, {was[1]} on finger 1"
        return changes + _change("pads", "pads_at_rest", both, "exchanged")
    for finger in (0, 1):
        what, number = f"pads of finger {finger}", now.boards[finger]
        changes += _change(what, "pads_at_rest", was[finger], number, "serial {}")
    return changes


def changed_servos(found: Found, servos: Mapping[int, tuple[str, int]]) -> list[Finding]:
    """Return the differences of servos from the commissioning; ``servos``: model, firmware."""
    changes = []
    for was in found.get("servos", {}).get("servos", ()):
        before = (was["model"], was["firmware"])
        now = servos.get(was["id"], before)
        changes += _change(f"servo {was['id']}", "servos", before, now, "{0[0]}, firmware {0[1]}")
    return changes


def changed_pads(
    found: Found,
    layout: TaxelLayout,
    frames: NDArray[np.uint16],
    mounts: Sequence[PadMount] = (),
) -> list[Finding]:
    """Return the differences of pads at rest from the commissioning.

    Parameters
    ----------
    found
        Values of the findings by the key of the step.
    layout, frames
        The taxels, and at least 8 frames (n, n_taxels) without contact.
    mounts
        Mounting of the pads; the findings at rest are in the order of the unit's samples.
    """
    was = found.get("pads_at_rest", {})
    if len(was.get("zero_counts", ())) != layout.n_pads:
        return []
    zero, noise = frames.mean(axis=0), frames.std(axis=0)
    sent_as = {mount.pad: mount.sent_as for mount in mounts}
    known = np.isin(taxel_order(layout, mounts), was["bad_taxels"])
    bad = assess_health(frames, layout.adc_max).bad
    new = np.flatnonzero(bad & ~known).tolist()
    step, changes = "pads_at_rest", []
    if new:
        broken = f"{np.count_nonzero(bad)}, new: {taxel_names(layout, new)}"
        was_broken = str(len(was["bad_taxels"]))
        changes += _change("broken taxels", step, was_broken, broken)
    for number, pad in enumerate(layout.pads):
        taxels, place = layout.taxels_of(number), sent_as.get(number, number)
        before, now = was["zero_counts"][place], float(np.median(zero[taxels]))
        drifted = abs(now - before) > _ZERO_SHARE * layout.adc_max
        text = "{:.1f} counts"
        changes += _change(f"zero of {pad.name}", step, before, now, text, differs=drifted)
        before, now = was["noise_counts"][place], float(np.median(noise[taxels]))
        noisy = now > _NOISE_FACTOR * max(before, _LEAST_NOISE)
        changes += _change(f"noise of {pad.name}", step, before, now, text, differs=noisy)
    return changes


def taxel_names(layout: TaxelLayout, taxels: Sequence[int]) -> str:
    """Return the names of taxels by pad, row and column; of many taxels only the first."""
    named = []
    for taxel in taxels[:_TAXELS_NAMED]:
        pad = int(layout.taxel_pad[taxel])
        row, column = divmod(taxel - layout.taxels_of(pad).start, layout.pads[pad].columns)
        named.append(f"{layout.pads[pad].name} row {row} column {column}")
    if (more := len(taxels) - len(named)) > 0:
        named.append(f"and {more} more")
    return ", ".join(named)


def changed_gauge(was: Gauge, now: Gauge) -> list[Finding]:
    """Return the differences of the gauge object from the commissioning."""
    changes = []
    for what, before, after in (
        ("opening at the contact", was.contact_mm, now.contact_mm),
        ("opening on the gauge object", was.held_mm, now.held_mm),
    ):
        moved = abs(after - before) > _OPENING_MM
        changes += _change(what, "fingers", before, after, "{:.2f} mm", differs=moved)
    ratio = [(one.held_n[0] - one.held_n[1]) / (0.5 * sum(one.held_n)) for one in (was, now)]
    changes += _change(
        "forces of both fingers",
        "pads_law",
        was.held_n,
        now.held_n,
        "{0[0]:.2f} and {0[1]:.2f} N",
        differs=abs(ratio[1] - ratio[0]) > _FINGERS_SHARE,
    )
    current = _change(
        "current of the motors at the same force",
        "pads_law",
        was.current_ma,
        now.current_ma,
        "{:.0f} mA",
        differs=abs(now.current_ma - was.current_ma) > _CURRENT_SHARE * was.current_ma,
    )
    cause = "friction, or another law of the pads"
    changes += [replace(one, found=f"{one.found}: {cause}") for one in current]
    return changes


def gauge_of(found: Found) -> Gauge | None:
    """Return the gauge object of the commissioning; None without a gauge object."""
    values = found.get("baseline", {}).get("gauge")
    return None if values is None else TypeAdapter(Gauge).validate_python(values)


@dataclass(frozen=True, slots=True, kw_only=True)
class CommissionedValues:
    """Values of the commissioning and its folder; empty without a commissioning."""

    folder: Path
    found: Found

    def findings(self, what: str, changes: Sequence[Finding]) -> list[Finding]:
        """Return the changes since the commissioning with advice, or one finding without any."""
        if not self.found:
            return []
        place = "" if self.folder == Path() else f" {quote(str(self.folder))}"
        command = f"`tactile-cell commission{place} --redo"
        return [
            replace(change, advice=f"{command} {change.step}` repeats the steps it affects")
            for change in changes
        ] or [check_result(what, "as at commissioning", ok=True)]

    @classmethod
    def beside(cls, config_file: Path | None) -> Self:
        """Return the values beside a config file. Raises CellError if they cannot be read."""
        if config_file is None:
            return cls(folder=Path(), found={})
        return cls(folder=config_file.parent, found=kept_values(config_file.parent))
