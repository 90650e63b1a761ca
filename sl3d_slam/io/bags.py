"""rosbag2 folders (sqlite3 and MCAP), bare .mcap and .db3 files, and rosbag1, by rosbags.

Only PointCloud2 is decoded, with its standard definition: it has been the same in every ROS
release, so other message types of a bag cannot stand in the way.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_typestore

from sl3d_slam.config import InputSettings
from sl3d_slam.errors import InputError
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.io.point_cloud2 import cloud_from_message
from sl3d_slam.io.points import make_scan
from sl3d_slam.types import Scan

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
BAG_SUFFIXES = (".mcap", ".db3", ".bag")
BAG_METADATA = "metadata.yaml"
EXPECTED = "a whole rosbag2 folder, .mcap, .db3 or .bag file"

Decoder = Callable[[bytes], Any]


def open_bag(path: Path, topic: str | None, settings: InputSettings) -> Dataset:
    """Open the PointCloud2 messages of one topic; each becomes a scan, in the order of the log.

    The stamp of a scan is that of its header, or the time of the log where the header has none.

    Raises
    ------
    InputError
        naming the bag where it is damaged or cut off, has no such topic, or, with ``topic`` None,
        has none or several; the text then lists what there is.
    """
    bag = _find_bag(path)
    counts = _count_messages(bag)
    chosen = _choose_topic(path, counts, topic)
    return Dataset(
        name=path.stem,
        description=f"bag {path}, topic {chosen} ({counts[chosen]} scans)",
        num_scans=counts[chosen],
        read_scans=_BagScans(bag, chosen, settings),
    )


@dataclass(frozen=True, slots=True)
class _BagScans:
    bag: Path
    topic: str
    settings: InputSettings

    def __call__(self, start: int, stop: int) -> Iterator[Scan]:
        decode = _decoder(self.bag)
        for index, (log_time_ns, raw) in enumerate(
            islice(_raw_messages(self.bag, self.topic), start, stop), start
        ):
            source = f"{self.bag}: message {index} on {self.topic}"
            yield _to_scan(index, log_time_ns, _decoded(decode, raw, source), self.settings, source)


def _to_scan(
    index: int, log_time_ns: int, message: Any, settings: InputSettings, source: str
) -> Scan:
    stamp = message.header.stamp
    stamp_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    position = (index, (stamp_ns or log_time_ns) * 1e-9)
    return make_scan(position, cloud_from_message(message, source), settings, source)


def _reader(bag: Path) -> Any:
    return Reader1(bag) if bag.suffix == ".bag" else Reader2(bag)


def _decoder(bag: Path) -> Decoder:
    if bag.suffix == ".bag":
        ros1 = get_typestore(Stores.ROS1_NOETIC)
        return lambda raw: ros1.deserialize_ros1(raw, POINT_CLOUD)
    ros2 = get_typestore(Stores.ROS2_HUMBLE)
    return lambda raw: ros2.deserialize_cdr(raw, POINT_CLOUD)


def _decoded(decode: Decoder, raw: bytes, source: str) -> Any:
    try:
        return decode(raw)
    except Exception as error:  # rosbags lets struct, index and value errors through
        raise InputError(f"{source}: is not a whole PointCloud2 message") from error


def _count_messages(bag: Path) -> dict[str, int]:
    """Return how many messages each PointCloud2 topic has."""
    counts: dict[str, int] = {}
    try:
        with _reader(bag) as reader:
            for connection in reader.connections:
                if connection.msgtype == POINT_CLOUD:
                    counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
    except Exception as error:  # rosbags lets struct, sqlite and type errors through
        raise _damaged(bag, error) from error
    return counts


def _raw_messages(bag: Path, topic: str) -> Iterator[tuple[int, bytes]]:
    """Stream the log time in nanoseconds and the bytes of every message of a topic."""
    try:
        with _reader(bag) as reader:
            chosen = [
                c for c in reader.connections if c.topic == topic and c.msgtype == POINT_CLOUD
            ]
            for _, log_time_ns, raw in reader.messages(connections=chosen):
                yield log_time_ns, raw
    except Exception as error:  # rosbags lets struct, sqlite and type errors through
        raise _damaged(bag, error) from error


def _damaged(bag: Path, error: Exception) -> InputError:
    reason = " ".join(str(error).split()) or type(error).__name__
    return InputError(f"{bag}: cannot be read as a bag ({reason}); expected {EXPECTED}")


def _find_bag(path: Path) -> Path:
    """Return what rosbags opens: a file, a folder with metadata, or the only bag in a folder."""
    if path.is_file() or (path / BAG_METADATA).is_file():
        return path
    found = sorted(p for p in path.iterdir() if p.suffix in BAG_SUFFIXES)
    if len(found) != 1:
        names = ", ".join(p.name for p in found) or "none"
        raise InputError(
            f"{path}: expected {BAG_METADATA} or exactly one .mcap, .db3 or .bag, found {names}"
        )
    return found[0]


def _choose_topic(path: Path, counts: dict[str, int], topic: str | None) -> str:
    listed = ", ".join(f"{name} ({count})" for name, count in sorted(counts.items())) or "none"
    if topic is not None:
        if topic not in counts:
            raise InputError(f"{path}: no PointCloud2 topic {topic}; it has {listed}")
        return topic
    if len(counts) != 1:
        raise InputError(f"{path}: expected one PointCloud2 topic or a choice, found {listed}")
    return next(iter(counts))
