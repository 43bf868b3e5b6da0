"""Teaching from a drawing: virtual grasps, equal to those of the cell."""

import math

import numpy as np
from numpy.typing import NDArray

from cell.config.gripper import ParallelLinkageConfig
from cell.config.model import CellConfig
from cell.config.sequence import ramp_from_config
from cell.config.tactile import layout_from_config
from cell.control.plan import plan
from cell.control.records import pad_array
from cell.errors import CellError, raised_as
from cell.learning.blas import one_blas_thread
from cell.learning.pad_knowledge import PadKnowledge, usual_foam
from cell.learning.progress import Progress, silent
from cell.learning.virtual_grasps import Course, Noise, VirtualPads
from cell.simulation import converter_noise
from recognition.grasp import Grasp, PadArray
from recognition.shape.models import Drawing

_PULSES = 4096
_MODULUS_FURTHER = 2.5
"""Foams differ in stiffness more than in anything else."""
_BEND, _LAG, _NOISE = 0.7, 1.0, 2.5
"""Uncertainty of converter, slowness of the foam and noise, relative to that of the gain."""


@one_blas_thread()
def teach_drawing(
    config: CellConfig,
    label: str,
    drawing: Drawing,
    n_grasps: int,
    *,
    kind: str = "",
    known: PadKnowledge | None = None,
    seed: int = 0,
    start_ms: int = 0,
    progress: Progress = silent,
) -> list[Grasp]:
    """Grasp a drawing ``n_grasps`` times as the cell would, at the poses and forces of its plan.

    Raises CellError if the object does not fit between the open pads, is too thin to be felt, or
    lies beside them.

    Parameters
    ----------
    config
        The cell: pads, speeds, ramp, plan.
    label, drawing, kind
        Name, shape and class of shape of the object.
    known
        Foam and sensor; by default the usual ones, under the config's law.
    seed
        Of poses, forces, noise and all uncertain values.
    start_ms
        Time of the first grasp; each next grasp is a second later.
    """
    known = known or PadKnowledge(foam=usual_foam(config))
    layout = layout_from_config(config.tactile)
    pads = pad_array(layout)
    first, second = layout.gripping_pads
    virtual = VirtualPads(
        pads=pads,
        gripping=(first, second),
        foam=known.foam,
        course=course_of(config, known),
        noise=_noise(config, pads, known.rest),
        zero=known.zero,
    )
    rng = np.random.default_rng([seed, 1])
    grasps: list[Grasp] = []
    steps = plan(config.sequence, n_grasps, seed=seed)
    for number, step in enumerate(steps):
        with raised_as(CellError, ValueError, where=f"{label} cannot be grasped"):
            if not grasps:
                virtual.check(drawing, steps)
            grasp = virtual.grasp(
                drawing,
                step,
                ramp_from_config(config.sequence.ramp, step.force_n),
                rng,
                label=label,
                shape=kind,
                start_ms=start_ms + 1000 * number,
            )
        grasps.append(grasp)
        progress(f"draw {label}", len(grasps), n_grasps)
    return grasps


def course_of(config: CellConfig, known: PadKnowledge) -> Course:
    """Return the motion of the configured cell."""
    drive, settings = config.gripper.linkage, config.gripper_settings
    arm_mm = drive.link_mm if isinstance(drive, ParallelLinkageConfig) else drive.pinion_radius_mm
    step_mm = arm_mm * math.tau / _PULSES * (2 if len(config.gripper.servos) == 1 else 1)
    further = max(known.other_foams - 1.0, 0.0)
    return Course(
        period_s=config.tactile.frame_period_s,
        aperture_open_m=settings.aperture_open_m,
        aperture_min_m=settings.aperture_min_m,
        approach_speed_m_s=settings.approach_speed_m_s,
        travel_speed_m_s=settings.travel_speed_m_s,
        aperture_step_m=1e-3 * step_mm,
        aperture_sd_m=known.aperture_sd_m,
        # What stops a finger is a contact from half of that force on.
        contact_n=settings.contact_force_n,
        impact_n=(0.5 * settings.contact_force_n, settings.contact_force_n + 0.3),
        modulus_sd=(1.0 + _MODULUS_FURTHER * further) * known.modulus_sd,
        gain_sd=known.other_foams * known.gain_sd,
        spread_sd=known.other_foams * known.spread_sd,
        densification_sd=known.other_foams * known.densification_sd,
        thickness_sd=known.other_foams * known.thickness_sd,
        bend_sd=_BEND * further * known.gain_sd,
        lag=_LAG * further * known.gain_sd,
        noise_sd=_NOISE * further * known.gain_sd,
    )


def _noise(config: CellConfig, pads: PadArray, rest: NDArray[np.uint16] | None) -> Noise:
    """Return the noise: of the gauge's untouched frames, else that of the simulated cell."""
    if rest is not None:
        frames = rest.astype(np.float64)
        return lambda rng, n_frames: frames[rng.integers(len(frames), size=n_frames)]
    converter = converter_noise(config)
    return lambda rng, n_frames: converter(rng, n_frames * pads.n_taxels).reshape(n_frames, -1)
