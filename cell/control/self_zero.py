"""Self-zeros of a cell: when one is due, what is refused, and where the newest is kept."""

import json
import math
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Literal

from cell.data.files import write_atomically
from cell.errors import CellError, PlanRefused, ZeroRefused
from gripper.errors import PartBetweenFingers
from recognition.drift.self_zero import ZeroMeasurement
from recognition.grasp import ZERO_COLUMNS, SelfZero
from tactile.layout import TaxelLayout

When = Literal["always", "daily", "on_demand", "never"]

_MOST_TILT_RAD = math.radians(4.0)
"""Largest tilt in rad of pads that lie on each other: beyond it a finger is bent, a pad loose."""
_MOST_RATIO = 1.6
"""Largest ratio of the gains of both pads: beyond it a grasp ends with fingers that press
differently (`gripper.limits.imbalance_share`)."""
_LONGEST_S = 86_400.0
"""Age in s up to which a self-zero counts: a day."""
_MOST_BYTES = 10_000
"""Longest file of a self-zero."""


def zero_file(directory: Path, cell_name: str) -> Path:
    """Return the file that keeps the self-zero of a cell beside the folders of its jobs."""
    name = "".join(sign if sign.isalnum() else "-" for sign in cell_name)
    return directory / f"self-zero-{name}.json"


class SelfZeros:
    """The newest self-zero of a cell, and when the next one is due.

    One that is older than a day counts no more: the hand may have changed since.

    Parameters
    ----------
    when
        At which starts it is due, as the config's ``self_zero`` has it.
    pads_meet
        Whether the pads of these fingers can press flat on each other.
    path
        File that keeps it from program to program; None: this program alone has it. One that cannot
        be read counts as none.
    now_s
        Returns the unix time in s.

    Attributes
    ----------
    measured_s
        Unix time in s of the last one, however old; 0 where there is none.
    """

    def __init__(
        self,
        when: When = "on_demand",
        *,
        pads_meet: bool = True,
        path: Path | None = None,
        now_s: Callable[[], float] = time.time,
    ) -> None:
        self._when = when
        self._pads_meet = pads_meet
        self._path = path
        self._now_s = now_s
        self._last: SelfZero | None = None
        self.measured_s = 0.0
        if path is not None and when != "never":
            self._read(path)

    @property
    def newest(self) -> SelfZero | None:
        """The newest self-zero; None where there is none of the last day."""
        young = abs(self._now_s() - self.measured_s) <= _LONGEST_S
        return self._last if young else None

    @property
    def due(self) -> bool:
        """Whether a start measures it now."""
        if self._when == "daily":
            last, now = map(date.fromtimestamp, (self.measured_s, self._now_s()))
            return self._last is None or last != now
        return self._when == "always"

    def check(self) -> None:
        """Raise PlanRefused where these fingers have no self-zero."""
        if not self._pads_meet:
            raise PlanRefused(
                "gripper.pads_meet is false: these fingers cannot meet. Gauge them with a taught "
                "object in a holder: `tactile-cell calibrate --gauge`"
            )
        if self._when == "never":
            raise PlanRefused("self_zero is never: write on_demand, daily or always in the config")

    def keep(self, zero: SelfZero) -> None:
        """Keep a self-zero that was measured now; raises CellError where it cannot be written."""
        self._last, self.measured_s = zero, self._now_s()
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            text = json.dumps({"measured_s": self.measured_s} | zero_values(zero), indent=1)
            write_atomically(
                self._path,
                lambda file: file.write(text.encode()),
                error=CellError,
                what="self-zero",
            )

    def _read(self, path: Path) -> None:
        try:
            if path.stat().st_size > _MOST_BYTES:
                return
            values = json.loads(path.read_text())
            measured_s = float(values["measured_s"])
            date.fromtimestamp(measured_s)
            self._last = SelfZero.from_values([values[name] for name in ZERO_COLUMNS])
            self.measured_s = measured_s
        except (OSError, ValueError, KeyError, TypeError, OverflowError):
            self._last = None


def check_pads_met(found: ZeroMeasurement) -> None:
    """Raise PartBetweenFingers where the footprint is not that of two pads on each other."""
    if not found.pads_met:
        raise PartBetweenFingers(
            f"the empty fingers were to meet, and the pads show another footprint than their own "
            f"(two plane pads explain {100 * max(found.fit, 0.0):.0f} % of it) near an opening of "
            f"{found.zero.opening_m * 1e3:.1f} mm: something is between them, or a pad is "
            f"damaged. The grip is kept. Look; clear the fault and release"
        )


def refuse_unsound(found: ZeroMeasurement) -> None:
    """Raise ZeroRefused where a finger is bent, or one pad feels far less than the other."""
    tilt_deg = [math.degrees(tilt) for tilt in found.tilt_rad]
    if max(map(abs, found.tilt_rad)) > _MOST_TILT_RAD:
        raise ZeroRefused(
            f"the pads meet at {tilt_deg[0]:+.1f} degrees along the fingers and "
            f"{tilt_deg[1]:+.1f} across, {math.degrees(_MOST_TILT_RAD):.0f} are allowed: a finger "
            f"is bent or a pad is loose; straighten or mend it, then measure again"
        )
    ratio = math.exp(found.zero.log_gain_ratio)
    if not 1.0 / _MOST_RATIO <= ratio <= _MOST_RATIO:
        weak = 0 if ratio < 1.0 else 1
        raise ZeroRefused(
            f"under one force the pad of finger 0 shows {ratio:.2f} times what that of finger 1 "
            f"shows, {_MOST_RATIO:g} or its inverse are allowed: the pad of finger {weak} is worn, "
            f"or its cable damaged; change it, then measure again"
        )


def dead_taxels_text(found: ZeroMeasurement, layout: TaxelLayout) -> str:
    """Return which taxels feel nothing, as a note; empty where all do."""
    if not found.dead:
        return ""
    places = ", ".join(
        f"{int(taxel) - layout.taxels_of(pad).start} of {layout.pads[pad].name}"
        for taxel in found.dead[:8]
        for pad in (int(layout.taxel_pad[taxel]),)
    )
    return f"{len(found.dead)} taxels feel nothing where their neighbours do: {places}"


def zero_values(zero: SelfZero) -> dict[str, float]:
    """Return a self-zero as plain data, by the names of its numbers."""
    return dict(zip(ZERO_COLUMNS, zero.values, strict=True))


def zero_text(found: ZeroMeasurement) -> str:
    """Return a self-zero as text for people: zero, gains, foam, how the pads stand."""
    zero = found.zero
    along_deg, across_deg = (math.degrees(tilt) for tilt in found.tilt_rad)
    return (
        f"pads meet at {zero.opening_m * 1e3:+.2f} mm (±{zero.opening_sd_m * 1e3:.2f}), finger 0 "
        f"feels {math.exp(zero.log_gain_ratio):.2f} times finger 1 "
        f"(±{zero.log_gain_ratio_sd:.2f}), tilt {along_deg:+.1f} and {across_deg:+.1f} degrees"
    )
