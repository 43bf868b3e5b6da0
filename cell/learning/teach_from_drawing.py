"""Teaching from a drawing: virtual grasps, equal to those of the cell."""

import math

import numpy as np

from cell.config.gripper import ParallelLinkageConfig
from cell.config.model import CellConfig
from cell.config.sequence import ramp_from_config
from cell.config.tactile import layout_from_config
from cell.control.plan import plan
from cell.control.records import pad_array
from cell.errors import CellError, raised_as
from cell.learning.blas import one_blas_thread
from cell.learning.progress import Progress, silent
from cell.learning.shape_reading import usual_foam
from cell.learning.virtual_grasps import Course, Noise, VirtualPads
from cell.simulation import converter_noise
from recognition.grasp import Grasp, PadArray
from recognition.shape.models import Drawing

_PULSES = 4096


@one_blas_thread()
def teach_drawing(
    config: CellConfig,
    label: str,
    drawing: Drawing,
    n_grasps: int,
    *,
    kind: str = "",
    course: Course | None = None,
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
    course
        Motion with all uncertainties; by default the usual one of the cell.
    seed
        Of poses, forces, noise and all uncertain values.
    start_ms
        Time of the first grasp; each next grasp is a second later.
    """
    layout = layout_from_config(config.tactile)
    pads = pad_array(layout)
    first, second = layout.gripping_pads
    virtual = VirtualPads(
        pads=pads,
        gripping=(first, second),
        foam=usual_foam(config),
        course=course or course_of(config),
        noise=_noise(config, pads),
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


def course_of(config: CellConfig) -> Course:
    """Return the motion of the configured cell."""
    drive, settings = config.gripper.linkage, config.gripper_settings
    arm_mm = drive.link_mm if isinstance(drive, ParallelLinkageConfig) else drive.pinion_radius_mm
    step_mm = arm_mm * math.tau / _PULSES * (2 if len(config.gripper.servos) == 1 else 1)
    return Course(
        period_s=config.tactile.frame_period_s,
        aperture_open_m=settings.aperture_open_m,
        aperture_min_m=settings.aperture_min_m,
        approach_speed_m_s=settings.approach_speed_m_s,
        travel_speed_m_s=settings.travel_speed_m_s,
        aperture_step_m=1e-3 * step_mm,
        # What stops a finger is a contact from half of that force on.
        contact_n=settings.contact_force_n,
        impact_n=(0.5 * settings.contact_force_n, settings.contact_force_n + 0.3),
    )


def _noise(config: CellConfig, pads: PadArray) -> Noise:
    """Return the noise of the simulated cell."""
    converter = converter_noise(config)
    return lambda rng, n_frames: converter(rng, n_frames * pads.n_taxels).reshape(n_frames, -1)
