"""Step `fingers`: directions, zero, ends and linkage by hand, then the first motion.

A person moves the fingers without torque while the screen shows the angles; known blocks between
the pads convert angles to lengths. Then a motor moves, at the least current that moves it.
"""

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from math import degrees
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from cell.commissioning.bench import Bench
from cell.commissioning.engine import LIVE_CALL_S, Dialog, Step, StepFailed
from cell.commissioning.findings import Notes, ProposedChange, commission_command
from cell.commissioning.servos import torque_off
from cell.config.gripper import ServoConfig, gripper_settings, linkage_of
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import PRESENT_BLOCK, TORQUE_ENABLE
from gripper.dynamixel.models import MODELS, ServoModel
from gripper.errors import GripperError
from gripper.mechanics.kinematics import Linkage, ParallelLinkage, RackPinion
from gripper.mechanics.transmission import Mechanics
from gripper.servos.goal_limits import ServoGoal, closing_margin_rad
from gripper.servos.group import Servos
from gripper.settings import GripperSettings

Kind = Literal["parallel", "pinion", "swinging"]
KINDS: dict[Kind, str] = {
    "parallel": r"""the pads stay parallel, on links that point straight ahead when closed
         ## ##          ##      ##
         ## ##          ##      ##
        | | | |        / /      \ \
        o o o o       o o        o o""",
    "pinion": r"""the fingers slide straight, on racks with a pinion
         ## ##          ##      ##
         ## ##          ##      ##
        =======       =====    =====
          (O)              (O)""",
    "swinging": r"""the fingers swing, or their links stand askew when closed
         ## ##         ##        ##
         ## ##          ##      ##
          | |             \    /
          o o              o  o""",
}
"""Kinds of linkage that are fitted; closed on the left, open on the right."""

Pulses = NDArray[np.int_]
"""Present Position of each servo in pulses, in the order of the fingers."""

_MOVED_PULSES = 60
"""Travel of a servo, 5 degrees, above which a finger was moved."""
_STILL_SHARE = 0.2
"""Travel of the other finger, as a share of that of the moved one, that does not count."""
_END_MARGIN_M = 2e-3
"""Margin in m to the widest opening by hand."""
_GOOD_FIT_M = 0.3e-3
"""Largest residual in m of the simplest linkage: calliper, touch and encoder."""
_MOST_OFFSET_M = 0.05
"""Largest offset in m of a linkage in the config (gripper.linkage.offset_mm)."""
_BAD_FIT_M = 0.5e-3
"""Largest residual in m without a warning."""
_UNUSABLE_FIT_M = 3e-3
"""Largest residual in m with which a motor may move."""
_BLOCKS = (
    ("Take a stiff block with parallel faces, best about 10 mm thick; measure it.", 1.0),
    ("A second, different one, best about 30 mm thick; 0 if you have none.", 0.0),
)
"""Texts that ask for the blocks, each with the least thickness in mm."""
_OFF_PULSES = 60
"""Least distance of a zero from that of the config that is reported."""
_LEAST_ROOM_M = 6e-3
"""Opening in m, and distance from the widest one, that the first motion needs."""
_FIRST_WAY_RAD = 0.05
"""Least travel of the goal of the first motion in rad: 3 mm with links of 60 mm. The finger is
stopped after half of it."""
_RAMP_A_S = 0.1
"""Rise of the current in the first motion in A/s."""
_WRONG_WAY_RAD = 0.01
"""Travel in rad in the wrong direction at which all torque goes off: 0.6 mm."""
_FIRST_FORCE_N = 0.1
"""Force in N, beyond friction, with which the fingers hold still before the first motion."""


class LinkageFit(NamedTuple):
    """A linkage fitted to closed fingers and blocks."""

    linkage: ParallelLinkage | RackPinion
    closed_rad: float
    """Angle of the linkage at which the pads meet."""
    residual_m: float
    """Largest difference between fitted and measured opening in m."""


def fit_linkages(
    angles_rad: ArrayLike, aperture_m: ArrayLike
) -> tuple[dict[Kind, LinkageFit], Kind | None]:
    """Return the linkage of each kind that fits closed fingers and blocks, and the best kind.

    No kind is the best if a rival is as good within the measuring error. Closed fingers (opening 0
    at angle 0) are a separate measurement. A swinging finger follows the law of a parallelogram at
    the middle of its pad, with oblique links when closed. It has one more unknown: it needs two
    blocks, and is preferred only if the simpler ones fail.

    Parameters
    ----------
    angles_rad
        (n_blocks, n_servos): angle of each servo on a block from the closed fingers, growing while
        they open.
    aperture_m
        (n_blocks,): sizes of the blocks.
    """
    angles, sizes_m = np.asarray(angles_rad), np.asarray(aperture_m)
    n_blocks, n = angles.shape

    def scale_m(way: NDArray[np.float64]) -> float:
        """Return the least-squares link length or pinion radius in m for the block sizes."""
        both = 2.0 * way.mean(axis=1)
        return float(both @ sizes_m / (both @ both))

    rack = RackPinion(pinion_radius_m=scale_m(angles), n_servos=n)
    parallel = ParallelLinkage(link_m=scale_m(np.sin(angles)), n_servos=n)
    fits: dict[Kind, LinkageFit] = {
        "parallel": LinkageFit(parallel, 0.0, residual_m(parallel, angles, sizes_m)),
        "pinion": LinkageFit(rack, 0.0, residual_m(rack, angles, sizes_m)),
    }
    best, rival = sorted(fits, key=lambda kind: fits[kind].residual_m)
    if n_blocks > 1:
        swinging = _swinging(angles, sizes_m, parallel.link_m)
        if abs(swinging.linkage.aperture_m([0.0] * n)) <= 2.0 * _MOST_OFFSET_M:
            fits["swinging"] = swinging
            if fits[best].residual_m > _GOOD_FIT_M:  # it always fits: it never beats a good one
                best, rival = "swinging", best
    sure = fits[rival].residual_m - fits[best].residual_m > _GOOD_FIT_M
    return fits, best if sure else None


def _swinging(
    angles: NDArray[np.float64], sizes_m: NDArray[np.float64], start_m: float
) -> LinkageFit:
    """Fit length of the links and their angle when closed."""

    def residuals(unknown: NDArray[np.float64]) -> NDArray[np.float64]:
        link_m, closed_rad = unknown
        halves = np.sin(angles + closed_rad) - np.sin(closed_rad)
        return np.asarray(1e3 * (2.0 * link_m * halves.mean(axis=1) - sizes_m))

    least, most = (5e-3, -1.2), (0.5, 1.2)
    start = (np.clip(start_m, least[0], most[0]), 0.0)
    solution = least_squares(residuals, start, bounds=(least, most), x_scale=(0.01, 0.1))
    link_m, closed_rad = (float(value) for value in solution.x)
    linkage = ParallelLinkage(
        link_m=link_m, offset_m=-link_m * float(np.sin(closed_rad)), n_servos=angles.shape[1]
    )
    return LinkageFit(linkage, closed_rad, residual_m(linkage, angles + closed_rad, sizes_m))


def residual_m(
    linkage: Linkage, angles_rad: NDArray[np.float64], sizes_m: NDArray[np.float64]
) -> float:
    """Return the largest error in m of a linkage at blocks; ``angles_rad`` are its own angles."""
    openings_m = np.array([linkage.aperture_m(row) for row in angles_rad.tolist()])
    return float(np.abs(openings_m - sizes_m).max())


def measure_fingers(bench: Bench, dialog: Dialog, notes: Notes) -> None:
    """Move the fingers by hand, without torque, then close them on blocks of known size.

    This gives directions, zero, ends and linkage. At the end each finger opens by itself, by about
    3 mm at the least current that moves it, and has no torque again.
    """
    gripper = bench.gripper()
    with bench.servo_bus() as bus:
        for servo in gripper.servos:
            torque_off(bus, dialog, servo.id, bus.read(servo.id, TORQUE_ENABLE))
        _Hands(bench, dialog, bus, notes).run()


FINGERS = Step(measure_fingers, "fingers", "Fingers", needs=("servos",))


class _Hands:
    """One run of the step."""

    def __init__(self, bench: Bench, dialog: Dialog, bus: ServoBus, notes: Notes) -> None:
        self._bench, self._dialog, self._bus, self._notes = bench, dialog, bus, notes
        self._gripper = bench.gripper()
        self._servos = list(self._gripper.servos)
        self._live_text: Callable[[], str] = self._pulses

    @property
    def _models(self) -> list[ServoModel]:
        return [MODELS[servo.model] for servo in self._servos]

    def run(self) -> None:
        closed, opened = self._ends()
        turn = min(model.pulses_per_turn for model in self._models)
        for servo, *ends in zip(self._servos, closed, opened, strict=True):
            if not 0 <= min(ends) <= max(ends) < turn:
                raise StepFailed(
                    f"servo {servo.id} crosses the end of its encoder's turn ({ends[0]} to "
                    f"{ends[1]} pulses): mount its horn half a turn further"
                )
        if (least := np.abs(opened - closed).min()) < _MOVED_PULSES:
            raise StepFailed(
                f"a servo was moved by {least} pulses, at least {_MOVED_PULSES} are needed: move "
                "each finger from open to closed"
            )
        signs = np.sign(opened - closed)
        on_blocks, sizes_m = self._blocks(closed, signs)
        fits, best = fit_linkages(on_blocks, sizes_m)
        kind = self._chosen(fits, best)
        fit = fits[kind]
        if fit.residual_m > _UNUSABLE_FIT_M:
            raise StepFailed(
                f"the linkage ({fit.linkage}) misses a measured opening by "
                f"{fit.residual_m * 1e3:.1f} mm, at most {_UNUSABLE_FIT_M * 1e3:g} mm: was a "
                "thickness typed wrong, or a block not held flat? Nothing has moved by itself"
            )
        zeros = [
            int(raw - sign * round(fit.closed_rad / model.rad_per_pulse))
            for model, raw, sign in zip(self._models, closed, signs, strict=True)
        ]
        if not 0 <= min(zeros) <= max(zeros) < turn:
            raise StepFailed(
                f"the zero of the linkage is at {zeros} pulses, outside of the encoder's turn "
                f"(0 to {turn - 1}): turn the horn so that the closed finger is near {turn // 2}"
            )
        self._servos = [
            servo.model_copy(update={"direction": int(sign), "zero_pulse": zero})
            for servo, sign, zero in zip(self._servos, signs, zeros, strict=True)
        ]
        angles_rad = fit.closed_rad + self._turned(opened, closed, signs)
        widest_m = fit.linkage.aperture_m(angles_rad.tolist())
        self._judge(fit, widest_m, on_blocks, sizes_m)
        linkage = f"linkage: {_linkage_text(fit.linkage)}; residual {fit.residual_m * 1e3:.2f} mm"
        if len(sizes_m) > (2 if kind == "swinging" else 1):
            self._notes.fact(linkage)
        else:
            self._notes.warn(
                f"{linkage} (as many blocks as unknowns: check an opening with a ruler)"
            )
        self._notes.fact(f"widest opening by hand: {widest_m * 1e3:.1f} mm")
        if fit.residual_m > _BAD_FIT_M:
            self._notes.warn(
                f"the residual is above {_BAD_FIT_M * 1e3:g} mm: measure the blocks again, look "
                f"for play, and run `{commission_command(self._bench.folder)} --redo fingers`"
            )
        self._notes.values |= {
            "residual_mm": round(fit.residual_m * 1e3, 3),
            "fits": {name: round(other.residual_m * 1e3, 3) for name, other in fits.items()},
        }
        self._first_motion(widest_m)

    # By hand

    def _read(self) -> Pulses:
        """Return Present Position of each servo in pulses, in the order of the fingers."""
        blocks = self._bus.sync_read([servo.id for servo in self._servos], PRESENT_BLOCK)
        return np.array([blocks[servo.id]["present_position"] for servo in self._servos])

    def _turned(
        self, raws: Pulses, closed: ArrayLike = 0, signs: ArrayLike = 1
    ) -> NDArray[np.float64]:
        """Return the angles in rad from the closed fingers, growing while they open."""
        units_rad = [model.rad_per_pulse for model in self._models]
        return np.asarray((raws - np.asarray(closed)) * np.asarray(signs) * units_rad)

    def _pulses(self) -> str:
        names = [f"servo {servo.id}:" for servo in self._servos]
        return _degrees_text(names, self._turned(self._read()))

    def _by_hand(self, key: str, text: str) -> Pulses:
        """Ask for a position by hand and return it in pulses."""
        self._dialog.confirm(f"fingers.{key}", text, watch=self._live_text)
        return self._read()

    def _ends(self) -> tuple[Pulses, Pulses]:
        """Return the positions closed and wide open; puts the servos in the order of the fingers.

        Finger 0 is the one that the person opens first.
        """
        closed = self._by_hand(
            "close",
            "The servos have no torque. Take out whatever is between the fingers and close them "
            "by hand until their pads touch, in the middle.",
        )
        both = "Open one finger by hand as far as it goes, and leave the other. This one is finger "
        alone = "Open the fingers by hand as far as they go."
        text = alone if len(self._servos) == 1 else f"{both}0 from now on: mark it."
        opened = self._by_hand("open_first", text)
        ways = np.abs(opened - closed)
        index = int(ways.argmax())
        still = np.delete(ways, index) <= _STILL_SHARE * ways[index]
        if ways[index] < _MOVED_PULSES or not still.all():
            names = [f"servo {servo.id} by" for servo in self._servos]
            raise StepFailed(
                "one finger should have moved by 5 degrees or more, and no other. From closed: "
                f"{_degrees_text(names, np.abs(self._turned(opened, closed)))}"
            )
        if len(self._servos) == 1:
            return closed, opened
        order = [index, 1 - index]
        self._servos = [self._servos[i] for i in order]
        last = self._by_hand("open_second", "Now open the other one as far as it goes.")[1]
        return closed[order], np.array([opened[index], last])

    def _blocks(
        self, closed: Pulses, signs: Pulses
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the angles in rad on two blocks of known size, or on one, and the sizes in m."""
        fingers = [f"finger {number} open by" for number in range(len(signs))]
        self._live_text = lambda: _degrees_text(fingers, self._turned(self._read(), closed, signs))
        rows, sizes_m = list[NDArray[np.float64]](), list[float]()
        for number, (text, least) in enumerate(_BLOCKS, start=1):
            size_mm = self._dialog.number(
                f"fingers.block{number}",
                f"{text} How thick is it?",
                (least, 400.0, "mm"),
                None if least else 0.0,
            )
            if size_mm <= 0.0 or abs(size_mm - 1e3 * sum(sizes_m)) < 1.0:  # the first one again
                break
            raws = self._by_hand(
                f"on_block{number}",
                f"Hold the block of {size_mm:g} mm between the pads and close both fingers by hand "
                "until they just touch it, flat.",
            )
            angles_rad = self._turned(raws, closed, signs)
            if closer := {f"finger {i} by": -a for i, a in enumerate(angles_rad) if a <= 0.0}:
                raise StepFailed(
                    "on the block fingers are closer than in the closed position: "
                    f"{_degrees_text(closer, closer.values())}. Was something between the pads "
                    "there, or a finger pushed past the other one?"
                )
            rows.append(angles_rad)
            sizes_m.append(size_mm * 1e-3)
        return np.array(rows), np.array(sizes_m)

    def _chosen(self, fits: Mapping[Kind, LinkageFit], best: Kind | None) -> Kind:
        """Return the kind of linkage that the person confirms; the fit proposes one if it can."""
        order = sorted(fits, key=lambda kind: kind != best)
        why = "the first one best." if best else "more than one kind: look while you move them."
        answer = self._dialog.choose(
            "fingers.kind",
            f"How do the fingers move? The measurements fit {why}",
            {
                kind: KINDS[kind].replace(
                    "\n",
                    f" ({fits[kind].linkage}; residual {fits[kind].residual_m * 1e3:.2f} mm)\n",
                    1,
                )
                for kind in order
            },
            best,
        )
        return next(kind for kind in fits if kind == answer)

    # The result

    def _judge(
        self,
        fit: LinkageFit,
        widest_m: float,
        on_blocks: NDArray[np.float64],
        sizes_m: NDArray[np.float64],
    ) -> None:
        """Set the measurements by hand, and note their differences from the config."""
        notes, drive = self._notes, fit.linkage
        linkage: dict[str, Any] = {"kind": "rack_pinion", "offset_mm": 0.0}
        if isinstance(drive, ParallelLinkage):
            linkage = {"kind": "parallel_linkage", "offset_mm": round(drive.offset_m * 1e3, 3)}
            linkage["link_mm"] = round(drive.link_m * 1e3, 3)
        else:
            linkage["pinion_radius_mm"] = round(drive.pinion_radius_m * 1e3, 3)
        notes.settings |= {
            "gripper.servos": [servo.model_dump(mode="json") for servo in self._servos],
            "gripper.linkage": linkage,
        }
        corrected = list[str]()
        was_by_id = {servo.id: servo for servo in self._bench.base.gripper.servos}
        for number, servo in enumerate(self._servos):
            notes.fact(
                f"finger {number}: servo {servo.id}, direction {servo.direction:+d}, zero at "
                f"{servo.zero_pulse} pulses"
            )
            was = was_by_id.get(servo.id, ServoConfig(id=servo.id))
            if servo.direction != was.direction:
                corrected.append(
                    f"servo {servo.id} turns the other way: its direction was {was.direction:+d}, "
                    f"is now {servo.direction:+d}"
                )
            if abs(off := servo.zero_pulse - was.zero_pulse) > _OFF_PULSES:
                off_deg = degrees(off * MODELS[servo.model].rad_per_pulse)
                corrected.append(
                    f"servo {servo.id}: its horn sits {off_deg:+.1f} deg off: its zero was "
                    f"{was.zero_pulse} pulses, is now {servo.zero_pulse}"
                )
        before = linkage_of(self._gripper)
        own_rad = on_blocks + np.array(before.angles_rad(0.0))
        if type(before) is not type(drive) or residual_m(before, own_rad, sizes_m) > _BAD_FIT_M:
            corrected.append(
                f"the linkage was {_linkage_text(before)}; it is now {_linkage_text(drive)}"
            )
        reach_mm, wanted_mm = (widest_m - _END_MARGIN_M) * 1e3, self._gripper.aperture_open_mm
        if reach_mm < wanted_mm:
            notes.settings["gripper.aperture_open_mm"] = round(reach_mm, 2)
            corrected.append(f"gripper.aperture_open_mm was {wanted_mm:g}, is now {reach_mm:.2f}")
        for line in corrected:
            notes.fact(line, corrected=True)

    def _first_motion(self, widest_m: float) -> None:
        """Open each finger by a little, at the least current, then ask whether it did."""
        config = self._bench.gripper()
        linkage = linkage_of(config)
        settings = gripper_settings(config, overruns_max=1)
        # The largest plausible friction.
        frictions_a = (servo.drive.most_breakaway_a for servo in settings.servos)
        cap_a = min(settings.current_max_a, *frictions_a)
        settings = replace(
            settings, current_max_a=cap_a, aperture_open_m=widest_m, approach_force_n=_FIRST_FORCE_N
        )
        group = Servos(self._bus, Mechanics(settings, linkage), self._bench.clock)

        def opening_m() -> float:
            return linkage.aperture_m(group.read_patiently().angles_rad)

        self._live_text = lambda: f"opening {opening_m() * 1e3:.1f} mm"
        least_m, most_m = _LEAST_ROOM_M, widest_m - _LEAST_ROOM_M
        half = "open both fingers by hand to about half way. Keep your hands off then."
        text = f"Take the block out and {half}"
        while True:
            self._dialog.confirm("fingers.free", text, watch=self._live_text)
            if least_m <= (stand_m := opening_m()) <= most_m:
                break
            text = (
                f"The opening is {stand_m * 1e3:.1f} mm, but the motion needs {least_m * 1e3:g} to "
                f"{most_m * 1e3:.1f} mm: {half}"
            )
        names = [f"finger {number} (servo {s.id})" for number, s in enumerate(self._servos)]
        # So far ahead that the goal gets this current.
        ways_rad = [max(_FIRST_WAY_RAD, closing_margin_rad(model, cap_a)) for model in self._models]
        most = f"at most, with {cap_a:.2f} A at most, then no torque"
        self._dialog.approve(
            [
                ProposedChange(
                    *(name, "first motion", "at rest, no torque"),
                    *(f"opens by {degrees(way_rad):.1f} deg {most}", "by hand"),
                )
                for name, way_rad in zip(names, ways_rad, strict=True)
            ]
        )
        try:
            group.make_ready(part_possible=False, releasing=False)
            for number, (name, goal_rad) in enumerate(zip(names, ways_rad, strict=True)):
                current_a, way_rad = self._open_a_little(group, settings, number, goal_rad)
                if way_rad <= -_WRONG_WAY_RAD:
                    raise StepFailed(
                        f"{name}: closed instead of opening, and was switched off: its direction "
                        "is wrong; run the step again"
                    )
                if way_rad < _FIRST_WAY_RAD / 2.0:
                    raise StepFailed(
                        f"{name}: did not move with {cap_a:.2f} A: check what blocks it, how "
                        "freely it turns by hand, and the supply"
                    )
                self._notes.fact(
                    f"{name}: opened by {degrees(way_rad):.1f} deg with {current_a:.3f} A"
                )
        except GripperError as error:
            text = f"the first motion ended, the servos have no torque: {error}"
            raise StepFailed(text) from error
        finally:
            group.go_limp()
        answer = self._dialog.choose(
            "fingers.opened",
            "Did each finger open by itself, one after the other?",
            {"yes": "yes, both opened", "no": "no: one closed, or did not move"},
        )
        if answer == "no":
            raise StepFailed(
                "what the servos report and what the fingers do differ: fasten the horns, keep "
                "your hands off, and run the step again"
            )

    def _open_a_little(
        self, group: Servos, settings: GripperSettings, index: int, goal_rad: float
    ) -> tuple[float, float]:
        """Raise the current of one servo until its finger opens; return current in A, way in rad.

        Its goal is ``goal_rad`` ahead. The other servo holds its position.
        `gripper.servos.goal_limits` limits the current.
        """
        clock, period_s = self._bench.clock, settings.period_s
        state = group.read_patiently()
        start = state.angles_rad
        hold_a = group.goal_current_a
        current_a, way_rad, shown_s = 0.0, 0.0, clock.monotonic()
        while current_a < settings.current_max_a:
            current_a = min(current_a + _RAMP_A_S * period_s, settings.current_max_a)
            goals = [ServoGoal(angle_rad=angle, current_a=hold_a) for angle in start]
            goals[index] = ServoGoal(angle_rad=start[index] + goal_rad, current_a=current_a)
            group.goals.write(goals, state)
            clock.sleep(period_s)
            state = group.read_patiently()
            way_rad = state.angles_rad[index] - start[index]
            if clock.monotonic() >= shown_s:
                # The person may stop the motion here: the torque then goes off.
                text = f"{degrees(way_rad):.1f} deg open, {current_a:.2f} A"
                self._dialog.live(f"finger {index}", text)
                shown_s = clock.monotonic() + LIVE_CALL_S
            if way_rad <= -_WRONG_WAY_RAD or way_rad >= _FIRST_WAY_RAD / 2.0:
                break
        with suppress(GripperError):
            group.hold_position()
        return current_a, way_rad


def _degrees_text(names: Iterable[str], angles_rad: Iterable[float]) -> str:
    """Return angles with their names as text."""
    pairs = zip(names, angles_rad, strict=True)
    return ", ".join(f"{name} {degrees(angle):.1f} deg" for name, angle in pairs)


def _linkage_text(linkage: Linkage) -> str:
    """Return a linkage in the words of the config."""
    kind = "parallel_linkage" if isinstance(linkage, ParallelLinkage) else "rack_pinion"
    return f"{kind}, {linkage}"
