"""Object dictionary access to the control unit: reads and writes by index, its own tare."""

from collections.abc import Callable
from typing import Any

import can
import numpy as np
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError
from numpy.typing import NDArray

from tactile.can.receiver import interface_failed
from tactile.can.sdo_client import PolledSdoClient
from tactile.clock import Clock
from tactile.errors import FrameError, NodeMissing, TareRefused
from tactile.layout import TaxelLayout
from tactile.unit import object_dictionary as od

_NO_OBJECT = 0x0602_0000
"""SDO abort code: the object does not exist (CiA 301, 7.2.4.3.17)."""


class ObjectAccess:
    """Reads and writes objects by index; repeats what got lost; errors name object and unit.

    Parameters
    ----------
    attempts
        How often a transfer is tried when no response comes.
    """

    def __init__(self, client: PolledSdoClient, *, name: str, attempts: int = 3) -> None:
        self._client = client
        self._name = name
        self._attempts = attempts

    def read(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an object."""
        data: bytes = self._transfer("read", index, subindex, self._client.upload, ())
        return data

    def read_unsigned(self, index: int, subindex: int = 0) -> int:
        """Return an unsigned integer."""
        return int.from_bytes(self.read(index, subindex), "little")

    def read_text(self, index: int, subindex: int = 0) -> str:
        """Return a visible string."""
        return self.read(index, subindex).rstrip(b"\0").decode("ascii", errors="replace")

    def has(self, index: int) -> bool:
        """Return whether the unit has an object at all."""
        try:
            self.read(index)
        except NodeMissing as error:
            if getattr(error.__cause__, "code", None) == _NO_OBJECT:
                return False
            raise
        return True

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write the bytes of an object."""
        self._transfer("write", index, subindex, self._client.download, (data,))

    def write_unsigned(self, index: int, subindex: int, value: int, n_bytes: int) -> None:
        """Write an unsigned integer of ``n_bytes`` bytes."""
        self.write(index, subindex, value.to_bytes(n_bytes, "little"))

    def _transfer(
        self,
        verb: str,
        index: int,
        subindex: int,
        transfer: Callable[..., Any],
        arguments: tuple[bytes, ...],
    ) -> Any:
        what = f"{verb} of object 0x{index:04X}:{subindex:02X} of {self._name}"
        failure: Exception | None = None
        for _ in range(self._attempts):
            try:
                return transfer(index, subindex, *arguments)
            except SdoCommunicationError as error:
                failure = error
            except SdoAbortedError as error:
                raise NodeMissing(
                    f"{what} was refused ({error}): the unit's firmware does not fit this "
                    "software's EDS"
                ) from error
            except (can.CanError, OSError) as error:
                raise interface_failed(error) from error
        raise NodeMissing(
            f"{what} failed {self._attempts} times: {failure}; check supply, CAN cable and node-ID"
        ) from failure


_REFUSALS = {
    int(od.TareResult.REFUSED_TOUCHED): "a taxel was touched",
    int(od.TareResult.REFUSED_SPREAD): "the counts moved while the zero was taken",
}
"""Results of the unit's own tare in words."""


def take_unit_tare(
    objects: ObjectAccess, *, clock: Clock, pump: Callable[[], None], timeout_s: float
) -> None:
    """Let the unit take its own zero and wait for the result.

    Parameters
    ----------
    pump
        Called between two looks at the result; lets time pass and frames run.

    Raises
    ------
    TareRefused
        When the unit refuses, or does not come to an end.
    """
    deadline_s = clock.monotonic() + timeout_s
    objects.write_unsigned(od.TARE, od.TARE_COMMAND, od.TARE_SIGNATURE, 4)
    while (result := objects.read_unsigned(od.TARE, od.TARE_RESULT)) == od.TareResult.RUNNING:
        if clock.monotonic() >= deadline_s:
            raise TareRefused(
                f"the unit did not finish its tare within {timeout_s:g} s: check that frames run"
            )
        pump()
    if result != od.TareResult.DONE:
        largest = objects.read_unsigned(od.TARE, od.TARE_LARGEST)
        raise TareRefused(
            f"the unit refused its tare: {_REFUSALS.get(result, f'result {result}')}, largest "
            f"sample {largest} counts; clear the pads and try again"
        )


def read_last_frame(objects: ObjectAccess, layout: TaxelLayout) -> tuple[int, NDArray[np.uint16]]:
    """Return counter and counts of the unit's last complete frame; FrameError if of wrong size."""
    data = objects.read(od.LAST_FRAME)
    counter = objects.read_unsigned(od.LAST_FRAME_COUNTER)
    expected = layout.n_taxels * layout.sample_bytes
    if len(data) != expected:
        raise FrameError(f"the unit gave a last frame of {len(data)} bytes, expected {expected}")
    counts = np.frombuffer(data, dtype="<u1" if layout.sample_bytes == 1 else "<u2")
    return counter, counts.astype(np.uint16)
