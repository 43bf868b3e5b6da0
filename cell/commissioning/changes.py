"""Changes of a cell since its commissioning; each names the steps to repeat."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.checks.findings import Finding, Verdict, check_result
from cell.commissioning.bench import Bench
from cell.commissioning.pads import taxel_names
from gripper.dynamixel.models import model_name
from gripper.errors import GripperError
from tactile.control_unit.search import read_unit
from tactile.errors import TactileError
from tactile.layout import PadMount, TaxelLayout, taxel_order
from tactile.sensor.tare import assess_health
from tactile.source import SourceIdentity

_ZERO_SHARE = 0.03
"""Reported change of a pad's zero, as a share of the full scale; drift of hours is a third of it.
"""
_NOISE_FACTOR = 2.0
"""Reported noise of a pad, as a multiple of its noise at commissioning."""
_LEAST_NOISE = 1.0
"""Noise in counts; smaller values are raised to it before the factor applies."""

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


def since_commissioning(
    folder: Path, found: Found, what: str, changes: Sequence[Finding]
) -> list[Finding]:
    """Return the changes with advice, or one finding without any; empty without ``found``."""
    if not found:
        return []
    place = "" if folder == Path() else f" {quote(str(folder))}"
    command = f"`tactile-cell commission{place} --redo"
    return [
        replace(change, advice=f"{command} {change.step}` repeats the steps it affects")
        for change in changes
    ] or [check_result(what, "as at commissioning", ok=True)]


def changed_hardware(bench: Bench) -> list[Finding]:
    """Read the identity of unit and servos of a bench, and return the changes.

    A line that cannot be opened or is silent is skipped: its own step finds the cause.
    """
    changes: list[Finding] = []
    if "serial_number" in bench.found.get("unit", {}):
        with suppress(TactileError), bench.can_bus() as can_bus:
            unit = read_unit(can_bus, bench.tactile().node_id)
            changes += changed_unit(bench.found, unit.identity)
    if "servos" in bench.found:
        with suppress(GripperError), bench.servo_bus() as servo_bus:
            pings = [servo_bus.ping(servo.id) for servo in bench.gripper().servos]
            servos = {p.servo_id: (model_name(p.model_number), p.firmware) for p in pings}
            changes += changed_servos(bench.found, servos)
    return changes
