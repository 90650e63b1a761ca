"""What many tests share: a seeded generator, the repository's root, real scans where present."""

from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def rng():
    return np.random.default_rng(20240607)


@pytest.fixture(scope="session")
def repository():
    """The checkout that holds configs/ and examples/; the package itself may be installed apart."""
    return Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared(repository):
    """The folder of real scans and true trajectories beside the checkout, which few people have."""
    folder = repository.parent / "shared"
    if not (folder / "data" / "README.md").is_file():
        pytest.skip("needs the real scans of ../shared, which are not here")
    return folder
