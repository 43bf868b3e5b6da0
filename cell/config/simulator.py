"""Config of the simulated cell: objects, noise, faults."""

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from cell.config.section import Section, refuse_repeats
from cell.files import checked_label


class SimulatedObjectConfig(Section):
    """One object of the simulated cell."""

    label: Annotated[str, AfterValidator(checked_label)] = Field(min_length=1, max_length=60)
    """Name of the object."""
    shape: str = Field(min_length=1, max_length=500)
    """Shape, for example `cylinder:diameter=6mm,length=20mm` or `mesh:file=part.stl`."""


Share = Annotated[float, Field(ge=0.1, le=10.0)]
Shift = Annotated[float, Field(ge=-5.0, le=5.0)]
Tilt = Annotated[float, Field(ge=-10.0, le=10.0)]


class SimulatedPadsConfig(Section):
    """Position of the two gripping pads of the simulated cell, and their differences."""

    shift_mm: tuple[Shift, Shift] = (0.0, 0.0)
    """Offset of finger 1's pad from finger 0's, along and across the fingers, in mm, -5 to 5."""
    tilt_deg: tuple[Tilt, Tilt] = (0.0, 0.0)
    """Angle between the pads along and across the fingers, positive where the gap closes, in
    degrees, -10 to 10."""
    gains: tuple[Share, Share] = (1.0, 1.0)
    """Factors on the measured force of the taxels of finger 0 and finger 1, 0.1 to 10."""
    stiffness: tuple[Share, Share] = (1.0, 1.0)
    """Factors on the stiffness of the foam of finger 0 and finger 1, 0.1 to 10."""


class SimulatedServosConfig(Section):
    """The simulated servos: typical ones, drawn from the spread of their model, or given."""

    gearing: Literal["typical", "drawn", "ideal"] = "drawn"
    """Torque and friction: a typical servo, servos drawn by the seed from the spread of real ones,
    or figures of the data sheet without noise."""
    friction: tuple[Share, Share] = (1.0, 1.0)
    """Factors on the friction without load of the servo of finger 0 and finger 1, 0.1 to 10."""
    kt: tuple[Share, Share] = (1.0, 1.0)
    """Factors on torque and back-EMF of their motors, 0.1 to 10."""
    overload: Literal["duty", "current", "following_error"] = "duty"
    """Rule of their overload protection, which the vendor has not published: what must stay high
    for seconds until a servo switches its torque off."""


class SimulatorConfig(Section):
    """The simulated cell; used only with a `simulated` port, or by `simulate`."""

    objects: tuple[SimulatedObjectConfig, ...] = Field(
        default=(
            SimulatedObjectConfig(label="oval", shape="ellipsoid:length=14mm,diameter=11.7mm"),
            SimulatedObjectConfig(label="cylinder", shape="cylinder:diameter=6mm,length=20mm"),
            SimulatedObjectConfig(label="box", shape="box:length=15.9mm,width=10mm,height=10mm"),
            SimulatedObjectConfig(label="ball", shape="sphere:diameter=9.5mm"),
            SimulatedObjectConfig(label="dumbbell", shape="dumbbell:length=13mm,diameter=10mm"),
        ),
        min_length=1,
        max_length=1000,
    )
    """Objects for grasps; default: the five objects of the paper."""
    noise_level: float = Field(default=1.0, ge=0.0, le=2.5)
    """Factor on the noise of each taxel and frame, 0 to 2.5; 1: as in the paper, a normal value
    clipped to 1 to 20 of 255."""
    pads: SimulatedPadsConfig = SimulatedPadsConfig()
    """Position and differences of the pads; the fault `servo1.horn=20` moves the opening's zero."""
    servos: SimulatedServosConfig = SimulatedServosConfig()
    """The servos."""
    faults: tuple[Annotated[str, Field(min_length=1, max_length=200)], ...] = Field(
        default=(), max_length=100
    )
    """Faults, for example `can.loss=0.05@2s`; `tactile-cell simulate --list-faults` lists all."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        refuse_repeats((entry.label for entry in self.objects), "labels of simulator.objects")
        return self
