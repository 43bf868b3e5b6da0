"""A servo on a bench, measured with an arm and a kitchen scale: protocol, log, result."""
