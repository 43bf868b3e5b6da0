"""Figures of the recogniser, shape and size, sequences and drift that README and docs quote."""
