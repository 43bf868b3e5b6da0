"""The pose handshake: the mover of a cell whose host moves the object or the gripper."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from cell.control.plan import Pose
from cell.errors import RequestRefused
from gripper.errors import GraspStopped

_POSE_GONE_S = 0.05
"""Longest wait in s for the end of an abandoned pose before the next job."""


class PoseHandshake:
    """Shows one pose at a time with its number, until the host answers it or the job stops.

    `move` belongs to the thread of the cell; everything else may be called from any thread.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._seq = 0
        self._pose: Pose | None = None
        self._reached: Pose | bool | None = None
        self._moving = False
        self._stopped = False

    @property
    def awaited(self) -> tuple[int, Pose | None]:
        """Number and pose that the host shall reach; 0 and None without a pending pose."""
        with self._changed:
            return (0, None) if self._pose is None else (self._seq, self._pose)

    def move(self, pose: Pose) -> Pose | bool:
        """Show a pose and wait for the host: the mover of the cell.

        Raises gripper.errors.GraspStopped if the job is stopped meanwhile.
        """
        with self._changed:
            self._seq = self._seq % 0xFFFF + 1
            self._pose, self._reached, self._moving = pose, None, True
            try:
                self._changed.wait_for(lambda: self._reached is not None or self._stopped)
                reached: Pose | bool | None = self._reached
                if reached is None:
                    raise GraspStopped("stopped on request while waiting for a pose")
                return reached
            finally:
                self._pose, self._moving = None, False
                self._changed.notify_all()

    def answer(self, seq: int, reached: Pose | bool) -> None:
        """Answer the pose with that number: reached, refused, or another one reached instead.

        Raises RequestRefused if another pose or no pose is pending.
        """
        with self._changed:
            if self._pose is None or seq != self._seq:
                expected = self._seq if self._pose is not None else "none"
                raise RequestRefused(f"pose {seq} is not pending; the pending pose is {expected}")
            self._reached = reached
            self._pose = None
            self._changed.notify_all()

    def stop(self) -> None:
        """Abandon the pending pose, and each further one until a job begins."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def settle(self) -> None:
        """Wait for the end of an abandoned pose, so that the next job can start."""
        with self._changed:
            self._changed.wait_for(lambda: not self._moving or not self._stopped, _POSE_GONE_S)

    @contextmanager
    def beginning(self) -> Iterator[None]:
        """Begin a job: drop earlier stops, unless an error refuses the job."""
        with self._changed:
            yield
            self._stopped = False
