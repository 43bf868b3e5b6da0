"""Foam and sensor of a cell: calibrated on a gauge object, or the usual ones."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.config.model import CellConfig
from cell.config.tactile import PaperCalibrationConfig, layout_from_config, make_calibration
from cell.control.records import pad_array
from cell.errors import CellError, ConfigError, raised_as
from cell.learning.blas import one_blas_thread
from cell.recording.dataset import read_grasps
from cell.simulation import drawn_shape
from recognition.drift.self_zero import common_zero, drawn_zero
from recognition.errors import ContactError
from recognition.grasp import Grasp, PadArray, SelfZero
from recognition.ramp.ramp import find_ramp, learn_rest
from recognition.shape.foam import FoamModel
from recognition.shape.foam_fit import FoamFit, fit_foam
from recognition.shape.models import Drawing
from recognition.shape.residuals import PadUncertainty

_UNKNOWN_SD = 0.1
"""Relative standard deviation of modulus, gain and spread of a foam without a gauge."""
_LEAST_SD = 0.03
"""Smallest relative standard deviation after a gauge: the best result of a few grasps."""
_OTHER_FOAMS = 2.5
"""Factor on the deviations of virtual grasps without a gauge."""
_OTHER_THAN_GAUGED = 0.3
"""Share of the spread between foams that remains for a shape fit after a gauge."""
_OTHER_THAN_ONE_SHAPE = 1.4
"""Factor on the deviations of virtual grasps after a gauge with its single shape."""
_DEPTH_SD_M = 0.2e-3
"""Difference in m between the zeros that two shapes give."""
_MIN_QUIET = 5
"""Number of frames of the untouched pads that suffice as a source of noise."""
_BAD_MISFIT = 2.5
"""Misfit of a gauge, where 1 is the noise, above which its shape is doubtful."""
_BAD_FIT = " where 1 is the noise: is this the gauge's shape? The model does not fit these pads"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PadKnowledge:
    """Foam and sensor with their uncertainties, from a gauge or the usual ones."""

    foam: FoamModel
    """Foam and sensor."""
    modulus_sd: float = _UNKNOWN_SD
    gain_sd: float = _UNKNOWN_SD
    spread_sd: float = _UNKNOWN_SD
    densification_sd: float = 2.0 * _UNKNOWN_SD
    thickness_sd: float = 0.6 * _UNKNOWN_SD
    """Relative standard deviations."""
    other_foams: float = _OTHER_FOAMS
    """Factor on these deviations for virtual grasps. Without a gauge a name must hold on any foam,
    and a grasp on another foam is not an unknown object. A gauge has one shape only; other shapes
    differ from its foam model by more than its deviations."""
    aperture_sd_m: float = 0.2e-3
    """Standard deviation in m of the measured opening."""
    zero: SelfZero = field(default_factory=drawn_zero)
    """Self-zero to which the openings refer: of the gauge's grasps, else nominal."""
    rest: NDArray[np.uint16] | None = None
    """(n, n_taxels) uint16 or None: frames of the untouched pads; None without a gauge."""
    fit: FoamFit | None = None
    """The calibration; None without a gauge."""

    @property
    def trust(self) -> PadUncertainty:
        """Uncertainties of foam and sensor for fits of shapes."""
        return PadUncertainty(
            modulus=self.modulus_sd,
            gain=self.gain_sd,
            spread=self.spread_sd,
            stiffening=self.densification_sd,
            aperture_m=self.aperture_sd_m,
            other_foams=1.0 if self.fit is None else _OTHER_THAN_GAUGED,
            misfit=0.0 if self.fit is None else self.fit.misfit,
        )

    def as_dict(self) -> dict[str, Any]:
        """Return plain data, units in the names."""
        values: dict[str, Any] = {"foam": self.foam.as_dict()}
        if self.fit is not None:
            values |= {
                "n_grasps": self.fit.n_grasps,
                "misfit": self.fit.misfit,
                "modulus_sd": float(self.fit.sd[0]),
                "gain_sd": float(self.fit.sd[1]),
                "aperture_sd_mm": float(self.fit.sd[3]),
            }
        return values

    def __str__(self) -> str:
        foam = self.foam
        text = (
            f"foam {1e-3 * foam.modulus_pa:.0f} kPa, spread {1e3 * foam.spread_m:.2f} mm, "
            f"sensor gain {foam.gain:.3f}, opening {1e3 * foam.aperture_offset_m:+.2f} mm"
        )
        if foam.nodes is not None:
            text += f", full scale at {foam.nodes[0][-1]:.3g} N a taxel"
        if self.fit is None:
            return f"{text}: not calibrated, add --gauge"
        modulus, gain, _, aperture, _ = self.fit.sd
        return (
            f"{text} (modulus and gain within {100 * modulus:.0f} and {100 * gain:.0f} %, opening "
            f"within {aperture:.2f} mm), from {self.fit.n_grasps} grasps, misfit "
            f"{self.fit.misfit:.1f}" + (_BAD_FIT if self.fit.misfit > _BAD_MISFIT else "")
        )


def usual_foam(config: CellConfig) -> FoamModel:
    """Return the usual foam on a sensor with the config's law from force to counts."""
    layout, law = layout_from_config(config.tactile), config.tactile.calibration
    if isinstance(law, PaperCalibrationConfig):
        return FoamModel(gain=1.0 / law.gain)
    one_law = config.tactile.model_copy(update={"pad_gains": (1.0, 1.0)})
    counts = np.unique([0.0, *getattr(law, "counts", ()), layout.adc_max])
    counts = counts[counts <= layout.adc_max]
    force_n = make_calibration(one_law, layout).force_n(counts)
    return FoamModel(nodes=(tuple(force_n), tuple(counts / layout.adc_max)))


def gauge_shape(grasps: Sequence[Grasp], text: str | None, config: CellConfig) -> Drawing:
    """Return the shape of the gauge: as given, else the configured object with the grasps' label.

    Raises CellError if the grasps are of several objects, or their shape is not known.
    """
    labels = sorted({grasp.label for grasp in grasps})
    if len(labels) > 1:
        raise CellError(f"a gauge is one object, these grasps are of {', '.join(labels)}")
    if text is not None:
        return drawn_shape(text)
    for entry in config.simulator.objects:
        if entry.label == labels[0]:
            return drawn_shape(entry.shape)
    raise CellError(f"the shape of the gauge {labels[0]!r} is not known: add --gauge-shape")


@one_blas_thread()
def calibrate_on_gauge(
    grasps: Sequence[Grasp], drawing: Drawing, pads: PadArray, foam: FoamModel | None = None
) -> PadKnowledge:
    """Fit stiffness and gain to grasps of a known object.

    ``pads`` are those of the cell; ``foam`` is the start of the fit, equation (11) by default.
    Raises CellError if the grasps were taken on other pads, or are too few.
    """
    if not grasps[0].pads.same_as(pads):
        raise CellError(
            f"the gauge was grasped on {grasps[0].pads.n_taxels} taxels, this cell has "
            f"{pads.n_taxels}: grasp it on this cell"
        )
    with raised_as(CellError, ContactError, where="the gauge cannot be used"):
        fit = fit_foam(grasps, drawing, foam)
    modulus_sd, gain_sd, spread_sd, aperture_sd_mm, stiffening_sd = (float(sd) for sd in fit.sd)
    aperture_sd_m = math.hypot(max(0.2e-3, 1e-3 * aperture_sd_mm, fit.opening_sd_m), _DEPTH_SD_M)
    return PadKnowledge(
        foam=fit.foam,
        modulus_sd=max(modulus_sd, _LEAST_SD),
        gain_sd=max(gain_sd, _LEAST_SD),
        spread_sd=max(spread_sd, _LEAST_SD),
        densification_sd=max(stiffening_sd, 2.0 * _LEAST_SD),
        thickness_sd=_LEAST_SD,
        other_foams=_OTHER_THAN_ONE_SHAPE,
        aperture_sd_m=aperture_sd_m,
        zero=common_zero(grasps) or drawn_zero(fit.foam.aperture_offset_m, aperture_sd_m),
        rest=_rest_frames(grasps),
        fit=fit,
    )


def pad_knowledge(config: CellConfig, gauge: Path | None, gauge_text: str | None) -> PadKnowledge:
    """Return foam and sensor from a gauge, or the usual ones without a gauge.

    The gauge is a data set or recording of grasps of one known object; its shape is by default that
    of the configured object with their label. Raises ConfigError if a shape is invalid or given
    without grasps, and CellError if the grasps cannot be read, or are too few.
    """
    foam = usual_foam(config)
    if gauge is None:
        if gauge_text is not None:
            raise ConfigError("--gauge-shape describes the gauge; name its grasps with --gauge")
        return PadKnowledge(foam=foam)
    grasps = read_grasps(gauge)
    drawing = gauge_shape(grasps, gauge_text, config)
    pads = pad_array(layout_from_config(config.tactile))
    return calibrate_on_gauge(grasps, drawing, pads, foam)


def _rest_frames(grasps: Sequence[Grasp]) -> NDArray[np.uint16] | None:
    """Return the frames before the touch of all grasps; None if they are too few."""
    rest = learn_rest(grasps)
    parts = []
    for grasp in grasps:
        ramp = find_ramp(grasp, rest)
        parts.append(grasp.counts[: max(0, int(ramp.touch.min()) - ramp.smoothing)])
    frames: NDArray[np.uint16] = np.concatenate(parts)
    return frames if len(frames) >= _MIN_QUIET else None
