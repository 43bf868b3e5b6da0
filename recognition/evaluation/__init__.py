"""Evaluation of recognisers: splits in time, accuracy with intervals, unknown objects."""
