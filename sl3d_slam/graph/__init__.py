"""Constraints in, poses out; the only import of gtsam beside the front end."""
