"""The simulated cells of a test, and the injected faults."""

import warnings
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Protocol

import pytest


class FaultHandle(Protocol):
    """An injected fault."""

    @property
    def began_s(self) -> float | None:
        """Time of the cell in s at which the fault began; None before."""

    def clear(self) -> None:
        """End the fault; a second call has no effect."""


class FaultTarget(Protocol):
    """A simulated cell that takes faults as text, for example ``can.loss=0.05@2s``."""

    def inject(self, text: str) -> FaultHandle:
        """Inject a fault; an unknown fault is refused with a list of all faults."""


class FaultRegistry(ExitStack):
    """Keeps the simulated cells of a test, and finds the cell for a fault.

    Its end clears the faults and ends the cells, the last one first. A fault that never began is a
    warning: the test has shown nothing about it.
    """

    def __init__(self) -> None:
        super().__init__()
        self._targets: list[FaultTarget] = []
        self._hardware: list[str] = []

    def add(self, target: FaultTarget, end: Callable[[], Any]) -> None:
        """Add a simulated cell of this test; ``end`` ends it."""
        self._targets.append(target)
        self.callback(end)

    def add_hardware(self, name: str) -> None:
        """Register real hardware: from now on every fault is refused."""
        self._hardware.append(name)

    def inject(self, text: str, *, into: FaultTarget | None = None) -> FaultHandle:
        """Inject a fault into the simulated cell of this test.

        Parameters
        ----------
        text
            The fault, for example ``servo1.off@contact+0.5s``.
        into
            The cell, if the test has several.

        Raises
        ------
        pytest.fail.Exception
            If the test uses hardware, has no simulated cell, or has several without ``into``.
        """
        if self._hardware:
            pytest.fail(
                f"fault {text!r} refused: this test runs on hardware ({', '.join(self._hardware)}) "
                "and faults are for simulated cells only; skip the test, or leave out the options "
                "that name the hardware",
                pytrace=False,
            )
        if into is None:
            if len(self._targets) != 1:
                pytest.fail(
                    f"fault {text!r}: this test has {len(self._targets)} simulated cells"
                    + (
                        "; name one with inject_fault(text, into=cell)"
                        if self._targets
                        else " so far; make one first: cell = simulated_cell()"
                    ),
                    pytrace=False,
                )
            into = self._targets[0]
        elif into not in self._targets:
            pytest.fail(f"fault {text!r}: {into!r} is not a simulated cell of this test")
        fault = into.inject(text)
        self.callback(fault.clear)
        # The last callback is called first.
        self.callback(_judge, fault, text)
        return fault


def _judge(fault: FaultHandle, text: str) -> None:
    if fault.began_s is None:
        warnings.warn(pytest.PytestWarning(f"fault {text!r} never began"), stacklevel=2)
