"""A person's hands at a simulated cell, as commands: `open finger 0`, `press finger0.inner tip`."""

from collections.abc import Callable
from inspect import signature
from typing import Any

from simulator.errors import SimulatorSettingsError

HELP = """\
look                    show the fingers and the part between them
close                   close both fingers by hand until they touch something
open [finger N]         open both fingers, or finger 0 or 1, as far as they go
half                    open both fingers half way
block MM                hold a block of MM mm between the pads, close the fingers on it
part [NAME]             hold an object of the cell between the open pads: ball without a name
press PAD [PLACE ...]   press a pad with a fingertip: in the middle, or at tip, base, left, right,
                        as you look at the pad with the tip upwards; on a tip pad: left, right,
                        inside (towards the other finger), outside
load PAD GRAMS          lay a weight on the middle of a pad
lift                    remove the fingertip or weight
empty                   remove everything from the fingers and pads
disconnect servo N      pull the plug of a servo; servo 1 drives finger 0, servo 2 finger 1
connect servo N         plug it in again
help                    this list
A hand moves only fingers whose motor has no torque."""
"""Help text: one command on each line."""

_FILLERS = frozenset({"and", "at", "edge", "finger", "g", "mm", "near", "of", "on", "servo", "the"})
"""Optional words."""
_WIDE_M = 1.0
"""Half opening in m beyond every end stop."""
_LOOK_S = 0.02
"""Time in s between two checks whether a finger still moves."""
_REACTION_S = 0.3
"""Time in s until the frames of the control unit show only the new weight or fingertip."""
_GRAVITY_N_G = 9.80665e-3
"""Weight of a gram in N."""


class Hands:
    """Carries out commands of a person at the cell, and returns at their end.

    Parameters
    ----------
    ask
        Sends a request of `simulator.realtime.process` and returns the reply.
    sleep
        Waits for a time in s.
    """

    def __init__(
        self, ask: Callable[[dict[str, Any]], dict[str, Any]], sleep: Callable[[float], None]
    ) -> None:
        self._ask, self._sleep = ask, sleep
        self._acts: dict[str, Callable[..., object]] = {
            "look": lambda: None,
            "close": lambda: self._move(0.0),
            "open": lambda *fingers: self._move(_WIDE_M, *map("01".index, fingers)),
            "half": self._half,
            "block": self._block,
            "part": lambda *name: ask({"place": " ".join(name) or "ball"}),
            "press": lambda pad, *places: self._press(pad, at=list(places)),
            "load": lambda pad, grams: self._press(pad, force_n=float(grams) * _GRAVITY_N_G),
            "lift": lambda: ask({"lift": True}),
            "empty": self._empty,
            "disconnect": lambda number: ask({"inject": f"servo{int(number)}.off"}),
            "connect": lambda number: ask({"clear": f"servo{int(number)}.off"}),
        }

    def do(self, text: str) -> str:
        """Carry out a command; return the new state as text.

        Raises SimulatorSettingsError for an unknown command, and errors of the requests.
        """
        word, *values = [part for part in text.split() if part not in _FILLERS] or ["help"]
        if word == "help":
            state = self._state
            pads, objects = (", ".join(state[key]) for key in ("pads", "objects"))
            return f"{HELP}\nHere: fingers on {state['linkage']}; pads {pads}; objects {objects}"
        none_such = SimulatorSettingsError(
            f"{text!r:.60} is not a command: `help` lists all commands"
        )
        try:
            act = self._acts[word]
            signature(act).bind(*values)
        except (KeyError, TypeError):
            raise none_such from None
        try:
            act(*values)
        except ValueError:
            raise none_such from None
        return self._look()

    def _half(self) -> None:
        self._move(_WIDE_M)
        self._move(0.25 * self._state["aperture_m"])

    def _block(self, mm: str) -> None:
        shape = f"box:length=20mm,width=12mm,height={float(mm):g}mm"
        self._ask({"remove": True})
        self._move(_WIDE_M)
        self._ask({"place": shape})
        self._move(0.0)

    def _empty(self) -> None:
        self._ask({"remove": True})
        self._ask({"lift": True})

    @property
    def _state(self) -> dict[str, Any]:
        return self._ask({"state": True})

    def _move(self, half_opening_m: float, *fingers: int) -> None:
        """Move fingers, by default all, and wait for the end of the motion."""
        servos = [finger + 1 for finger in fingers] or range(1, 1 + self._state["servos"])
        self._ask({"hand": {str(servo): half_opening_m for servo in servos}})
        while self._state["moved_by_hand"]:
            self._sleep(_LOOK_S)

    def _press(self, pad: str, **how: Any) -> None:
        self._ask({"press": pad, **how})
        self._sleep(_REACTION_S)

    def _look(self) -> str:
        state = self._state
        first_mm, second_mm = (1e3 * half_m for half_m in state["fingers_m"])
        off = [text.removesuffix(".off") for text in state["faults"] if text.endswith(".off")]
        return (
            f"finger 0 {first_mm:.1f} mm from the middle, finger 1 {second_mm:.1f} mm; between "
            f"them: {state['placed'] or 'nothing'}; pressed: {state['pressed'] or 'no pad'}"
            + (f"; disconnected: {', '.join(off)}" if off else "")
        )
