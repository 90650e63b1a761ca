"""Scans in, run folder out: every file format this package reads or writes."""
