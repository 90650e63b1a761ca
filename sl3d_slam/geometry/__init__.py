"""Rigid transforms and line segments, in plain numpy."""
