"""What the control unit does on request by SDO: its own tare, its last frame."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tactile import eds
from tactile.clock import Clock
from tactile.errors import FrameError, TareRefused
from tactile.layout import TaxelLayout
from tactile.sdo import ObjectAccess

_REFUSALS = {
    int(eds.TareResult.REFUSED_TOUCHED): "a taxel was touched",
    int(eds.TareResult.REFUSED_SPREAD): "the counts moved while the zero was taken",
}


def take_unit_tare(
    objects: ObjectAccess, *, clock: Clock, pump: Callable[[], None], timeout_s: float
) -> None:
    """Let the unit take its own zero and wait for the result.

    Parameters
    ----------
    objects
        The unit's objects.
    clock
        Measures the time-out.
    pump
        Called between two looks at the result; lets time pass and frames run.
    timeout_s
        Longest wait in s.

    Raises
    ------
    TareRefused
        When the unit refuses, or does not come to an end.
    """
    deadline_s = clock.monotonic() + timeout_s
    objects.write_unsigned(eds.TARE, eds.TARE_COMMAND, eds.TARE_SIGNATURE, 4)
    while (result := objects.read_unsigned(eds.TARE, eds.TARE_RESULT)) == eds.TareResult.RUNNING:
        if clock.monotonic() >= deadline_s:
            raise TareRefused(
                f"the unit did not finish its tare within {timeout_s:g} s: check that frames run"
            )
        pump()
    if result != eds.TareResult.DONE:
        largest = objects.read_unsigned(eds.TARE, eds.TARE_LARGEST)
        raise TareRefused(
            f"the unit refused its tare: {_REFUSALS.get(result, f'result {result}')}, largest "
            f"sample {largest} counts; clear the pads and try again"
        )


def read_last_frame(objects: ObjectAccess, layout: TaxelLayout) -> tuple[int, NDArray[np.uint16]]:
    """Return counter and counts of the unit's last complete frame; FrameError if of wrong size."""
    data = objects.read(eds.LAST_FRAME)
    counter = objects.read_unsigned(eds.LAST_FRAME_COUNTER)
    expected = layout.n_taxels * layout.sample_bytes
    if len(data) != expected:
        raise FrameError(f"the unit gave a last frame of {len(data)} bytes, expected {expected}")
    counts = np.frombuffer(data, dtype="<u1" if layout.sample_bytes == 1 else "<u2")
    return counter, counts.astype(np.uint16)
