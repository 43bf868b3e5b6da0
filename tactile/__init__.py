"""The tactile sensor: taxels, CAN transport, node supervision, force; no servos, no objects."""
