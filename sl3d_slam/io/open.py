"""One way in: a path becomes a Dataset, or one scan file becomes points."""

from pathlib import Path

from sl3d_slam.config import InputSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.io.bags import BAG_METADATA, BAG_SUFFIXES, open_bag
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.io.folder import SUFFIXES, open_folder, read_cloud
from sl3d_slam.io.kitti import is_kitti, is_real_hdl64, open_kitti
from sl3d_slam.io.points import corrected, elevation_offset_deg, usable

KINDS = ("auto", "kitti", "generic", "mcap", "rosbag")
_EXPECTED = (
    "a KITTI dataset (sequences/SS/velodyne), a folder of .bin, .pcd or .ply scans, "
    "a rosbag2 folder, or a .mcap, .db3 or .bag file"
)


def open_dataset(
    path: Path,
    settings: InputSettings,
    dataset: str = "auto",
    sequence: str | None = None,
    topic: str | None = None,
) -> Dataset:
    """Open any input that this package reads; nothing but tables and headers is read yet.

    Parameters
    ----------
    path : a KITTI root or sequence, a folder of scans, a bag.
    settings : how scans are filtered and corrected.
    dataset : one of ``auto``, ``kitti``, ``generic``, ``mcap``, ``rosbag``.
    sequence : which KITTI sequence, such as ``00``.
    topic : which PointCloud2 topic of a bag, needed only where it has several.

    Raises
    ------
    InputError
        naming the file or folder and what was expected there.
    """
    if dataset not in KINDS:
        raise InputError(f"{dataset}: unknown kind of dataset; expected one of {', '.join(KINDS)}")
    try:
        if not path.exists():
            raise InputError(f"{path}: not found; expected {_EXPECTED}")
        kind = detect(path) if dataset == "auto" else dataset
        _refuse_foreign_options(path, kind, sequence, topic)
        return _open_kind(path, kind, sequence, topic, settings)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def _refuse_foreign_options(path: Path, kind: str, sequence: str | None, topic: str | None) -> None:
    if sequence is not None and kind != "kitti":
        raise InputError(f"{path}: is a {kind} dataset without sequences; leave --sequence out")
    if topic is not None and kind not in ("mcap", "rosbag"):
        raise InputError(f"{path}: is a {kind} dataset without topics; leave the topic out")


def _open_kind(
    path: Path, kind: str, sequence: str | None, topic: str | None, settings: InputSettings
) -> Dataset:
    match kind:
        case "kitti":
            return open_kitti(path, sequence, settings)
        case "generic":
            return open_folder(path, elevation_offset_deg(settings, lambda: False), settings)
    return open_bag(path, topic, settings)


def detect(path: Path) -> str:
    """Tell what kind of dataset lies at a path. Raises InputError where it is none."""
    if path.is_file():
        if path.suffix.lower() not in BAG_SUFFIXES:
            raise InputError(f"{path}: is not a dataset; expected {_EXPECTED}")
        return "mcap" if path.suffix.lower() == ".mcap" else "rosbag"
    if is_kitti(path):
        return "kitti"
    suffixes = {p.suffix.lower() for p in path.iterdir()}
    if (path / BAG_METADATA).is_file() or suffixes & set(BAG_SUFFIXES):
        return "rosbag"
    if suffixes & set(SUFFIXES):
        return "generic"
    raise InputError(f"{path}: holds no scans; expected {_EXPECTED}")


def read_scan(path: Path, settings: InputSettings) -> Points:
    """Return the (N, 3) metres of one ``.bin``, ``.pcd`` or ``.ply`` file in the sensor frame.

    Filtered as in a sequence; a scan that lies in a KITTI sequence is corrected as there.

    Raises
    ------
    InputError
        naming the file where it is missing, damaged or has fewer than 100 usable points.
    """
    cloud = read_cloud(path)
    offset_deg = elevation_offset_deg(
        settings, lambda: is_kitti(path.parent) and is_real_hdl64(path.parent.parent, cloud.points)
    )
    points = corrected(cloud, offset_deg).points
    return points[usable(points, settings, str(path))]
