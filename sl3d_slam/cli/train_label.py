"""``sl3d train label``."""

from sl3d_slam.errors import MissingExtraError


def label() -> None:
    """Not part of this version yet."""
    raise MissingExtraError("sl3d train label is not part of this version yet")
