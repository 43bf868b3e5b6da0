"""Grasps of a drawing: what the cell's pads would read, without a cell and without time.

A rigid shape is pressed between two foam pads by `recognition.foam_model`; the course of a grasp is
that of the cell: the fingers close at the approach speed, meet the object with some impact, follow
the force ramp with the stick and slip of a geared drive, and hold. Frames carry the sensor's noise
and are not tared, as the cell's own.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from cell.sequence import GraspStep
from cell.virtual_press import Press, press, reaches_m, shared_force
from gripper.ramp import ForceRamp
from recognition.drawing import Drawing
from recognition.foam_model import FoamModel, PadBed
from recognition.grasp import Grasp, PadArray

SOURCE = "drawing"
"""What a data set says of the origin of such grasps."""

_SLOW_S = 0.5


class Noise(Protocol):
    """What a taxel reads beside the force on it."""

    def __call__(self, rng: np.random.Generator, n_frames: int) -> NDArray[np.float64]:
        """Return counts (n_frames, n_taxels) to add."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """How a cell moves and how well that is known.

    Attributes
    ----------
    period_s
        Time between two frames in s.
    aperture_open_m
        Opening at the start in m.
    approach_speed_m_s
        Closing speed of the opening in m/s.
    aperture_step_m
        Smallest step of the measured opening in m.
    aperture_sd_m
        Standard deviation in m of the measured opening, the same over one grasp.
    impact_n : (low, high)
        Grip force in N with which the ramp begins.
    slip_n
        Largest lag in N behind the set-point before the fingers move on.
    force_sd
        Relative standard deviation of the force at the end of the ramp.
    modulus_sd, gain_sd, spread_sd, densification_sd, thickness_sd
        Relative standard deviations of what is known of foam and sensor; drawn for each grasp.
    bend_sd
        Standard deviation of the logarithm of an exponent of the reading: a converter that bends
        otherwise than its law.
    lag
        Largest share of a reading that follows the force only slowly: foam creeps.
    noise_sd
        Standard deviation of the logarithm of a factor on the noise.
    pad_gain_sd, taxel_gain_sd
        Relative standard deviations of the gains of the two pads, and of single taxels.
    tilt_rad
        Standard deviation in rad by which an object lies aslant between the pads, about x and y.
    imbalance_n
        Largest difference in N between the forces on both pads: the object is held a little.
    """

    period_s: float = 0.02
    aperture_open_m: float = 18e-3
    approach_speed_m_s: float = 12e-3
    aperture_step_m: float = 0.1e-3
    aperture_sd_m: float = 0.2e-3
    impact_n: tuple[float, float] = (0.8, 1.7)
    slip_n: float = 0.5
    force_sd: float = 0.05
    modulus_sd: float = 0.05
    gain_sd: float = 0.05
    spread_sd: float = 0.05
    densification_sd: float = 0.1
    thickness_sd: float = 0.03
    bend_sd: float = 0.0
    lag: float = 0.0
    noise_sd: float = 0.0
    pad_gain_sd: float = 0.05
    taxel_gain_sd: float = 0.08
    tilt_rad: float = 0.01
    imbalance_n: float = 0.05


class VirtualPads:
    """The two gripping pads and their foam; draws grasps.

    Parameters
    ----------
    pads
        All taxels.
    gripping
        The two pads that face each other.
    foam
        Foam and sensor, as calibrated.
    course
        How the cell moves.
    noise
        What is added to the counts.
    """

    def __init__(
        self,
        pads: PadArray,
        gripping: tuple[int, int],
        *,
        foam: FoamModel,
        course: Course,
        noise: Noise,
    ) -> None:
        self._pads = pads
        self._foam = foam
        self._course = course
        self._noise = noise
        # The spread is drawn from few values: the matrices that it needs are worked out once.
        spreads = foam.spread_m * np.exp(course.spread_sd * np.array([-1.2, -0.4, 0.4, 1.2]))
        self._beds = [
            tuple(PadBed(pads, pad, float(spread_m)) for pad in gripping) for spread_m in spreads
        ]

    def grasp(
        self,
        drawing: Drawing,
        step: GraspStep,
        ramp: ForceRamp,
        rng: np.random.Generator,
        *,
        label: str,
        shape: str = "",
        start_ms: int = 0,
    ) -> Grasp:
        """Return one grasp of a drawing.

        Parameters
        ----------
        drawing
            What is grasped.
        step
            Pose and force; the roll settles on the nearest side that the object rests on.
        ramp
            The force ramp of this grasp.
        rng
            What comes by chance.
        label, shape, start_ms
            What the record says of itself.

        Raises
        ------
        ValueError
            The object lies beside a pad, or does not fit into the open gripper.
        """
        course = self._course
        foam = FoamModel(
            **(
                self._foam.as_dict()
                | {
                    "modulus_pa": self._foam.modulus_pa * rng.lognormal(0.0, course.modulus_sd),
                    "gain": self._foam.gain * rng.lognormal(0.0, course.gain_sd),
                    "densification": self._foam.densification
                    * rng.lognormal(0.0, course.densification_sd),
                    "thickness_m": self._foam.thickness_m * rng.lognormal(0.0, course.thickness_sd),
                }
            )
        )
        beds = self._beds[int(rng.integers(len(self._beds)))]
        aslant = rng.normal(0.0, course.tilt_rad, 2)
        presses = [
            press(bed, reach_m, foam)
            for bed, reach_m in zip(beds, reaches_m(drawing, step.pose, beds, aslant), strict=True)
        ]
        touch_m = sum(p.reach_max_m for p in presses)
        if touch_m >= course.aperture_open_m:
            raise ValueError(
                f"the object is {1e3 * touch_m:.1f} mm thick at {step.pose}, the gripper opens to "
                f"{1e3 * course.aperture_open_m:.1f} mm: open it further, or turn the object"
            )
        largest_n = min(float(p.force_n[-1]) for p in presses)
        closing_s, impact_n = self._approach(touch_m, presses, rng)
        force_n, setpoint_n = _force_course(ramp, impact_n, course, rng)
        speed_m_s = course.approach_speed_m_s
        aperture_m = np.concatenate(
            [
                np.maximum(course.aperture_open_m - speed_m_s * closing_s, 0.0),
                np.zeros(len(force_n)),
            ]
        )
        n_closing = len(closing_s)
        depth_closing_m = np.maximum(touch_m - aperture_m[:n_closing], 0.0)
        force_n = np.concatenate([shared_force(presses, depth_closing_m), force_n])
        setpoint_n = np.concatenate([np.zeros(n_closing), setpoint_n])
        force_n = np.minimum(force_n, 0.98 * largest_n)
        n = len(force_n)
        of_sensor = rng.spawn(1)[0]
        bend = of_sensor.lognormal(0.0, course.bend_sd)
        lag = course.lag * of_sensor.uniform()
        counts = of_sensor.lognormal(0.0, course.noise_sd) * self._noise(rng, n)
        slack_n = 0.5 * course.imbalance_n * rng.uniform(-1.0, 1.0)
        depths_m = []
        for bed, pressed, sign in zip(beds, presses, (1.0, -1.0), strict=True):
            here_n = np.where(force_n > 0.0, np.maximum(force_n + sign * slack_n, 0.0), 0.0)
            depth_m = np.interp(here_n, pressed.force_n, pressed.depth_m)
            depths_m.append(depth_m)
            gains = rng.lognormal(0.0, course.pad_gain_sd) * np.exp(
                rng.normal(0.0, course.taxel_gain_sd, len(bed.taxels))
            )
            felt_n = pressed.taxel_force_n(depth_m)
            felt_n += lag * (_slowly(felt_n, _SLOW_S / course.period_s) - felt_n)
            share = foam.response(felt_n * gains)
            counts[:, bed.taxels] += self._pads.adc_max * share**bend
        aperture_m[n_closing:] = touch_m - (depths_m[0] + depths_m[1])[n_closing:]
        return Grasp(
            pads=self._pads,
            counts=np.rint(np.clip(counts, 0.0, self._pads.adc_max)),
            t_s=np.arange(n, dtype=np.float64) * course.period_s,
            aperture_m=_measured(aperture_m, foam.aperture_offset_m, course, rng),
            force_n=setpoint_n,
            label=label,
            shape=shape,
            source=SOURCE,
            start_ms=start_ms,
            placing=step.placing,
        )

    def _approach(
        self, touch_m: float, presses: Sequence["Press"], rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], float]:
        """Return the times at which the fingers close in s, and the force they stop with in N."""
        course = self._course
        impact_n = rng.uniform(*course.impact_n)
        depth_m = sum(float(np.interp(impact_n, p.force_n, p.depth_m)) for p in presses)
        way_m = course.aperture_open_m - touch_m + depth_m
        wait_s = rng.uniform(0.05, 0.15)
        pause_s = rng.uniform(0.0, 0.1)
        n_closing = math.ceil((wait_s + way_m / course.approach_speed_m_s) / course.period_s)
        times_s = course.period_s * np.arange(n_closing + round(pause_s / course.period_s))
        return np.clip(times_s - wait_s, 0.0, way_m / course.approach_speed_m_s), impact_n


def _slowly(values: NDArray[np.float64], n_frames: float) -> NDArray[np.float64]:
    """Return what follows values (n, ...) with a time constant of so many frames."""
    share = -math.expm1(-1.0 / n_frames)
    out: NDArray[np.float64] = lfilter([share], [1.0, share - 1.0], values, axis=0)
    return out


def _force_course(
    ramp: ForceRamp, impact_n: float, course: Course, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return force and set-point in N in each frame from the beginning of the ramp on."""
    actual = ramp.starting_from(impact_n)
    n = math.ceil(actual.duration_s / course.period_s) + int(rng.integers(1, 8))
    setpoint_n = np.array([actual.setpoint_n(course.period_s * i) for i in range(n)])
    scale = rng.normal(1.0, course.force_sd)
    force_n = np.empty(n)
    held_n, lag_n = impact_n, course.slip_n * rng.uniform()
    for i, wanted_n in enumerate(setpoint_n):
        target_n = float(wanted_n) * scale + 0.15
        over = i >= n - 0.2 / course.period_s
        if abs(target_n - held_n) > lag_n or over:
            held_n += (0.3 if over else 1.0) * (target_n - held_n)
            lag_n = course.slip_n * rng.uniform()
        force_n[i] = held_n
    return force_n, setpoint_n


def _measured(
    aperture_m: NDArray[np.float64],
    offset_m: float,
    course: Course,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    step_m = course.aperture_step_m
    shift_m = offset_m + rng.normal(0.0, course.aperture_sd_m)
    phase_m = rng.uniform(0.0, step_m)
    steps: NDArray[np.float64] = np.rint((aperture_m + shift_m - phase_m) / step_m)
    return steps * step_m + phase_m
