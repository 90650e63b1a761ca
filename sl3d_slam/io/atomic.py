"""The run folder and whole files, as :mod:`sl3d_slam.files` defines them for every stage."""

from sl3d_slam.files import prepare_run_folder, write_whole

__all__ = ["prepare_run_folder", "write_whole"]
