"""Whole files, where the input and output stages look for them; see :mod:`sl3d_slam.files`."""

from sl3d_slam.files import prepare_run_folder, write_whole

__all__ = ["prepare_run_folder", "write_whole"]
