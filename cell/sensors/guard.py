"""Guard of a frame source from another package, which may hang or raise any exception.

Its code runs in a thread of its own, so the force loop goes on. A hang, an exception or an
impossible frame is a fault of the link, which keeps the grip.
"""

import queue
import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from tactile.clock import Clock
from tactile.errors import LinkFault, LinkStateError, PluginFault, TactileError
from tactile.layout import TaxelLayout
from tactile.source import (
    Arrivals,
    FrameSource,
    FrameStatistics,
    PadZero,
    SourceIdentity,
    SourceStatistics,
)

_PROMPT_S = 5e-4
"""Longest wait of a poll in s for the answer: a tenth of a period of the force loop. The next poll
takes a later answer. [chosen]"""
_SWITCH_S = 5e-4
"""Time in s after which a busy thread yields to the force loop; Python's default is 5 ms.
[chosen]"""
_STOP_S = 1.0
"""Time in s for a source to stop; after it the thread is abandoned. [chosen]"""
_START_MARGIN_S = 1.0
"""Time in s beyond the time-out of the start, which the source itself must keep."""


class _Worker:
    """A thread that runs one call after another; daemonic, since a call may never return."""

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[Callable[[], Any] | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[tuple[Any, BaseException | None]] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="sensor plugin", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while (call := self._calls.get()) is not None:
            try:
                self._answers.put((call(), None))
            except BaseException as error:
                self._answers.put((None, error))

    def ask(self, call: Callable[[], Any]) -> None:
        """Start a call in the thread."""
        self._calls.put(call)

    def answer(self, timeout_s: float) -> Any:
        """Return its result or raise its exception; queue.Empty where none came in time."""
        value, error = self._answers.get(timeout=timeout_s)
        if error is not None:
            raise error
        return value

    def end(self, timeout_s: float) -> None:
        """End after the last call; a call that does not return in time is abandoned."""
        self._calls.put(None)
        self._thread.join(timeout_s)


class GuardedSource:
    """Implements `tactile.source.FrameSource` with a source whose code is not trusted.

    It is created anew at each start. In virtual time nothing runs beside the force loop, so a hang
    is not detected.

    Parameters
    ----------
    make
        Creates the source.
    name
        Kind and package of the source, for messages.
    threaded
        Whether it has a thread of its own: real time.
    silence_s, startup_timeout_s
        Longest time in s of a poll and of the start.
    """

    def __init__(
        self,
        make: Callable[[], FrameSource],
        *,
        name: str,
        layout: TaxelLayout,
        clock: Clock,
        threaded: bool,
        silence_s: float,
        startup_timeout_s: float,
    ) -> None:
        self.layout = layout
        self.sends_forces = False
        self.statistics = SourceStatistics(frames=FrameStatistics())
        self._make, self._name, self._clock, self._threaded = make, name, clock, threaded
        self._silence_s, self._startup_s = silence_s, startup_timeout_s + _START_MARGIN_S
        self._source: FrameSource | None = None
        self._worker: _Worker | None = None
        self._asked: Callable[[], Any] | None = None
        self._asked_s = 0.0
        self._fault: LinkFault | None = None

    def start(self) -> SourceIdentity:
        """Create the source and start it; raises its exceptions, or PluginFault."""
        self._fault = None
        if self._threaded:
            self._worker = _Worker()
            sys.setswitchinterval(min(_SWITCH_S, sys.getswitchinterval()))
        try:
            identity: SourceIdentity = self._call(self._begin, self._startup_s)
        except BaseException:
            self.stop()
            raise
        return identity

    def _begin(self) -> SourceIdentity:
        self._source = self._make()
        identity = self._source.start()
        self.sends_forces = self._source.sends_forces
        return identity

    def poll(self) -> Arrivals:
        """Return what arrived since the last call; raises its faults, or PluginFault."""
        if self._fault is not None:
            raise self._fault
        if self._source is None:
            raise LinkStateError("the sensor is not running: start it first")
        try:
            arrivals: Arrivals | None = self._call(self._look, _PROMPT_S, late_s=self._silence_s)
        except LinkFault as fault:
            self._fault = fault
            raise
        return arrivals or Arrivals()

    def _look(self) -> Arrivals:
        """Poll, and check the result."""
        source = self._source
        if source is None:
            return Arrivals()
        arrivals, n = source.poll(), self.layout.n_taxels
        for frame in arrivals.frames:
            counts = frame.counts
            if counts.shape != (n,) or counts.dtype != np.uint16:
                raise ValueError(f"a frame of {counts.shape} {counts.dtype}, not ({n},) uint16")
            if (extra := frame.extra) is not None and (
                extra.ndim != 2 or len(extra) != n or extra.dtype != np.uint16
            ):
                raise ValueError(f"extra of {extra.shape} {extra.dtype}, not ({n}, k) uint16")
            counts.setflags(write=False)
        self.statistics = source.statistics
        return arrivals

    def _call(self, call: Callable[[], Any], wait_s: float, *, late_s: float = 0.0) -> Any:
        """Call the source; return None while it takes longer, for up to ``late_s`` s."""
        if self._worker is None:
            return self._checked(call)
        now_s = self._clock.monotonic()
        try:
            if self._asked not in (call, None):
                self._checked(lambda: self._answer(self._silence_s))
            if self._asked is None:
                self._asked, self._asked_s = call, now_s
                self._worker.ask(call)
            return self._checked(lambda: self._answer(wait_s))
        except queue.Empty:
            if self._asked == call and now_s - self._asked_s < late_s:
                return None
        raise PluginFault(
            f"the code of {self._name} has not returned for {max(wait_s, late_s):.3g} s: restart "
            "the program, and report it to the authors of that package"
        )

    def _answer(self, wait_s: float) -> Any:
        try:
            value = self._worker.answer(wait_s) if self._worker is not None else None
        except queue.Empty:
            raise
        except BaseException:
            self._asked = None
            raise
        self._asked = None
        return value

    def _checked(self, call: Callable[[], Any]) -> Any:
        """Return the result of a call; raise faults as they are, and all others as PluginFault."""
        try:
            return call()
        except (queue.Empty, TactileError):
            raise
        except BaseException as error:
            raise PluginFault(
                f"the code of {self._name} failed: {type(error).__name__}: {error}. Report it to "
                "the authors of that package"
            ) from error

    def set_zero(self, zero: PadZero) -> None:
        """Set the zero of the force messages."""
        if (source := self._source) is not None:
            self._call(lambda: source.set_zero(zero), self._silence_s)

    def stop(self) -> None:
        """Stop the frames; a source that does not return is abandoned."""
        source, worker, hangs = self._source, self._worker, self._asked is not None
        self._source = self._worker = self._asked = None
        if worker is not None:
            if source is not None:
                worker.ask(source.stop)
            worker.end(0.0 if hangs else _STOP_S)
        elif source is not None:
            source.stop()
