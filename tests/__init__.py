"""Tests of all packages; a package itself so that `tests.faults` can be run from a checkout."""
