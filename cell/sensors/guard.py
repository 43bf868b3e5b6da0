"""Guard of a frame source from another package: its errors and wrong values are link faults."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from math import inf, nextafter

import numpy as np

from tactile.clock import Clock
from tactile.errors import LinkFault, LinkStateError, PluginFault
from tactile.layout import TaxelLayout
from tactile.source import (
    COUNTER_MASK,
    Arrivals,
    FrameSource,
    PadZero,
    SourceIdentity,
    SourceStatistics,
)

_LONGEST_SCAN_S = 1.0
"""Longest time in s from the first to the last byte of a frame. [chosen]"""
_MOST = 1e6
"""Largest force in N, and largest place in pitches, of a force message. [chosen]"""


class GuardedSource:
    """Implements `tactile.source.FrameSource` with the source of another package.

    An exception of the source, or a value that no source may return, is a PluginFault. Each call
    raises it again until the next start. Code that does not return blocks the force loop; the
    program then finds that the process of the loop is silent.

    Parameters
    ----------
    make
        Creates the source. Raises its LinkFault, or PluginFault.
    name
        Kind and package of the source, for messages.
    """

    def __init__(
        self, make: Callable[[], FrameSource], *, name: str, layout: TaxelLayout, clock: Clock
    ) -> None:
        self.layout, self._name, self._clock = layout, name, clock
        self.statistics = SourceStatistics()
        self._least_s = self._least_force_s = 0.0
        self._fault: LinkFault | None = None
        with self._guarded():
            self._source = make()

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        if self._fault is not None:
            raise self._fault
        try:
            yield
        except LinkStateError:
            raise
        except LinkFault as fault:
            self._fault = fault
            raise
        except (Exception, SystemExit) as error:
            self._fault = PluginFault(
                f"the code of {self._name} failed: {type(error).__name__}: {error}. Update that "
                "package, or report it to its authors"
            )
            raise self._fault from error

    def start(self) -> SourceIdentity:
        """Start the source; if it runs, it is stopped before."""
        self.stop()
        self._least_s = self._least_force_s = self._clock.monotonic()
        with self._guarded():
            identity = self._source.start()
            if not isinstance(identity, SourceIdentity):
                raise TypeError(f"start returned {identity!r}, must be a SourceIdentity")
        return identity

    def poll(self) -> Arrivals:
        """Return what arrived since the last call."""
        with self._guarded():
            arrivals, statistics = self._source.poll(), self._source.statistics
            _within("recent_loss_rate", statistics.recent_loss_rate, 0.0, 1.0)
            self._check(arrivals, self._clock.monotonic())
            self.statistics = statistics
        return arrivals

    def _check(self, arrivals: Arrivals, now_s: float) -> None:
        """Raise ValueError for a wrong type, shape or number, and a time that does not advance."""
        n, least_s = self.layout.n_taxels, self._least_s
        for frame in arrivals.frames:
            _within("t_s of a frame", frame.t_s, least_s, now_s)
            _within("begun_s", frame.scanned_s, frame.t_s - _LONGEST_SCAN_S, frame.t_s)
            _within("counter of a frame", frame.counter, 0, COUNTER_MASK, int)
            _within("status of a frame", frame.status, 0, COUNTER_MASK, int)
            _uint16("counts", frame.counts, (n,))
            _within("the largest of counts", int(frame.counts.max()), 0, self.layout.adc_max)
            if frame.extra is not None:
                _uint16("extra", frame.extra, (n, *frame.extra.shape[1:2]))
            frame.counts.setflags(write=False)
            # Frames that are received at once may have one time.
            least_s, self._least_s = frame.t_s, nextafter(frame.t_s, inf)
        for message in arrivals.forces:
            _within("t_s of a force message", message.t_s, self._least_force_s, now_s)
            _within("counter of a force message", message.counter, 0, 15, int)
            _within("status of a force message", message.status, 0, 15, int)
            for first, second in (message.force_n, message.centre_taxels or (0.0, 0.0)):
                _within("a value of a force message", first, -_MOST, _MOST)
                _within("a value of a force message", second, -_MOST, _MOST)
            self._least_force_s = message.t_s

    def set_zero(self, zero: PadZero) -> None:
        """Set the zero of the force messages."""
        with self._guarded():
            self._source.set_zero(zero)

    def stop(self) -> None:
        """Stop the frames. An error of the source is dropped, as the clean-up has to go on."""
        self._fault = None
        with suppress(Exception, SystemExit):
            self._source.stop()


def _within(
    what: str, value: float, low: float, high: float, kind: type | tuple[type, ...] = (int, float)
) -> None:
    if not (isinstance(value, kind) and low <= value <= high):
        raise ValueError(f"{what} is {value!r:.50}, must be a number from {low} to {high}")


def _uint16(what: str, values: object, shape: tuple[int, ...]) -> None:
    if isinstance(values, np.ndarray):
        actual = f"{values.dtype} {values.shape}"
        if values.dtype == np.uint16 and values.shape == shape:
            return
    else:
        actual = f"of type {type(values).__name__}"
    raise ValueError(f"{what} is {actual}, must be uint16 {shape}")
