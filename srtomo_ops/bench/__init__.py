"""Benchmarks: no number is shown before what was computed has been checked in the same run."""
