"""Evaluation of recognizers: splits in time, accuracy with intervals, unknown objects."""
