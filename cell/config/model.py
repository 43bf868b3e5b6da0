"""The configuration of a cell: one frozen, checked value.

Lengths are in mm and angles in degrees here, because operators write this file; all other code
uses SI. The description of each field states unit, range and meaning; the JSON schema shows it.
An invalid `CellConfig` cannot exist.
"""

from math import ceil
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from cell.config.gripper import GripperConfig, gripper_settings, linkage_of
from cell.config.positioner import AxesCanConfig, PositionerConfig, ServoAxisConfig, SortConfig
from cell.config.section import SIMULATED, Installed, Section, setting_of
from cell.config.sequence import SequenceConfig
from cell.config.serve import ServeConfig
from cell.config.simulator import SimulatorConfig
from cell.config.tactile import TactileConfig, layout_from_config, make_calibration
from cell.errors import ConfigError, raised_as
from cell.plugins import RECOGNIZERS
from gripper.dynamixel.latency import largest_rate_hz
from gripper.errors import LimitExceeded
from gripper.force.ramp import check_ramp, heat_note, largest_ramp_n
from gripper.mechanics.impact import check_approach
from gripper.mechanics.kinematics import Linkage
from gripper.mechanics.transmission import OPENING_N, Mechanics
from gripper.settings import GripperSettings
from recognition.recognizers import DEFAULT_TRAINER
from tactile.errors import LayoutError
from tactile.layout import TaxelLayout

TAXELS_OF_SMALL_PART = 8
"""Taxels of a pad under a small part: a cylinder of 6 x 20 mm on taxels of 3.4 x 5 mm."""


_SLOWEST_FRAMES_MS = 40.0
"""Longest period in ms of frames without force messages. With 45 and 50 ms the force swings, and
the fingers run as if the part were gone (simulated cell)."""
_STARTING_S = 0.3
"""Time in s for the fingers to reach their approach speed, and to slow down at the end."""

_MUCH_FRICTION_N = 10.0
"""Friction of a servo at the pads in N above which one hold in five ends at least 0.3 N too high
(51 grasps of simulated hands)."""


class RecognitionConfig(Section):
    """Recognition of objects from grasps."""

    recognizer: Annotated[str, Installed(RECOGNIZERS)] = DEFAULT_TRAINER
    """Recognizer to teach."""
    use_aperture: bool = True
    """Whether to use the opening between the fingers in addition to the taxels."""
    shape: bool = True
    """Whether to fit shape and size for each grasp of an identification."""
    caution: float = Field(default=1.0, ge=0.01, le=100.0)
    """Factor on the likelihood of an object that was never taught, 0.01 to 100. A larger value
    gives fewer wrong names, but more taught objects become UNKNOWN; only for force_ramp."""
    follow_drift: bool = True
    """Whether to follow the drift of the sensors from one identification to the next; only for
    force_ramp."""


def _without_tilde(folder: str) -> str:
    """Return a folder; no shell expands `~` here, and a folder of this name would be made."""
    if folder.startswith("~"):
        raise ValueError("~ is not your home folder here: write the path in full")
    return folder


class RecordingConfig(Section):
    """Storage of recordings, data sets and reports."""

    directory: Annotated[str, AfterValidator(_without_tilde)] = Field(
        default="out", min_length=1, max_length=500
    )
    """Folder of recordings, data sets and reports; created if missing."""
    when_lost: Literal["finish", "hold"] = "finish"
    """If the recording cannot be written: finish the grasps without it, or hold (a fault)."""
    keep_gb: float | None = Field(default=100.0, ge=0.1, le=1e6)
    """Size of all recordings in GB above which the oldest are deleted, 0.1 to 1000000; null: no
    limit. Marked recordings (`tactile-cell recording mark`) stay."""


class LoopConfig(Section):
    """Process of the force loop on real ports; a setting that the system refuses gives a note."""

    own_process: bool = True
    """Whether the loop has its own process, so that recognition and files cannot delay it."""
    priority: int = Field(default=50, ge=0, le=99)
    """Real-time priority (SCHED_FIFO) of that process, 1 to 99; 0: normal scheduling. The
    simulated cell of `simulate` uses one less."""
    lock_memory: bool = True
    """Whether to lock the memory of that process, so that paging cannot delay it."""
    cpu: int | None = Field(default=None, ge=0, le=1023)
    """Processor for the process, 0 to 1023; none: any."""
    overruns_max: int = setting_of(GripperSettings, "overruns_max")
    """Number of consecutive overlong periods after which the grip is frozen, 1 to 1000."""


class CellConfig(Section):
    """All settings of a cell. Without a file: the simulated cell."""

    format: Literal["tactile-cell-config/1"] = "tactile-cell-config/1"
    """Format of this file, and its version. Without this key it counts as the present one."""
    name: str = Field(default="simulated cell", min_length=1, max_length=80)
    """Name of the cell, for reports and its files: cells that share a folder of recordings need
    different ones. `unnamed cell` with real ports."""
    seed: int = Field(default=2008, ge=0, le=2**32 - 1)
    """Seed of all random values: poses, noise of the simulated cell."""
    host_timeout_s: float | None = Field(default=None, ge=0.05, le=3600.0)
    """Longest silence of the host program during a job in s, 0.05 to 3600; none: no limit."""
    self_zero: Literal["always", "daily", "on_demand", "never"] = "daily"
    """When the empty fingers close on each other to measure zero, gains and foam: at each start, at
    the first start of a day, on request (`tactile-cell hand zero`), or never. A part between them
    is a fault with `always` and a note with `daily`. The default is `never` if gripper.pads_meet is
    false."""
    gripper: GripperConfig = GripperConfig()
    """Servos, linkage and limits."""
    tactile: TactileConfig = TactileConfig()
    """Control unit and CAN bus."""
    sequence: SequenceConfig = SequenceConfig()
    """Poses, forces and stop rule."""
    sort: SortConfig = SortConfig()
    """Places of named parts."""
    positioner: PositionerConfig = PositionerConfig()
    """Positioner that moves the object or the gripper."""
    recognition: RecognitionConfig = RecognitionConfig()
    """Recognizer and its inputs."""
    recording: RecordingConfig = RecordingConfig()
    """Storage of results."""
    loop: LoopConfig = LoopConfig()
    """Process of the force loop."""
    serve: ServeConfig = ServeConfig()
    """Interfaces for hosts."""
    simulator: SimulatorConfig = SimulatorConfig()
    """The simulated cell."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        least_n, most_n = self.sequence.forces_n
        contact_n, carry_n = self.gripper.contact_force_n, self.sequence.carry_force_n
        ramps, why = (1.0, "to hold a part")
        if self.sequence.regrasp == "none":
            ramps, why = (3.0, "times 3 for a further ramp: sequence.regrasp is none")
        if least_n < ramps * contact_n:
            raise ValueError(
                f"sequence asks for {least_n:g} N; it needs at least gripper.contact_force_n = "
                f"{contact_n:g} N {why}"
            )
        if carry_n < contact_n:
            raise ValueError(
                f"sequence.carry_force_n is {carry_n:g} N; it must be at least "
                f"gripper.contact_force_n = {contact_n:g} N"
            )
        if not self.simulated and "name" not in self.model_fields_set:
            object.__setattr__(self, "name", "unnamed cell")
        with raised_as(ValueError, ConfigError):
            layout = layout_from_config(self.tactile)
        with raised_as(ValueError, LayoutError, where="tactile"):
            self.tactile.sensor.check(self.tactile, layout)
        self._check_full_scale(layout, most_n)
        axes = [port == SIMULATED for port in self.positioner.ports]
        if {*axes, self.tactile.simulated} != {self.simulated}:
            pads = "simulated" if self.tactile.simulated else "real"
            moves = f", {sum(axes)} of {len(axes)} ports of axes are simulated" if axes else ""
            raise ValueError(
                f"gripper.port is {self.gripper.port}, the pads (tactile.interface or "
                f"tactile.sensor.ports) are {pads}{moves}: they must all be `simulated` or all be "
                "real, because a real gripper cannot touch a simulated object"
            )
        keys: dict[str, list[str]] = {}
        for _, key, port in self.serial_ports:
            keys.setdefault(port, []).append(key)
            if len(keys[port]) > 1:
                raise ValueError(f"{' and '.join(keys[port])} are {port}: write another port")
        if self.simulator.faults and not self.simulated:
            raise ValueError("simulator.faults are not for a cell with real ports: remove them")
        on_can = self.tactile.sensor.on_can
        if not self.simulated and on_can and self.tactile.channel == "":
            raise ValueError("tactile.channel is empty; name the channel of the CAN interface")
        elsewhere = not self.simulated and not self.positioner.socket
        if elsewhere and self.positioner.kind == "simulated":
            raise ValueError(
                "positioner.kind is simulated but the cell is not: choose operator, callback or "
                "axes, or name the socket of a simulated cell in another process"
            )
        if not self.gripper.pads_meet and self.self_zero in ("always", "daily"):
            if "self_zero" in self.model_fields_set:
                raise ValueError(
                    f"self_zero is {self.self_zero}, but gripper.pads_meet is false: write "
                    "self_zero: never, and gauge with a taught object in a holder (`tactile-cell "
                    "model calibrate --gauge`)"
                )
            object.__setattr__(self, "self_zero", "never")
        self._check_axes()
        self._check_motion(max(most_n, carry_n))
        return self

    def _check_motion(self, most_n: float) -> None:
        """Refuse a gripper that cannot move, stop below its cap or reach the requested forces."""
        ends = list[tuple[float, ...]]()
        for name in ("aperture_open_mm", "aperture_min_mm"):
            where = f"gripper.{name} is beyond gripper.linkage, its lengths and offset_mm"
            with raised_as(ValueError, LimitExceeded, where=where):
                ends.append(self.linkage.angles_rad(1e-3 * getattr(self.gripper, name)))
        with raised_as(ValueError, LimitExceeded, where="gripper"):
            speed_m_s = check_approach(self.mechanics)
        key = "force_n" if most_n in self.sequence.forces_n else "carry_force_n"
        with raised_as(ValueError, LimitExceeded, where=f"gripper and sequence.{key}"):
            check_ramp(self.sequence.ramp.to(most_n), self.mechanics)
        with raised_as(ValueError, LimitExceeded, where="gripper"):
            for angles_rad in ends:
                paths = self.mechanics.transmissions(angles_rad)
                self.mechanics.motion_currents_a(paths, OPENING_N)
        gripper, tactile = self.gripper, self.tactile
        most_hz = largest_rate_hz(gripper.baud_rate, len(gripper.servos))
        if gripper.loop_rate_hz > most_hz:
            raise ValueError(
                f"gripper.loop_rate_hz is {gripper.loop_rate_hz:g}, but gripper.baud_rate = "
                f"{gripper.baud_rate} allows at most {most_hz:.0f} Hz: raise the baud rate, also "
                f"in the servos, or lower the loop rate, which is at least 100 Hz"
            )
        self._check_closing(speed_m_s)
        period_ms = 1e3 * tactile.frame_period_s
        if not tactile.sends_forces and period_ms > _SLOWEST_FRAMES_MS:
            raise ValueError(
                f"tactile.sync_period_ms is {period_ms:g}; without force messages the force loop "
                f"needs a frame every {_SLOWEST_FRAMES_MS:g} ms: lower it, or set "
                "tactile.force_period_ms"
            )
        if not tactile.sends_forces and gripper.force_stale_ms < 2.5 * period_ms:
            raise ValueError(
                f"gripper.force_stale_ms is {gripper.force_stale_ms:g}; without force messages the "
                f"least is {2.5 * period_ms:g}, 2.5 periods of the frames: raise it, or lower "
                "tactile.sync_period_ms"
            )

    def _check_closing(self, speed_m_s: float) -> None:
        """Refuse a contact time-out that is too short for fingers that close at a speed in m/s."""
        gripper, settings = self.gripper, self.gripper_settings
        way_m = settings.aperture_open_m - settings.aperture_min_m
        closing_s = way_m / speed_m_s + _STARTING_S
        if closing_s <= gripper.contact_timeout_s:
            return
        speed = f"approach_speed_mm_s = {gripper.approach_speed_mm_s:g}"
        if speed_m_s < settings.approach_speed_m_s:
            speed = (
                f"{1e3 * speed_m_s:.1f} mm/s, the limit by force_max_n, contact.approach_force_n "
                f"and contact.pad_stiffness_n_mm"
            )
        raise ValueError(
            f"gripper.contact_timeout_s is {gripper.contact_timeout_s:g}, but from "
            f"aperture_open_mm = {gripper.aperture_open_mm:g} the fingers close in "
            f"{closing_s:.1f} s, with {speed}. Write contact_timeout_s {ceil(closing_s)} or more "
            f"(60 at most), or a smaller aperture_open_mm"
        )

    def _check_axes(self) -> None:
        """Refuse axes that do not fit the sequence or the sensor."""
        positioner, can, tactile = self.positioner, self.positioner.can, self.tactile
        positioner.check_poses(self.sequence, self.sort)
        shared = (can.interface, can.channel) == (tactile.interface, tactile.channel)
        if not (shared and positioner.drives and tactile.sensor.on_can) or self.simulated:
            return
        if lone := tactile.sensor.lone_on_can:
            raise ValueError(
                f"positioner.can is the bus of tactile: {lone}; give them a bus without "
                "CANopen nodes"
            )
        if can.interface not in ("socketcan", "virtual"):
            raise ValueError(
                f"positioner.can is the bus of tactile: only socketcan shares it, this is "
                f"{can.interface}; give the axes a bus of their own"
            )
        if tactile.node_id in [drive.node_id for drive in positioner.drives]:
            raise ValueError(
                f"a drive of positioner and the control unit have the node-ID {tactile.node_id} "
                "on one bus; give one of them another"
            )

    def _check_full_scale(self, layout: TaxelLayout, most_n: float) -> None:
        """Refuse a calibration if the end of the ramp saturates the taxels under a small part."""
        law = make_calibration(self.tactile, layout)
        full_n = float(law.force_n(np.array([float(layout.adc_max)]))[0])
        if most_n > TAXELS_OF_SMALL_PART * full_n:
            raise ValueError(
                f"sequence asks for {most_n:g} N, but with tactile.calibration a taxel saturates "
                f"at {full_n:.3g} N. A small part presses about {TAXELS_OF_SMALL_PART} taxels of "
                f"a pad, which measure up to {TAXELS_OF_SMALL_PART * full_n:.3g} N; ask for less "
                "force or correct the calibration"
            )

    @property
    def simulated(self) -> bool:
        """Whether this is the built-in simulated cell."""
        return self.gripper.port == SIMULATED

    @property
    def can_buses(self) -> list[tuple[str, str, TactileConfig | AxesCanConfig]]:
        """Role, key and settings of each CAN bus."""
        buses: list[tuple[str, str, TactileConfig | AxesCanConfig]] = []
        if self.tactile.sensor.on_can:
            buses.append(("can", "tactile", self.tactile))
        if self.positioner.drives:
            buses.append(("axes", "positioner.can", self.positioner.can))
        return buses

    @property
    def serial_ports(self) -> list[tuple[str, str, str]]:
        """Role, key and name of each real serial port."""
        ports = [("servos", "gripper.port", self.gripper.port)]
        ports += [
            (role, f"{key}.channel", can.channel)
            for role, key, can in self.can_buses
            if can.channel.startswith("/") and can.interface != SIMULATED
        ]
        ports += [
            (f"sensor{number}", f"tactile.sensor.ports[{number}]", port)
            for number, port in enumerate(self.tactile.serial_ports)
        ]
        ports += [
            (axis.moves, f"port of the axis {axis.moves}", axis.port)
            for axis in self.positioner.axes
            if isinstance(axis, ServoAxisConfig)
        ]
        return [port for port in ports if port[2] != SIMULATED]

    @property
    def decides_early(self) -> bool:
        """Whether ramps may end early: answers are computed in parallel to the force loop."""
        return self.sequence.decide_early and (self.simulated or self.loop.own_process)

    @property
    def brings_objects(self) -> bool:
        """Whether the simulated cell brings the objects by itself, without asking a person."""
        kind, there = self.positioner.kind, bool(self.positioner.socket)
        return kind == "simulated" or (kind == "axes" and (self.simulated or there))

    @property
    def gripper_settings(self) -> GripperSettings:
        """Limits and tuning of the gripper in SI; raises gripper.errors.LimitExceeded."""
        return gripper_settings(self.gripper, overruns_max=self.loop.overruns_max)

    @property
    def largest_ramp_n(self) -> float:
        """Largest force of a ramp in N; raises gripper.errors.LimitExceeded."""
        return largest_ramp_n(self.mechanics)

    @property
    def friction_n(self) -> float:
        """Largest friction of a servo on the way of the fingers, as grip force in N."""
        return max(path.friction_n for path in self.mechanics.end_transmissions())

    @property
    def linkage(self) -> Linkage:
        """Mechanics between servos and fingers."""
        return linkage_of(self.gripper)

    @property
    def mechanics(self) -> Mechanics:
        """Linkage, settings and drives before a measurement; raises as `gripper_settings`."""
        return Mechanics(self.gripper_settings, self.linkage)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the operator where the cell deviates from its settings."""
        notes: tuple[str, ...] = ()
        if self.sequence.decide_early and not self.decides_early:
            notes += ("force ramps do not end early: sequence.decide_early needs loop.own_process",)
        if self.friction_n > _MUCH_FRICTION_N:
            notes += (
                f"the servos' friction is {self.friction_n:.0f} N at the pads: when it breaks, the "
                "force may jump by 1 N or more and stay above its set-point. To avoid this use "
                "longer links, a larger pinion or servos with less friction",
            )
        most_n = max(self.sequence.forces_n[1], self.sequence.carry_force_n)
        cap_n, sure_n = self.gripper.force_max_n, self.mechanics.sure_force_n
        if sure_n < most_n and self.self_zero in ("on_demand", "never"):
            notes += (
                f"until a self-zero measures the drives, the grip may stay at {sure_n:.1f} N of "
                f"{most_n:g} N, so that no drive exceeds gripper.force_max_n = {cap_n:g} N. Raise "
                "that, ask for less force, or measure: `tactile-cell hand zero`",
            )
        if hot := heat_note(most_n, self.mechanics):
            notes += (hot,)
        asked_mm_s = self.gripper.approach_speed_mm_s
        speed_mm_s = 1e3 * check_approach(self.mechanics)
        if speed_mm_s < asked_mm_s:
            notes += (
                f"the fingers approach with as little as {speed_mm_s:.1f} mm/s, not with "
                f"gripper.approach_speed_mm_s = {asked_mm_s:g}: at a higher speed the impact could "
                f"exceed gripper.force_max_n = {self.gripper.force_max_n:g} N. To close faster, "
                "lower gripper.contact.approach_force_n, or gripper.contact.pad_stiffness_n_mm if "
                "the pads are softer",
            )
        return notes
