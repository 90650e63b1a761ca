"""``sl3d train synthetic``."""

from sl3d_slam.errors import MissingExtraError


def synthetic() -> None:
    """Not part of this version yet."""
    raise MissingExtraError("sl3d train synthetic is not part of this version yet")
