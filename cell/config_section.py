"""What all sections of the configuration have in common."""

from pydantic import BaseModel, ConfigDict

SIMULATED = "simulated"
"""Port or interface name that wires in the simulated cell; nothing else ever does."""


class Section(BaseModel):
    """A part of the configuration: strict, frozen, finite numbers, no unknown keys."""

    model_config = ConfigDict(
        strict=True,
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )
