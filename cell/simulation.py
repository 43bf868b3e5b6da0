"""The simulated cell of a config: the only place that connects the simulator."""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import asdict
from queue import SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.config.gripper import ParallelLinkageConfig
from cell.config.model import CellConfig
from cell.config.positioner import DriveAxisConfig, PositionerConfig, ServoAxisConfig
from cell.config.tactile import layout_from_config, make_calibration, pad_mounts
from cell.control.axes import si_per_unit
from cell.control.plan import Pose
from cell.errors import CellStateError, ConfigError, PositionerError, RequestRefused, raised_as
from cell.installation import extra
from gripper.dynamixel.models import MODELS
from gripper.dynamixel.serial_port import ByteStream
from gripper.errors import PortLost
from simulator.can.control_unit import ControlUnitSettings
from simulator.can.drive import DriveMount
from simulator.cell import SimulatedCell
from simulator.errors import PartGripped, SimulatorError
from simulator.faults.injector import check_fault
from simulator.realtime.process import CellRequests
from simulator.servo.mechanics import (
    LARGEST_LINK_ANGLE_RAD,
    FingerLinkage,
    ParallelogramLinkage,
    RackLinkage,
    ServoMount,
)
from simulator.servo.motor import OverloadRule
from simulator.servo.wrist import WristMount
from simulator.settings import SimulatedServoSettings, SimulatorSettings
from simulator.world.pads import EQUATION_11, PadPair, SensorLaw, noise_counts
from simulator.world.shapes import ObjectPose, Shape, parse_shape, thicknesses_m
from simulator.world.world import NOTHING
from tactile.can.bus import CanBus
from tactile.errors import BusNotOpened
from tactile.layout import TaxelLayout

_REPLY_S = 5.0
"""Longest wait in s for the reply to a request: a job may train a model meanwhile."""
_NOISE_DRAWS = 200
"""Number of forces of a pad at rest for an estimate of its noise."""
_NOISE_PER_CONTACT = 1.5
"""Largest noise of a pad's force, as a share of the contact force: at 2 the cell finds no part, at
1.2 it does (linear calibrations of 0.05 and 0.03 N a count)."""
_SWITCH_MARGIN = 5.0
"""Distance in mm or degrees from a limit of a simulated axis to a limit switch other than its home.
"""
_PINION_STOP_RAD = math.radians(250.0)
"""Angle of a simulated pinion with the fingers wide open."""
_LINKAGE_MARGIN_M = 1e-3
"""Opening in m that a simulated linkage keeps to its end stop."""


def simulator_settings(config: CellConfig) -> SimulatorSettings:
    """Return the settings of the simulated cell of a config.

    Raises ConfigError if a shape or a fault is unknown, or if the linkage cannot open as far as the
    gripper must.
    """
    settings = config.simulator
    with raised_as(ConfigError, SimulatorError, where="simulator"):
        linkage = _linkage(config)
        opening_m = config.gripper.aperture_open_mm * 1e-3
        reach_m = 2.0 * linkage.half_opening_max_m - _LINKAGE_MARGIN_M
        if opening_m > reach_m:
            raise ConfigError(
                f"gripper.aperture_open_mm is {opening_m * 1e3:g} mm, the linkage opens to "
                f"{reach_m * 1e3:.1f} mm at most: lower it"
            )
        for text in settings.faults:
            check_fault(text, len(config.gripper.servos), len(config.positioner.axes))
        layout = layout_from_config(config.tactile)
        if config.tactile.sensor.canopen:
            _check_noise(config, layout)
        return SimulatorSettings(
            layout=layout,
            servos=tuple(
                SimulatedServoSettings(
                    servo_id=servo.id,
                    model=MODELS[servo.model],
                    mount=ServoMount(direction=servo.direction, zero_raw=servo.zero_pulse),
                    gearing=settings.servos.gearing,
                    friction_factor=settings.servos.friction[finger],
                    kt_factor=settings.servos.kt[finger],
                    overload_rule=OverloadRule(settings.servos.overload),
                )
                for finger, servo in enumerate(config.gripper.servos)
            ),
            linkage=linkage,
            servo_baud_rate=config.gripper.baud_rate,
            unit=ControlUnitSettings(
                node_id=config.tactile.node_id,
                bitrate=config.tactile.bitrate,
                serial_number=1
                if config.tactile.serial_number is None
                else config.tactile.serial_number,
                boards=config.tactile.board_serial_numbers or (1, 2),
            ),
            mounts=pad_mounts(config.tactile),
            boards=config.tactile.sensor.simulated(),
            pads=PadPair(
                shift_m=(1e-3 * settings.pads.shift_mm[0], 1e-3 * settings.pads.shift_mm[1]),
                tilt_rad=(
                    math.radians(settings.pads.tilt_deg[0]),
                    math.radians(settings.pads.tilt_deg[1]),
                ),
                gains=(
                    settings.pads.gains[0] / config.tactile.pad_gains[0],
                    settings.pads.gains[1] / config.tactile.pad_gains[1],
                ),
                stiffness=settings.pads.stiffness,
            ),
            law=sensor_law(config),
            noise_level=settings.noise_level,
            seed=config.seed,
            objects=simulated_objects(config),
            aperture_m=opening_m,
            axes=_mounts(config.positioner),
            axes_can_bitrate=config.positioner.can.bitrate,
            faults=settings.faults,
        )


def _mounts(config: PositionerConfig) -> dict[str, DriveMount | WristMount]:
    """Return the simulated axes of a config with their mounting.

    Empty if a host program moves instead.
    """
    if config.kind != "axes":
        return {}
    return {
        axis.moves: _drive_mount(axis) if isinstance(axis, DriveAxisConfig) else _wrist_mount(axis)
        for axis in config.axes
    }


def _drive_mount(axis: DriveAxisConfig) -> DriveMount:
    """Return the mount of a drive that begins at its home, or away from it."""
    si = si_per_unit(axis.moves)
    low, high = axis.low - _SWITCH_MARGIN, axis.high + _SWITCH_MARGIN
    start = 0.5 * (axis.low + axis.high)
    if axis.homing == "negative_switch":
        low = axis.home
    elif axis.homing == "positive_switch":
        high = axis.home
    elif axis.homing == "here":
        start = axis.home
    return DriveMount(
        node_id=axis.node_id,
        increments=axis.increments / si,
        absolute=axis.homing == "none",
        start=start * si,
        low_switch=low * si,
        high_switch=high * si,
    )


def _wrist_mount(axis: ServoAxisConfig) -> WristMount:
    """Return the mount of a servo that begins in the middle of its limits."""
    si = si_per_unit(axis.moves)
    return WristMount(
        servo_id=axis.id,
        model=MODELS[axis.model],
        baud_rate=axis.baud_rate,
        increments=axis.increments / si,
        zero=axis.zero_pulse,
        start=0.5 * (axis.low + axis.high) * si,
    )


def _check_noise(config: CellConfig, layout: TaxelLayout) -> None:
    """Refuse noise with which a pad at rest looks touched."""
    n_taxels = layout.pads[layout.gripping_pads[0]].n_taxels
    level, n_drawn = config.simulator.noise_level, _NOISE_DRAWS * 3 * n_taxels
    drawn = noise_counts(np.random.default_rng(0), n_drawn, layout.adc_max, level)
    tared = np.rint(drawn.reshape(-1, n_taxels))
    tared -= tared.mean(axis=0)
    of_three_frames = tared.reshape(_NOISE_DRAWS, 3, n_taxels).mean(axis=1)
    law = make_calibration(config.tactile, layout, with_gains=False)
    force_n = max(config.tactile.pad_gains) * law.force_n(of_three_frames).sum(axis=1)
    noise_n, contact_n = float(force_n.std(ddof=1)), config.gripper.contact_force_n
    if noise_n > _NOISE_PER_CONTACT * contact_n:
        raise ConfigError(
            f"simulator.noise_level {level:g} is {noise_n:.2g} N on a pad at rest under "
            f"tactile.calibration, gripper.contact_force_n is {contact_n:g} N: no contact could be "
            "detected. Correct the calibration, lower the noise or raise the contact force"
        )


def simulation_of(config: CellConfig) -> SimulatedCell:
    """Return the simulated cell of a config, with its faults injected; in virtual time.

    Raises ConfigError if the config does not describe a cell, or one of its faults does not fit it.
    """
    settings = simulator_settings(config)
    with raised_as(ConfigError, SimulatorError, where="simulator"):
        return SimulatedCell(settings)


def open_servo_port(cell: SimulatedCell) -> ByteStream:
    """Reopen the servo line of a simulated cell. Raises PortLost while its adapter is unplugged."""
    with raised_as(PortLost, SimulatorError):
        return cell.open_servo_port()


def open_can_bus(cell: SimulatedCell, bitrate: int | None = None) -> CanBus:
    """Reopen the CAN bus of a simulated cell, with the adapter set to ``bitrate`` in bit/s.

    Raises BusNotOpened while its adapter is unplugged.
    """
    with raised_as(BusNotOpened, SimulatorError):
        return cell.open_can_bus(bitrate)


def simulated_objects(config: CellConfig) -> dict[str, Shape]:
    """Return the shapes of the configured objects by their labels. Raises ConfigError."""
    objects = {}
    for entry in config.simulator.objects:
        objects[entry.label] = _shape(entry.shape, f"simulator.objects: {entry.label}")
    return objects


def true_sizes(config: CellConfig) -> dict[str, str]:
    """Return the true thicknesses of the simulated objects as text by label; empty on real ports.

    A config of another machine may name a mesh file that is not here: then it is empty too.
    """
    with suppress(ConfigError):
        if config.simulated:
            return {
                label: f"true {' and '.join(f'{1e3 * m:.1f}' for m in thicknesses_m(shape))} mm"
                for label, shape in simulated_objects(config).items()
            }
    return {}


def drawn_shape(text: str) -> Shape:
    """Return the shape of a text such as ``cylinder:diameter=6mm,length=20mm``.

    Raises ConfigError if the text is not a shape, or a mesh file cannot be read.
    """
    return _shape(text, f"shape {text!r}")


def _shape(text: str, where: str) -> Shape:
    mesh = extra("mesh", needed_by=f"{where}: a mesh file")
    with raised_as(ConfigError, SimulatorError, where=where), mesh:
        return parse_shape(text)


def converter_noise(
    config: CellConfig,
) -> Callable[[np.random.Generator, int], NDArray[np.float64]]:
    """Return the noise of the simulated converter: (generator, number of samples) -> counts."""
    adc_max, level = layout_from_config(config.tactile).adc_max, config.simulator.noise_level
    return lambda rng, n: noise_counts(rng, n, adc_max, level)


def sensor_law(config: CellConfig) -> SensorLaw:
    """Return the law from force to counts of a sensor with the config's calibration."""
    law = config.tactile.calibration
    if not law.counts:
        return EQUATION_11
    # The last line continues to full scale.
    (before_n, last_n), (before, last) = ((0.0, *of)[-2:] for of in (law.force_n, law.counts))
    full = max(layout_from_config(config.tactile).adc_max, last + 1)
    full_n = last_n + (full - last) * (last_n - before_n) / (last - before)
    return SensorLaw(nodes=((0.0, *law.force_n, full_n), (0.0, *law.counts, full)))


class SimulationRequests:
    """Requests of any thread to a simulated cell of this process, executed in the cell's thread.

    Parameters
    ----------
    between_jobs
        Runs a function in the thread of the cell while no job runs; else it runs with the next step
        of virtual time.
    """

    def __init__(
        self, cell: SimulatedCell, between_jobs: Callable[[Callable[[], None]], None]
    ) -> None:
        self._cell = cell
        self._placer = InProcessPlacer(cell)
        self._requests = CellRequests(cell.devices, cell.injector)
        self._waiting: SimpleQueue[tuple[dict[str, Any], Future[dict[str, Any]]]] = SimpleQueue()
        self._between_jobs = between_jobs
        cell.clock.on_advance.append(lambda _now_s: self._answer())

    def __call__(self, request: dict[str, Any]) -> dict[str, Any]:
        """Carry out a request of `simulator.realtime.process` and return its reply.

        Raises RequestRefused if it cannot be carried out, CellStateError if a part is in the grip,
        or if the cell is busy.
        """
        reply: Future[dict[str, Any]] = Future()
        self._waiting.put((request, reply))
        self._between_jobs(self._answer)
        try:
            return reply.result(_REPLY_S)
        except PartGripped as error:
            raise CellStateError(f"simulation: {error}") from error
        except SimulatorError as error:
            raise RequestRefused(f"simulation: {error}") from error
        except TimeoutError as error:
            reply.cancel()
            raise CellStateError(f"the cell was busy for {_REPLY_S:g} s: try again") from error

    def part_for(self, label: str, present: str | None) -> str:
        """Return the object to place for a label; `named` makes the label a name of this object.

        It is ``present``, else the object of the label, else the part between the fingers. Raises
        CellStateError if there is no part, ConfigError if ``present`` is not an object.
        """
        world, placed = self._cell.devices.world, self._cell.devices.world.placed
        with suppress(SimulatorError):
            if present is None and world.shape(label):
                return label
        part = present or (NOTHING if placed is None else placed[0])
        if part == NOTHING:
            raise CellStateError(
                f"{label!r:.60} cannot be grasped: nothing is between the fingers of the "
                f"simulated cell; name a part as `present` (`--object`), one of "
                f"{', '.join(world.objects)}, or choose one on the page under Simulation"
            )
        if part not in world.objects:
            drawn_shape(part)
        return part

    def named(
        self, label: str, part: str | None, work: Callable[[Any], Any], report: object
    ) -> Any:
        """Make a label a name of an object, also of its shape as text, then do the work of a job.

        A job does so at its start: a refused request leaves each name as it is.
        """
        objects = self._cell.devices.world.objects
        if part is not None and label not in self._cell.settings.objects:
            objects[label] = objects.get(part) or drawn_shape(part)
        return work(report)

    def check_parts(self, labels: Sequence[str]) -> None:
        """Raise ConfigError, with the known objects, if one of the labels is not an object."""
        try:
            for label in labels:
                self._placer.check(label)
        except PositionerError as error:  # its cause would only make the host's traceback longer
            raise ConfigError(str(error)) from None

    def part_here(self) -> str:
        """Return the part between the fingers. Raises CellStateError if there is none."""
        world = self._cell.devices.world
        if world.placed is None:
            raise CellStateError(
                "nothing is between the fingers of the simulated cell: name a part as `present`, "
                f"one of {', '.join(world.objects)}"
            )
        return world.placed[0]

    def end_faults(self) -> None:
        """End all faults; on the thread of the cell."""
        self._cell.injector.clear_all()

    def empty(self) -> None:
        """Take the part away, and the offset of its pose; on the thread of the cell."""
        self._cell.devices.offset = ObjectPose()
        self._cell.remove()

    def _answer(self) -> None:
        while not self._waiting.empty():
            request, reply = self._waiting.get()
            if not reply.set_running_or_notify_cancel():
                continue
            try:
                reply.set_result(self._requests(request))
            except Exception as error:
                reply.set_exception(error)


class InProcessPlacer:
    """Places objects in a simulated cell of this process, as an `ObjectPlacer`."""

    def __init__(self, cell: SimulatedCell) -> None:
        self._cell = cell

    def check(self, label: str) -> None:
        """Raise PositionerError, with the known objects, if there is no such object."""
        with raised_as(PositionerError, SimulatorError):
            if label != NOTHING:
                self._cell.devices.world.shape(label)

    def place(self, label: str, pose: Pose) -> Pose:
        """Place an object and return where it came to rest. Raises PositionerError."""
        where = f"{label} cannot be placed at {pose}"
        with raised_as(PositionerError, SimulatorError, where=where):
            reached = self._cell.place(label, ObjectPose(**asdict(pose)))
        return Pose(**{name: getattr(reached, name) for name in asdict(pose)})


def _linkage(config: CellConfig) -> FingerLinkage:
    """Return the simulated linkage: open, a finger stops where its servo's turn ends."""
    drive = config.gripper.linkage
    stop_rad = min(
        (servo.zero_pulse if servo.direction < 0 else model.pulses_per_turn - 1 - servo.zero_pulse)
        * model.rad_per_pulse
        for servo in config.gripper.servos
        for model in (MODELS[servo.model],)
    )
    if isinstance(drive, ParallelLinkageConfig):
        return ParallelogramLinkage(
            link_m=drive.link_mm * 1e-3,
            offset_m=drive.offset_mm * 1e-3,
            open_stop_rad=min(stop_rad, LARGEST_LINK_ANGLE_RAD),
        )
    radius_m, offset_m = drive.pinion_radius_mm * 1e-3, drive.offset_mm * 1e-3
    # A rack that is to open farther than a turn does so.
    wanted_m = 0.5e-3 * config.gripper.aperture_open_mm + _LINKAGE_MARGIN_M
    return RackLinkage(
        pinion_radius_m=radius_m,
        offset_m=offset_m,
        travel_m=max(min(stop_rad, _PINION_STOP_RAD) * radius_m + offset_m, wanted_m),
    )
