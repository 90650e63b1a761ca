import gc
import weakref

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from sl3d_slam.config import InputSettings
from sl3d_slam.errors import InputError
from sl3d_slam.io.open import open_dataset
from sl3d_slam.io.point_cloud2 import cloud_from_message

SETTINGS = InputSettings(min_range_m=1.0, max_range_m=80.0)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
START_NS = 1_700_000_000_000_000_000
ROWS, COLUMNS = 4, 60


def points_of(index):
    rng = np.random.default_rng(index)
    return rng.uniform(2, 20, (ROWS * COLUMNS, 3)).astype(np.float32)


def times_of(index):
    return np.random.default_rng(100 + index).uniform(0, 0.1, ROWS * COLUMNS).astype(np.float32)


def message(store, index, *, order="<", padding=6):
    """Build a cloud as an organised sensor does: four rows, holes between fields and rows."""
    names, offsets = ("intensity", "x", "y", "z", "time"), (0, 4, 8, 12, 20)
    dtype = np.dtype({
        "names": names, "formats": [f"{order}f4"] * 5, "offsets": offsets, "itemsize": 28,
    })  # fmt: skip
    fields = np.zeros(ROWS * COLUMNS, dtype)
    for axis, column in zip("xyz", points_of(index).T, strict=True):
        fields[axis] = column
    fields["time"] = times_of(index)
    rows = fields.view(np.uint8).reshape(ROWS, COLUMNS * 28)
    raw = np.hstack([rows, np.full((ROWS, padding), 255, np.uint8)]).ravel()
    types = store.types
    field_type = types["sensor_msgs/msg/PointField"]
    stamp = types["builtin_interfaces/msg/Time"](sec=1_700_000_000, nanosec=100_000_000 * index)
    extra = {"seq": index} if store is ROS1 else {}
    return types[POINT_CLOUD](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="lidar", **extra),
        height=ROWS,
        width=COLUMNS,
        fields=[
            field_type(name=name, offset=offset, datatype=7, count=1)
            for name, offset in zip(names, offsets, strict=True)
        ],
        is_bigendian=order == ">",
        point_step=28,
        row_step=COLUMNS * 28 + padding,
        data=raw,
        is_dense=True,
    )


def write_bag(path, kind, topics=("/points",), count=4):
    """Write a bag with clouds on each topic and a text topic beside them; return what to open."""
    if kind == "rosbag1":
        path = path.with_suffix(".bag")
        writer, store = Writer1(path), ROS1
        serialize = ROS1.serialize_ros1
    else:
        plugin = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
        writer, store = Writer2(path, version=9, storage_plugin=plugin), ROS2
        serialize = ROS2.serialize_cdr
    with writer:
        chat = writer.add_connection("/chat", "std_msgs/msg/String", typestore=store)
        clouds = [writer.add_connection(t, POINT_CLOUD, typestore=store) for t in topics]
        text = store.types["std_msgs/msg/String"](data="hello")
        for index in range(count):
            now = START_NS + 100_000_000 * index + 50
            writer.write(chat, now, serialize(text, "std_msgs/msg/String"))
            for cloud in clouds:
                writer.write(cloud, now, serialize(message(store, index), POINT_CLOUD))
    if kind == "bare":
        return next(path.glob("*.mcap"))
    return path


@pytest.mark.parametrize("kind", ["sqlite3", "mcap", "bare", "rosbag1"])
def test_bag_written_and_read_back(tmp_path, kind):
    dataset = open_dataset(write_bag(tmp_path / "run", kind), SETTINGS)
    assert len(dataset) == 4
    for index, scan in enumerate(dataset):
        assert scan.index == index
        assert scan.stamp_s == pytest.approx(1.7e9 + 0.1 * index, abs=1e-6)
        assert np.array_equal(scan.points_lidar, points_of(index).astype(float))
        times = times_of(index).astype(float)
        np.testing.assert_allclose(scan.point_times_s, times - times.min(), atol=1e-8)


@pytest.mark.parametrize("kind", ["sqlite3", "bare"])
def test_start_and_stop(tmp_path, kind):
    dataset = open_dataset(write_bag(tmp_path / "run", kind), SETTINGS)
    part = list(dataset.iterate(2, 3))
    assert [scan.index for scan in part] == [2]
    assert np.array_equal(part[0].points_lidar, points_of(2).astype(float))
    assert [scan.index for scan in dataset.iterate(3)] == [3]


def test_several_topics_need_a_choice(tmp_path):
    path = write_bag(tmp_path / "run", "mcap", topics=("/front", "/rear"))
    with pytest.raises(InputError, match=r"run: .*/front \(4\), /rear \(4\)"):
        open_dataset(path, SETTINGS)
    assert len(open_dataset(path, SETTINGS, topic="/rear")) == 4
    with pytest.raises(InputError, match=r"no PointCloud2 topic /top; it has /front"):
        open_dataset(path, SETTINGS, topic="/top")


def test_no_cloud_at_all(tmp_path):
    with pytest.raises(InputError, match=r"run: expected one PointCloud2 topic .* found none"):
        open_dataset(write_bag(tmp_path / "run", "sqlite3", topics=()), SETTINGS)


def test_folder_with_one_bag_file_and_no_metadata(tmp_path):
    write_bag(tmp_path / "run", "mcap")
    (tmp_path / "run" / "metadata.yaml").unlink()
    assert len(open_dataset(tmp_path / "run", SETTINGS)) == 4
    (tmp_path / "run" / "other.mcap").write_bytes(b"")
    with pytest.raises(InputError, match="exactly one"):
        open_dataset(tmp_path / "run", SETTINGS)


@pytest.mark.parametrize("kind", ["sqlite3", "mcap", "bare", "rosbag1"])
@pytest.mark.parametrize("keep", [0.0, 0.001, 0.3, 0.7, 0.99])
def test_cut_off_bag_is_named(tmp_path, kind, keep):
    opened = write_bag(tmp_path / "run", kind)
    storage = opened if opened.is_file() else next(opened.glob("run*.*"))
    raw = storage.read_bytes()
    storage.write_bytes(raw[: int(keep * len(raw))])
    with pytest.raises(InputError, match=r"run.*(expected|damaged|whole)"):
        list(open_dataset(opened, SETTINGS))


def test_damaged_metadata_is_named(tmp_path):
    path = write_bag(tmp_path / "run", "sqlite3")
    for text in ("", "[1, 2", "rosbag2_bagfile_information: 7\n"):
        (path / "metadata.yaml").write_text(text)
        with pytest.raises(InputError, match="run: cannot be read as a bag"):
            open_dataset(path, SETTINGS)


def test_big_endian_and_unpadded_clouds():
    for order, padding in ((">", 6), ("<", 0), (">", 0)):
        cloud = cloud_from_message(message(ROS2, 5, order=order, padding=padding), "here")
        assert np.array_equal(cloud.points, points_of(5).astype(float))


@pytest.mark.parametrize(
    "damage",
    [
        {"width": 2**31},
        {"height": 2**31},
        {"point_step": 10},
        {"point_step": 0},
        {"row_step": 2**31},
        {"data": np.zeros(100, np.uint8)},
        {"fields": []},
    ],
)
def test_field_table_that_does_not_fit_is_an_error(damage):
    cloud = message(ROS2, 0)
    for name, value in damage.items():
        setattr(cloud, name, value)
    with pytest.raises(InputError, match="here"):
        cloud_from_message(cloud, "here")


def test_unknown_field_type_is_an_error():
    cloud = message(ROS2, 0)
    cloud.fields[1].datatype = 99
    with pytest.raises(InputError, match="here"):
        cloud_from_message(cloud, "here")


def test_scans_are_not_kept(tmp_path):
    alive = []
    for scan in open_dataset(write_bag(tmp_path / "run", "sqlite3"), SETTINGS):
        alive.append(weakref.ref(scan.points_lidar))
        del scan
        gc.collect()
        assert sum(ref() is not None for ref in alive) == 0
