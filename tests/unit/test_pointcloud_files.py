import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pypcd4 import Encoding, PointCloud

from sl3d_slam.config import InputSettings
from sl3d_slam.errors import InputError
from sl3d_slam.io.folder import read_cloud
from sl3d_slam.io.open import open_dataset, read_scan
from sl3d_slam.io.points import to_sweep_seconds

SETTINGS = InputSettings(min_range_m=0.5, max_range_m=80.0)
COUNT = 300


def sample():
    rng = np.random.default_rng(1)
    points = rng.uniform(1, 30, (COUNT, 3)).astype(np.float32)
    return points, np.sort(rng.integers(0, 100_000_000, COUNT)).astype(np.uint32)


def ply_header(kind, count=COUNT, extra=""):
    return (
        f"ply\nformat {kind} 1.0\ncomment made by hand\n{extra}element vertex {count}\n"
        "property float x\nproperty float y\nproperty float z\nproperty uint t\n"
        "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()


def write_ply(path, kind):
    points, times = sample()
    header = ply_header(kind)
    if kind == "ascii":
        rows = "".join(
            f"{x:.9g}  {y:.9g} {z:.9g} {t} \n" for (x, y, z), t in zip(points, times, strict=True)
        )
        path.write_bytes(header + rows.encode())
        return
    order = "<" if "little" in kind else ">"
    body = b"".join(
        struct.pack(f"{order}fffI", *point, time)
        for point, time in zip(points.tolist(), times.tolist(), strict=True)
    )
    path.write_bytes(header + body)


def write_pcd(path, encoding):
    points, times = sample()
    columns = [points[:, 0], points[:, 1], points[:, 2], times]
    types = (np.float32, np.float32, np.float32, np.uint32)
    PointCloud.from_points(columns, ("x", "y", "z", "t"), types).save(path, encoding)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply(tmp_path, kind):
    write_ply(tmp_path / "a.ply", kind)
    points, times = sample()
    cloud = read_cloud(tmp_path / "a.ply")
    # nine digits in ascii give the float32 back, though they are read as float64
    assert np.array_equal(cloud.points.astype(np.float32), points)
    assert np.array_equal(cloud.times, times)


@pytest.mark.parametrize("encoding", [Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED])
def test_pcd(tmp_path, encoding):
    write_pcd(tmp_path / "a.pcd", encoding)
    points, times = sample()
    cloud = read_cloud(tmp_path / "a.pcd")
    assert np.array_equal(cloud.points, points.astype(float))
    assert np.array_equal(cloud.times, times)


def test_pcd_written_by_hand(tmp_path):
    rows = "".join(f"{x} 2.5 nan {i}\n" for i, x in enumerate(range(3)))
    (tmp_path / "a.pcd").write_text(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\n"
        f"COUNT 1 1 1 1\nWIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA ascii\n{rows}"
    )
    cloud = read_cloud(tmp_path / "a.pcd")
    assert np.array_equal(cloud.points, [[0, 2.5, np.nan], [1, 2.5, np.nan], [2, 2.5, np.nan]],
                          equal_nan=True)  # fmt: skip
    assert cloud.times is None


def test_ply_with_coordinates_in_double_and_an_element_before(tmp_path):
    header = (
        b"ply\r\nformat binary_little_endian 1.0\r\nelement camera 2\r\nproperty double focal\r\n"
        b"element vertex 1\r\nproperty uchar red\r\nproperty double Z\r\nproperty double X\r\n"
        b"property double Y\r\nend_header\r\n"
    )
    (tmp_path / "a.ply").write_bytes(header + bytes(16) + struct.pack("<Bddd", 7, 3.0, 1.0, 2.0))
    assert read_cloud(tmp_path / "a.ply").points.tolist() == [[1.0, 2.0, 3.0]]


@pytest.mark.parametrize("name", ["a.ply", "a.pcd"])
def test_times_reach_the_scan_in_seconds_with_the_points_they_belong_to(tmp_path, name):
    if name == "a.ply":
        write_ply(tmp_path / name, "binary_little_endian")
    else:
        write_pcd(tmp_path / name, Encoding.BINARY)
    near = InputSettings(min_range_m=20.0, max_range_m=35.0)
    scan = next(iter(open_dataset(tmp_path, near)))
    points, times = sample()
    kept = (np.linalg.norm(points, axis=1) > 20) & (np.linalg.norm(points, axis=1) < 35)
    expected = (times[kept] - times[kept].min()) * 1e-9
    np.testing.assert_allclose(scan.point_times_s, expected, atol=1e-12)
    assert 100 < len(scan.points_lidar) < COUNT
    np.testing.assert_array_equal(scan.points_lidar, points[kept].astype(float))


@pytest.mark.parametrize(
    ("raw", "unit_s"),
    [
        (np.linspace(0, 0.1, 50), 1.0),
        (np.linspace(0, 100, 50, dtype=np.float32), 1e-3),
        (np.arange(0, 100_000, 1000, dtype=np.int32), 1e-6),
        (np.arange(0, 100_000_000, 1_000_000, dtype=np.uint32), 1e-9),
        (np.uint64(1_700_000_000_123_456_789) + np.arange(0, 10**8, 10**6, dtype=np.uint64), 1e-9),
        (1.7e9 + np.linspace(0, 0.05, 50), 1.0),
        (np.linspace(-0.1, 0, 50), 1.0),
    ],
)
def test_unit_of_times_is_told_by_their_span(raw, unit_s):
    seconds = to_sweep_seconds(raw)
    # 1e-6 s: at 1.7e9 s a float64 has steps of 2.4e-7 s; at 100 ms a float32 of 8e-9 s
    np.testing.assert_allclose(seconds, (raw - raw.min()).astype(float) * unit_s, atol=1e-6)
    assert seconds.min() == 0.0
    assert 0.04 < seconds.max() < 0.11


@pytest.mark.parametrize(
    "raw", [np.zeros(5), np.array([0.0, np.nan]), np.array([]), np.array([0.0, 1e15])]
)
def test_times_that_mean_nothing_are_none(raw):
    assert to_sweep_seconds(raw) is None


PCD_HEADER = (
    "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\n"
    "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {data}\n"
)


def pcd(count, encoding, body):
    return PCD_HEADER.format(n=count, data=encoding).encode() + body


HUGE = 2**40
SMALL_PLY = ply_header("binary_little_endian", 2)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", b""),
        ("a.ply", b"ply\n"),
        ("a.ply", b"not a ply file" * 50),
        ("a.ply", SMALL_PLY + bytes(31)),
        ("a.ply", ply_header("binary_little_endian", HUGE) + bytes(3200)),
        ("a.ply", ply_header("ascii", HUGE) + b"1 2 3 4\n"),
        ("a.ply", ply_header("ascii", 3) + b"1 2 3 4\n1 2 3\n1 2 3 4\n"),
        ("a.ply", ply_header("ascii", 3) + b"1 2 3 4\n1 2 3 4\n"),
        ("a.ply", ply_header("ascii", -1)),
        ("a.ply", ply_header("binary_little_endian", -5) + bytes(3200)),
        ("a.ply", ply_header("binary_middle_endian", 2) + bytes(32)),
        ("a.ply", SMALL_PLY.replace(b"float x", b"quad x") + bytes(32)),
        ("a.ply", SMALL_PLY.replace(b"float x", b"float w") + bytes(32)),
        ("a.ply", SMALL_PLY.replace(b"float y", b"float x") + bytes(32)),
        ("a.ply", SMALL_PLY.replace(b"vertex 2", b"vertex two") + bytes(32)),
        ("a.ply", SMALL_PLY.replace(b"comment made", b"comm\xffnt made") + bytes(32)),
        ("a.pcd", b""),
        ("a.pcd", b"not a pcd file" * 50),
        ("a.pcd", pcd(3, "binary", bytes(35))),
        ("a.pcd", pcd(HUGE, "binary", bytes(36))),
        ("a.pcd", pcd(HUGE, "ascii", b"1 2 3\n")),
        ("a.pcd", pcd(2, "ascii", b"1 2 3\n1 2\n")),
        ("a.pcd", pcd(2, "ascii", b"1 2 3\none two three\n")),
        ("a.pcd", pcd(3, "binary_compressed", b"")),
        ("a.pcd", pcd(3, "binary_compressed", struct.pack("<II", 4, 36) + b"\xff\xff\xff\xff")),
        ("a.pcd", pcd(3, "binary_compressed", struct.pack("<II", 99, 36) + bytes(5))),
        (
            "a.pcd",
            pcd(HUGE // 12, "binary_compressed", struct.pack("<II", 4, 2**32 - 1) + bytes(4)),
        ),
        ("a.pcd", pcd(3, "binary_squeezed", bytes(36))),
        ("a.pcd", pcd(3, "binary", bytes(36)).replace(b"SIZE 4 4 4", b"SIZE 4 4")),
        ("a.pcd", pcd(3, "binary", bytes(36)).replace(b"SIZE 4 4 4", b"SIZE 4 4 3")),
        ("a.pcd", pcd(3, "binary", bytes(36)).replace(b"FIELDS x", b"FIELDS w")),
        ("a.pcd", pcd(3, "binary", bytes(36)).replace(b"COUNT 1 1 1", b"COUNT 1 1 999999999")),
        ("a.pcd", pcd(3, "binary", bytes(36)).replace(b"WIDTH 3", b"WIDTH three")),
        ("a.pcd", pcd(3, "binary", bytes(36)).replace(b"WIDTH 3", b"WIDTH 5")),
        ("a.pcd", pcd(3, "binary", bytes(36)).replace(b"POINTS 3\n", b"")),
        ("a.pcd", pcd(3, "binary", bytes(36)).replace(b"VERSION 0.7", b"VERSION \xff\xfe")),
    ],
)
def test_damaged_files_are_named(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=r"a\.(ply|pcd): .*expected"):
        read_cloud(tmp_path / name)


@pytest.mark.parametrize("kind", ["ply", "pcd", "pcd_compressed", "ascii"])
@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_no_damage_gets_through_as_another_error(tmp_path_factory, kind, data):
    folder = tmp_path_factory.mktemp("damage")
    path = folder / ("a.ply" if kind in ("ply", "ascii") else "a.pcd")
    match kind:
        case "ply":
            write_ply(path, "binary_little_endian")
        case "ascii":
            write_ply(path, "ascii")
        case "pcd":
            write_pcd(path, Encoding.BINARY)
        case _:
            write_pcd(path, Encoding.BINARY_COMPRESSED)
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, min(len(raw) - 1, 400)))] = data.draw(st.integers(0, 255))
    path.write_bytes(raw[: data.draw(st.integers(0, len(raw)))])
    try:
        cloud = read_cloud(path)
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017
    else:
        assert cloud.points.shape[1] == 3
        assert len(cloud.points) <= len(raw)


def test_unknown_kind_and_few_points(tmp_path):
    (tmp_path / "a.xyz").write_text("1 2 3\n")
    with pytest.raises(InputError, match=r"a\.xyz: unknown kind"):
        read_scan(tmp_path / "a.xyz", SETTINGS)
    with pytest.raises(InputError, match=r"b\.ply: not found"):
        read_scan(tmp_path / "b.ply", SETTINGS)
    (tmp_path / "c.pcd").write_bytes(pcd(50, "binary", np.full(150, 2.0, "<f4").tobytes()))
    with pytest.raises(InputError, match=r"c\.pcd: 50 of 50 points .* at least 100"):
        read_scan(tmp_path / "c.pcd", SETTINGS)
