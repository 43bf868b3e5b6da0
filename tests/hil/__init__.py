"""Real processes over pseudo-terminals, in real time."""
