"""Constraints to poses: outlier tests, iSAM2, the final optimisation, g2o files."""
