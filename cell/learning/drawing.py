"""Teaching from a drawing: the frames that it would give on the cell's pads, without a cell.

`recognition.shape.foam` presses a rigid shape between two foam pads. The grasp is like that of the
cell: the fingers close at the approach speed and meet the object with some impact. They follow the
force ramp with the stick and slip of a geared drive, and hold. Frames have the sensor's noise and
are not tared, like those of the cell.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.signal import lfilter

from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config
from cell.control.plan import GraspStep, Pose, plan
from cell.control.records import pad_array
from cell.errors import ConfigError, raised_as
from cell.learning.parallel import Progress, one_blas_thread, silent
from cell.learning.shape_reading import usual_foam
from cell.simulation import converter_noise
from gripper.force.ramp import ForceRamp
from recognition.drift.self_zero import drawn_zero
from recognition.grasp import DRAWING_SOURCE, Grasp
from recognition.shape.foam import FoamModel, PadBed
from recognition.shape.models import Drawing, posed, resting_roll_rad

_DEEPEST = 0.97
"""Largest depth as a share of the foam's thickness: beyond it the foam is almost solid."""
_LARGEST_SHARE = 0.98
"""Largest force as a share of that at the largest depth."""
_N_DEPTHS = 48
"""Number of depths at which the force is computed."""
_SLOW_WAY_M = 2e-3
"""Distance in m before the touch of the widest part in which fast fingers slow down: 0.5 mm margin
and 1.5 mm for mass and servo."""
_IMPACT_N = 0.3
"""Largest grip force in N above that of a contact with which the ramp begins."""
_SLOW_S = 0.5
"""Time constant of the foam's creep in s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PressedPad:
    """One pad pressed by one surface, over the depth of its highest point."""

    reach_max_m: float
    """Highest point of the surface above the middle plane in m."""
    depth_m: NDArray[np.float64]
    """(k,) float64: depths of the highest point in m, evenly spaced from 0."""
    force_n: NDArray[np.float64]
    """(k,) float64: force on the pad in N."""
    taxels_n: NDArray[np.float64]
    """(k, n_taxels) float64: force on each taxel in N."""


def reaches_m(
    drawing: Drawing, pose: Pose, beds: Sequence[PadBed], aslant_rad: Sequence[float] = (0.0, 0.0)
) -> list[NDArray[np.float64]]:
    """Return the distance in m that a posed object reaches towards each pad, over the pads' grids.

    A tilt by the two small angles ``aslant_rad`` adds the same distance towards one pad that it
    removes towards the other. It grows with x and y from the centre. Raises ValueError if the
    object lies beside a pad.
    """
    both: list[NDArray[np.float64]] = []
    for side, bed in enumerate(beds):
        if side == 0 or not bed.same_points_as(beds[0]):
            heights_m = posed(
                drawing,
                bed.x_m,
                bed.y_m,
                at_m=(pose.x_m, pose.y_m),
                rotation_rad=pose.rotation_rad,
                roll_rad=resting_roll_rad(drawing, pose.roll_rad),
            )
        if not np.isfinite(heights_m[side]).any():
            off = abs(pose.x_m) > np.abs(bed.x_m).max() or abs(pose.y_m) > np.abs(bed.y_m).max()
            why = "lies beside the pads" if off else "is too narrow for the pads"
            raise ValueError(f"the object {why} at {pose}")
        lever_m = aslant_rad[0] * (bed.x_m - pose.x_m) + aslant_rad[1] * (bed.y_m - pose.y_m)
        both.append(heights_m[side] + (lever_m if side == 0 else -lever_m))
    return both


def pressed_pad(bed: PadBed, reach_m: NDArray[np.float64], foam: FoamModel) -> PressedPad:
    """Return the force of a surface on a pad, from the first touch to almost flat foam."""
    highest_m = float(reach_m.max())
    lag_m = np.where(np.isfinite(reach_m), highest_m - reach_m, np.inf)
    near = lag_m < foam.thickness_m
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    part = np.ix_(rows, columns)
    depth_m = np.linspace(0.0, _DEEPEST * foam.thickness_m, _N_DEPTHS)
    closed_m = depth_m[:, None, None] - lag_m[part]
    pressure_pa = foam.modulus_pa * foam.relative_pressure(closed_m)
    taxels_n = bed.along[:, rows] @ (pressure_pa @ bed.across[:, columns].T) * bed.cell_area_m2
    taxels_n = taxels_n.reshape(_N_DEPTHS, -1)
    return PressedPad(
        reach_max_m=highest_m, depth_m=depth_m, force_n=taxels_n.sum(axis=1), taxels_n=taxels_n
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Uncertainty:
    """Uncertainty of a virtual grasp: of its motion, foam and sensor."""

    aperture_sd_m: float = 0.2e-3
    """Standard deviation in m of the measured opening, the same over one grasp."""
    slip_n: float = 0.1
    """Largest lag in N behind the set-point before the fingers move on."""
    force_sd: float = 0.02
    """Relative standard deviation of the force at the end of the ramp."""
    modulus_sd: float = 0.475
    gain_sd: float = 0.25
    spread_sd: float = 0.25
    densification_sd: float = 0.5
    thickness_sd: float = 0.15
    """Relative standard deviations of foam and sensor; drawn for each grasp. A name must hold on
    any foam, and foams differ in stiffness most."""
    bend_sd: float = 0.105
    """Standard deviation of the logarithm of an exponent of the reading: a converter whose curve
    differs from its law."""
    lag: float = 0.15
    """Largest share of a reading that follows the force only slowly: foam creeps."""
    noise_sd: float = 0.375
    """Standard deviation of the logarithm of a factor on the noise."""
    pad_gain_sd: float = 0.05
    taxel_gain_sd: float = 0.08
    """Relative standard deviations of the gains of the two pads, and of single taxels."""
    tilt_rad: float = 0.01
    """Standard deviation in rad of an object's tilt between the pads, about x and y."""
    imbalance_n: float = 0.05
    """Largest difference in N between the forces on both pads: the object is held a little."""


_USUAL = Uncertainty()


class VirtualPads:
    """The two gripping pads of a cell and their foam; draws grasps with an uncertainty."""

    def __init__(self, config: CellConfig, uncertainty: Uncertainty) -> None:
        layout = layout_from_config(config.tactile)
        self.pads, self.foam, self.uncertainty = pad_array(layout), usual_foam(config), uncertainty
        self._gripper, self._period_s = config.gripper_settings, config.tactile.frame_period_s
        self._step_m = max(config.mechanics.opening_steps_m())
        self._noise = converter_noise(config)
        # The spread is drawn from few values: their matrices are computed once.
        shares = np.exp(self.uncertainty.spread_sd * np.array([-1.2, -0.4, 0.4, 1.2]))
        self._beds = [
            tuple(PadBed(self.pads, pad, float(spread_m)) for pad in layout.gripping_pads)
            for spread_m in self.foam.spread_m * shares
        ]

    def check(self, drawing: Drawing, steps: Sequence[GraspStep]) -> None:
        """Refuse a drawing that the pads would not detect before the fingers are closed.

        Raises ValueError for the thinnest pose, or if the object lies beside a pad.
        """
        beds, gripper = self._beds[len(self._beds) // 2], self._gripper
        reached = [(reaches_m(drawing, step.pose, beds), step.pose) for step in steps]
        reach_m, pose = min(reached, key=lambda pair: sum(float(r.max()) for r in pair[0]))
        presses = [pressed_pad(bed, r, self.foam) for bed, r in zip(beds, reach_m, strict=True)]
        touch_m = sum(press.reach_max_m for press in presses)
        contact_n = gripper.contact_force_n
        sinks_m = sum(np.interp(contact_n, p.force_n, p.depth_m) for p in presses)
        if touch_m - sinks_m <= gripper.aperture_min_m:
            raise ValueError(
                f"the object is {1e3 * touch_m:.3g} mm thick at {pose}. It sinks into the foam: "
                f"the fingers are closed, at {1e3 * gripper.aperture_min_m:g} mm "
                f"(gripper.aperture_min_mm), before they measure {contact_n:g} N "
                f"(gripper.contact_force_n). Check the unit of the drawing, or turn the object"
            )

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

        The roll of the pose settles on the nearest side that the object rests on. Raises ValueError
        if the object lies beside a pad, or does not fit into the open gripper.
        """
        open_m = self._gripper.aperture_open_m
        foam = self._drawn_foam(rng)
        beds = self._beds[int(rng.integers(len(self._beds)))]
        aslant = rng.normal(0.0, self.uncertainty.tilt_rad, 2).tolist()
        presses = [
            pressed_pad(bed, reach_m, foam)
            for bed, reach_m in zip(beds, reaches_m(drawing, step.pose, beds, aslant), strict=True)
        ]
        upright = reaches_m(drawing, step.pose, beds)
        touch_m = sum(p.reach_max_m for p in presses)
        if touch_m >= open_m:
            raise ValueError(
                f"the object is {1e3 * touch_m:.6g} mm thick at {step.pose}, and the gripper opens "
                f"to {1e3 * open_m:g} mm (gripper.aperture_open_mm). Check the "
                f"unit of the drawing, open wider, or turn the object"
            )
        force_n, setpoint_n, closing_m = self._motion(ramp, touch_m, presses, rng)
        counts, depth_m = self._counts(force_n, beds, presses, foam, rng)
        aperture_m = touch_m - depth_m
        aperture_m[: len(closing_m)] = closing_m
        return Grasp(
            pads=self.pads,
            counts=np.clip(counts, 0.0, self.pads.adc_max),
            t_s=np.arange(len(force_n), dtype=np.float64) * self._period_s,
            aperture_m=self._measured(aperture_m, rng),
            force_n=setpoint_n,
            label=label,
            shape=shape,
            source=DRAWING_SOURCE,
            start_ms=start_ms,
            thickness_m=sum(float(reach_m.max()) for reach_m in upright),
            command=step.command,
            zero=drawn_zero(),
        )

    def _drawn_foam(self, rng: np.random.Generator) -> FoamModel:
        """Return foam and sensor within their uncertainty."""
        uncertainty, foam = self.uncertainty, self.foam
        return replace(
            foam,
            modulus_pa=foam.modulus_pa * rng.lognormal(0.0, uncertainty.modulus_sd),
            gain=foam.gain * rng.lognormal(0.0, uncertainty.gain_sd),
            densification=foam.densification * rng.lognormal(0.0, uncertainty.densification_sd),
            thickness_m=foam.thickness_m * rng.lognormal(0.0, uncertainty.thickness_sd),
        )

    def _motion(
        self,
        ramp: ForceRamp,
        touch_m: float,
        presses: Sequence[PressedPad],
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return force and set-point (n,) in N, and the opening (m,) in m while the fingers close.

        The closing comes first, then the ramp: m is less than n.
        """
        closed_m, impact_n = self._approach(touch_m, presses, rng)
        force_n, setpoint_n = self._force_course(ramp, impact_n, rng)
        closing_m = np.maximum(self._gripper.aperture_open_m - closed_m, 0.0)
        # The object floats: both pads carry the same force.
        shared_n = np.linspace(0.0, min(float(p.force_n[-1]) for p in presses), 4 * _N_DEPTHS)
        depth_sum_m = np.sum([np.interp(shared_n, p.force_n, p.depth_m) for p in presses], axis=0)
        closing_n = np.interp(np.maximum(touch_m - closing_m, 0.0), depth_sum_m, shared_n)
        force_n = np.minimum(np.concatenate([closing_n, force_n]), _LARGEST_SHARE * shared_n[-1])
        return force_n, np.concatenate([np.zeros(len(closed_m)), setpoint_n]), closing_m

    def _counts(
        self,
        force_n: NDArray[np.float64],
        beds: Sequence[PadBed],
        presses: Sequence[PressedPad],
        foam: FoamModel,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return counts (n, n_taxels) with noise, and the depth (n,) in m in both pads together."""
        uncertainty = self.uncertainty
        of_sensor = rng.spawn(1)[0]
        bend = of_sensor.lognormal(0.0, uncertainty.bend_sd)
        lag = uncertainty.lag * of_sensor.uniform()
        creep = -math.expm1(-1.0 / (_SLOW_S / self._period_s))
        shape = len(force_n), self.pads.n_taxels
        noise = self._noise(rng, math.prod(shape)).reshape(shape)
        counts = of_sensor.lognormal(0.0, uncertainty.noise_sd) * noise
        slack_n = 0.5 * uncertainty.imbalance_n * rng.uniform(-1.0, 1.0)
        depth_sum_m = np.zeros(len(force_n))
        for bed, pressed, sign in zip(beds, presses, (1.0, -1.0), strict=True):
            here_n = np.where(force_n > 0.0, np.maximum(force_n + sign * slack_n, 0.0), 0.0)
            depth_m = np.interp(here_n, pressed.force_n, pressed.depth_m)
            depth_sum_m += depth_m
            gains = rng.lognormal(0.0, uncertainty.pad_gain_sd) * np.exp(
                rng.normal(0.0, uncertainty.taxel_gain_sd, len(bed.taxels))
            )
            taxels_n = make_interp_spline(pressed.depth_m, pressed.taxels_n, k=1)(depth_m)
            slowly_n = lfilter([creep], [1.0, creep - 1.0], taxels_n, axis=0)
            taxels_n += lag * (slowly_n - taxels_n)
            counts[:, bed.taxels] += self.pads.adc_max * foam.response(taxels_n * gains) ** bend
        return counts, depth_sum_m

    def _approach(
        self, touch_m: float, presses: Sequence[PressedPad], rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], float]:
        """Return the closing travel in m of each period, and the final force in N."""
        gripper, period_s = self._gripper, self._period_s
        # What stops a finger is a contact from half of that force on.
        contact_n = gripper.contact_force_n
        impact_n = rng.uniform(0.5 * contact_n, contact_n + _IMPACT_N)
        depth_m = sum(float(np.interp(impact_n, p.force_n, p.depth_m)) for p in presses)
        way_m = gripper.aperture_open_m - touch_m + depth_m
        wait_s = rng.uniform(0.01, 0.04)
        # Other parts begin wider: the fingers travel fast up to there.
        travel_m = rng.uniform(0.7, 1.0) * max(0.0, way_m - _SLOW_WAY_M)
        travel_s = travel_m / max(gripper.travel_speed_m_s, gripper.approach_speed_m_s)
        closing_s = travel_s + (way_m - travel_m) / gripper.approach_speed_m_s
        times_s = period_s * np.arange(math.ceil((wait_s + closing_s) / period_s))
        closed_m: NDArray[np.float64] = np.interp(
            times_s - wait_s, [0.0, travel_s, closing_s], [0.0, travel_m, way_m]
        )
        return closed_m, impact_n

    def _force_course(
        self, ramp: ForceRamp, impact_n: float, rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return force and set-point in N in each frame from the start of the ramp."""
        uncertainty, period_s = self.uncertainty, self._period_s
        actual = ramp.starting_from(impact_n)
        n = math.ceil(actual.duration_s / period_s) + int(rng.integers(0, 3))
        setpoint_n = np.array([actual.setpoint_n(period_s * i) for i in range(n)])
        scale = rng.normal(1.0, uncertainty.force_sd)
        force_n = np.empty(n)
        held_n, lag_n = impact_n, uncertainty.slip_n * rng.uniform()
        for i, wanted_n in enumerate(setpoint_n):
            target_n = float(wanted_n) * scale
            over = i >= n - 0.2 / period_s
            if abs(target_n - held_n) > lag_n or over:
                held_n += (0.3 if over else 1.0) * (target_n - held_n)
                lag_n = uncertainty.slip_n * rng.uniform()
            force_n[i] = held_n
        return force_n, setpoint_n

    def _measured(
        self, aperture_m: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Return the opening (n,) in m as the encoders measure it."""
        shift_m = rng.normal(0.0, self.uncertainty.aperture_sd_m)
        phase_m = rng.uniform(0.0, self._step_m)
        steps: NDArray[np.float64] = np.rint((aperture_m + shift_m - phase_m) / self._step_m)
        return steps * self._step_m + phase_m


@one_blas_thread()
def teach_drawing(
    config: CellConfig,
    label: str,
    drawing: Drawing,
    n_grasps: int,
    *,
    kind: str = "",
    uncertainty: Uncertainty = _USUAL,
    seed: int = 0,
    start_ms: int = 0,
    progress: Progress = silent,
) -> list[Grasp]:
    """Grasp a drawing ``n_grasps`` times as the cell would, at the poses and forces of its plan.

    Raises ConfigError if the object does not fit between the open pads, is too thin to be touched,
    or lies beside them.

    Parameters
    ----------
    config
        The cell: pads, speeds, ramp, plan.
    label, drawing, kind
        Name, shape and class of shape of the object.
    uncertainty
        Of motion, foam and sensor.
    seed
        Of poses, forces, noise and all uncertain values.
    start_ms
        Time of the first grasp; each next grasp is a second later.
    """
    virtual = VirtualPads(config, uncertainty)
    rng = np.random.default_rng([seed, 1])
    grasps: list[Grasp] = []
    steps = plan(config.sequence, n_grasps, seed=seed)
    for number, step in enumerate(steps):
        with raised_as(ConfigError, ValueError, where=f"{label} cannot be grasped"):
            if not grasps:
                virtual.check(drawing, steps)
            grasp = virtual.grasp(
                drawing,
                step,
                config.sequence.ramp.to(step.force_n),
                rng,
                label=label,
                shape=kind,
                start_ms=start_ms + 1000 * number,
            )
        grasps.append(grasp)
        progress(f"draw {label}", len(grasps), n_grasps)
    return grasps
