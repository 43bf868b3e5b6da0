"""Mechanics between servos and fingers: `kinematics` (angle, opening, force), `impact` (speed)."""
