"""From the config's ramp to the gripper's force ramp."""

from cell.config_sequence import LinearRampConfig, SCurveRampConfig, StaircaseRampConfig
from gripper.ramp import ForceRamp


def force_ramp(
    config: LinearRampConfig | StaircaseRampConfig | SCurveRampConfig, force_n: float
) -> ForceRamp:
    """Return the ramp of the configured shape that ends at ``force_n`` N."""
    match config:
        case LinearRampConfig():
            return ForceRamp.linear(force_n, rate_n_s=config.rate_n_s, hold_s=config.hold_s)
        case StaircaseRampConfig():
            levels_n = tuple(force_n * (i + 1) / config.n_levels for i in range(config.n_levels))
            return ForceRamp.staircase(levels_n, rate_n_s=config.rate_n_s, hold_s=config.hold_s)
        case SCurveRampConfig():
            return ForceRamp.s_curve(force_n, duration_s=config.duration_s, hold_s=config.hold_s)
