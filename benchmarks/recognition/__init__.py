"""Figures of the recognizer, shape and size, sequences and drift that README and docs quote."""
