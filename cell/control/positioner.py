"""Positioners: they move the object, or the gripper around it, between two grasps."""

import json
import math
import socket
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol, TypeVar

from cell.control.plan import Pose
from cell.errors import PositionerError
from gripper.clock import Clock

_T = TypeVar("_T")

_LONGEST_REPLY = 65536
"""Longest accepted reply of the simulated cell in bytes; a pose takes 200."""


Supervise = Callable[[], None]
"""Supervises the cell during a motion; an error that it raises ends the motion."""


def unwatched() -> None:
    """Supervise nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Destination:
    """Place to which a named part is brought."""

    label: str
    """Name of the part, or ``UNKNOWN``."""
    place: str
    """Name of the place."""
    pose: Pose | None = None
    """Pose of the place for a positioner with its own axes; None if only the host has it."""


class Positioner(Protocol):
    """Moves the object, or the gripper around it, to the next pose of a sequence.

    A positioner whose calls block runs on its own thread, and the cell is supervised meanwhile. A
    positioner that takes time without blocking calls ``supervise`` once a period.
    """

    @property
    def blocks(self) -> bool:
        """Whether a call may take long; the cell must then be supervised meanwhile."""

    def present(self, label: str | None, supervise: Supervise = unwatched) -> None:
        """Bring the object with this label; None: the object to be identified.

        Raises PositionerError if there is no such object.
        """

    def move_to(self, pose: Pose, supervise: Supervise = unwatched) -> Pose:
        """Go to the pose and return the reached pose; the fingers are open meanwhile.

        Raises PositionerError if it cannot be reached.
        """

    def carry_to(self, destination: Destination, supervise: Supervise = unwatched) -> None:
        """Bring the part in the grip to a place; return at arrival.

        Raises PositionerError if it cannot be reached.
        """


def in_thread(call: Callable[[], _T], name: str) -> Future[_T]:
    """Start a call on a new thread with this name; return its future."""
    future: Future[_T] = Future()

    def run() -> None:
        try:
            future.set_result(call())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, name=name, daemon=True).start()
    return future


class PatientCaller:
    """Runs blocking calls on another thread, and supervises the cell every ``period_s`` s."""

    def __init__(self, clock: Clock, period_s: float) -> None:
        self._clock = clock
        self._period_s = period_s
        self._last: Future[Any] | None = None

    def call(self, call: Callable[[], _T], supervise: Callable[[], None]) -> _T:
        """Make a call and return what it returns; ``supervise`` is called meanwhile.

        An error of the supervision is raised at once, while the call continues by itself. Raises
        PositionerError if an earlier call still runs: two calls must never move at once.
        """
        if self._last is not None and not self._last.done():
            raise PositionerError(
                "the last move was abandoned and still runs; end it, then try again"
            )
        self._last = future = in_thread(call, "positioner")
        while not future.done():
            supervise()
            self._clock.sleep(self._period_s)
        return future.result()


class ObjectPlacer(Protocol):
    """Places objects in a simulated cell."""

    def check(self, label: str) -> None:
        """Raise PositionerError, with the known objects, if there is no such object."""

    def place(self, label: str, pose: Pose) -> Pose:
        """Place an object and return where it came to rest (a box settles on a face)."""


class SimulatedPositioner:
    """Places objects in the simulated cell, in this process or through a socket in another."""

    blocks = False

    def __init__(self, placer: ObjectPlacer) -> None:
        self.elsewhere = isinstance(placer, SocketPlacer)
        """Whether the simulated cell is in another process."""
        self._placer = placer
        self._label: str | None = None

    def present(self, label: str | None, supervise: Supervise = unwatched) -> None:
        """Choose the object of the following poses; None keeps the present one.

        Raises PositionerError if there is no such object.
        """
        if label is not None:
            self._placer.check(label)
            self._label = label

    def move_to(self, pose: Pose, supervise: Supervise = unwatched) -> Pose:
        """Place the chosen object at the pose; see `Positioner`."""
        if self._label is None:
            raise PositionerError(
                "no object was named for the simulated cell: name one before the grasp"
            )
        return self._placer.place(self._label, pose)

    def carry_to(self, destination: Destination, supervise: Supervise = unwatched) -> None:
        """Do nothing: the simulated gripper needs no motion to a place."""


class SocketPlacer:
    """Places objects in a simulated cell of another process.

    Speaks JSON lines over the Unix socket that ``tactile-cell simulate`` announces as
    ``positioner_socket``: one request, one reply.
    """

    def __init__(self, path: str, *, timeout_s: float = 5.0) -> None:
        self._path = path
        self._timeout_s = timeout_s

    def check(self, label: str) -> None:
        """Ask the other process for an object; see `ObjectPlacer`."""
        self.ask({"check": label})

    def place(self, label: str, pose: Pose) -> Pose:
        """Place an object in the other process; see `ObjectPlacer`."""
        reply = self.ask({"place": label, "pose": asdict(pose)})
        try:
            return Pose(**{name: float(reply["pose"][name]) for name in asdict(pose)})
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise PositionerError(
                f"the simulated cell at {self._path} answers without a pose: {error}"
            ) from error

    def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send one request of `simulator.realtime.process`, return its reply.

        Each request has its own connection: the process may start again between two of them.
        Raises PositionerError if it is refused, or nobody answers.
        """
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
                link.settimeout(self._timeout_s)
                link.connect(self._path)
                link.sendall(json.dumps(request).encode() + b"\n")
                with link.makefile("rb") as answer:
                    reply = json.loads(answer.readline(_LONGEST_REPLY))
        except (OSError, ValueError, RecursionError) as error:
            raise PositionerError(
                f"no simulated cell answers at {self._path} ({error}); is it running?"
            ) from error
        if not isinstance(reply, dict):
            raise PositionerError(f"the simulated cell at {self._path} answers {reply!r:.40}")
        if "error" in reply:
            raise PositionerError(f"the simulated cell refused: {reply['error']}")
        return reply


class OperatorPositioner:
    """Asks a person at the terminal to move the object, and waits for the confirmation."""

    blocks = True

    def __init__(self, ask: Callable[[str], str]) -> None:
        self._ask = ask

    def present(self, label: str | None, supervise: Supervise = unwatched) -> None:
        """Ask for an object; see `Positioner`."""
        what = "the object to identify" if label is None else f"the object {label!r}"
        self._confirm(f"Put {what} between the open fingers")

    def move_to(self, pose: Pose, supervise: Supervise = unwatched) -> Pose:
        """Ask for a pose; see `Positioner`."""
        self._confirm(
            f"Move the object to x {pose.x_m * 1e3:+.1f} mm, y {pose.y_m * 1e3:+.1f} mm, turned by "
            f"{math.degrees(pose.rotation_rad):.0f} deg about the approach axis and "
            f"{math.degrees(pose.roll_rad):.0f} deg about its own axis"
        )
        return pose

    def carry_to(self, destination: Destination, supervise: Supervise = unwatched) -> None:
        """Ask for the place of a part; see `Positioner`."""
        self._confirm(f"Bring the gripper with {destination.label} to {destination.place}")

    def _confirm(self, text: str) -> None:
        try:
            answer = self._ask(f"{text}. Enter when done, q to stop: ")
        except EOFError as error:
            raise PositionerError("no operator at the terminal (end of input)") from error
        if answer.strip().lower() in ("q", "quit"):
            raise PositionerError("the operator stopped the sequence")


@dataclass
class CallbackPositioner:
    """Asks the host program to move: a callback gets the pose and returns the reached one."""

    move: Callable[[Pose], Pose | bool | None]
    """Returns None or True when the pose is reached, False to refuse it, or the `Pose` reached
    instead."""
    simulated: SimulatedPositioner | None = None
    """Places the object after the callback: for a host without a robot."""

    @property
    def blocks(self) -> bool:
        """False for a simulated cell of this process: its time passes only in its own thread."""
        return self.simulated is None or self.simulated.elsewhere

    def present(self, label: str | None, supervise: Supervise = unwatched) -> None:
        """Choose the object of the simulated cell; in a real cell the host brings it."""
        if self.simulated is not None:
            self.simulated.present(label)

    def move_to(self, pose: Pose, supervise: Supervise = unwatched) -> Pose:
        """Call the host; see `Positioner`."""
        reached = self.move(pose)
        if reached is False:
            raise PositionerError(f"the host refused to move to {pose}")
        if reached is None or reached is True:
            reached = replace(pose)
        elif not isinstance(reached, Pose):
            # An error code, for example: the object may be anywhere.
            raise PositionerError(
                f"the host answered {reached!r} to a pose: return None or True when it is "
                "reached, False to refuse, or the Pose reached instead"
            )
        return reached if self.simulated is None else self.simulated.move_to(reached)

    def carry_to(self, destination: Destination, supervise: Supervise = unwatched) -> None:
        """Refuse, as the host gave no callback for places; the simulated cell needs none."""
        if self.simulated is None:
            raise PositionerError(
                f"the host gave no callback `places`, which brings {destination.label} to "
                f"{destination.place}: load the plugin with places=...; the part is kept"
            )


CarryCallback = Callable[[Destination], bool | None]
"""Brings the part in the grip to a place. Returns None or True at arrival, False to refuse."""


class HostPlaces:
    """Positioner whose host brings parts to their places; another positioner does the rest."""

    def __init__(self, positioner: Positioner, places: CarryCallback) -> None:
        self.blocks = positioner.blocks
        self.present, self.move_to = positioner.present, positioner.move_to
        self._places = places

    def carry_to(self, destination: Destination, supervise: Supervise = unwatched) -> None:
        """Call the host; see `Positioner`."""
        there = self._places(destination)
        if there is not None and there is not True:
            raise PositionerError(
                f"the host answered {there!r} to the place {destination.place} of "
                f"{destination.label}: return None or True at arrival, False to refuse; the part "
                "is kept"
            )
