"""Other systems to compare with: optional, and named with the way to install them when absent."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata

from sl3d_slam.errors import MissingExtraError

INSTALL = "pip install 'sl3d-slam[bench]'"
DEBIAN_PACKAGES = {
    "libusb-1.0": "libusb-1.0-0",
    "libGL.": "libgl1",
    "libgomp.": "libgomp1",
    "libX11.": "libx11-6",
    "libEGL.": "libegl1",
}
DISTRIBUTIONS = ("kiss-icp", "kiss-slam", "map-closures", "kiss-matcher", "open3d")
_SYSTEM_LIBRARY = re.compile(r"(lib[\w+.-]*?\.so[\d.]*)")


@contextmanager
def importing(peer: str) -> Iterator[None]:
    """Import a peer in the body; what is missing becomes a sentence that says how to get it.

    Raises
    ------
    MissingExtraError
        naming the pip extra, and the Debian package where a system library is absent.
    """
    try:
        yield
    except (ImportError, OSError) as error:
        raise MissingExtraError(explain_absence(peer, error)) from None


def explain_absence(peer: str, error: Exception) -> str:
    """Return one sentence: what is missing for a peer and how to install it."""
    library = _SYSTEM_LIBRARY.search(str(error))
    if library is not None and "cannot open shared object" in str(error):
        name = library.group(1)
        package = next((p for key, p in DEBIAN_PACKAGES.items() if name.startswith(key)), None)
        how = f"apt-get install {package}" if package else "your system's package manager"
        return (
            f"{peer}: the system library {name} is missing; install it with {how} "
            f"(the peers themselves with {INSTALL})"
        )
    module = getattr(error, "name", None)
    if isinstance(error, ModuleNotFoundError) and module:
        return f"{peer}: the Python module {module} is not installed; {INSTALL}"
    return f"{peer}: cannot be imported ({error}); {INSTALL}"


def installed_peers() -> str:
    """Return name and version of every peer that is installed, as one line."""
    found = []
    for name in DISTRIBUTIONS:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            found.append(f"{name} not installed")
    return ", ".join(found)
