import io
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from sl3d_slam.cli.main import app
from sl3d_slam.config import MapSettings
from sl3d_slam.errors import MissingExtraError
from sl3d_slam.geometry.se3 import from_yaw, invert
from sl3d_slam.geometry.segments import distance_to_line_m
from sl3d_slam.mapping.export import geojson_text, las_bytes, ply_bytes
from sl3d_slam.mapping.line_map import LineMap, MapOrigin
from sl3d_slam.types import LineKind, LineSet

WORLD = np.array(
    [
        [[10.0, 4.0, 0.5], [10.0, 4.0, 4.0]],
        [[20.0, -7.0, 0.0], [20.1, -7.0, 6.0]],
        [[5.0, 9.0, 5.0], [25.0, 9.0, 5.0]],
    ]
)
KINDS = (LineKind.POLE, LineKind.VERTICAL_EDGE, LineKind.OTHER_EDGE)


@pytest.fixture(scope="module")
def line_map():
    poses = np.array([from_yaw(0.4, np.array([4.0 * k, 1.0, 0.0])) for k in range(4)])
    lines = LineSet(
        WORLD, np.eye(3, dtype=np.float32), np.array([5, 6, 7]), np.array(KINDS, np.uint8)
    )
    seen = [lines.transformed(invert(T)) for T in poses]
    up = np.array([T[2, :3] for T in poses])
    clouds = [(WORLD.reshape(-1, 3) - T[:3, 3]) @ T[:3, :3] for T in poses]
    clouds = [cloud.astype(np.float32) for cloud in clouds]
    return LineMap.build(seen, poses, up, clouds, MapSettings(), MapOrigin(simulated=True))


def test_ply_holds_the_lines_as_edges(line_map):
    content = ply_bytes(line_map)
    header, body = content.split(b"end_header\n", 1)
    text = header.decode("ascii").splitlines()
    assert text[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "simulated" in text[2]
    assert text[text.index("element vertex 6") :] == [
        "element vertex 6", "property double x", "property double y", "property double z",
        "element edge 3", "property int vertex1", "property int vertex2", "property int support",
        "property uchar red", "property uchar green", "property uchar blue",
    ]  # fmt: skip
    vertex = np.frombuffer(body, "<f8", 18).reshape(6, 3)
    edge = np.frombuffer(body[144:], [("ends", "<i4", 2), ("support", "<i4"), ("colour", "u1", 3)])
    assert np.allclose(vertex[edge["ends"]], line_map.lines.endpoints)
    assert edge["support"].tolist() == [4, 4, 4]
    assert len({tuple(colour) for colour in edge["colour"].tolist()}) == 3


def test_geojson_says_that_its_metres_are_local(line_map):
    tree = json.loads(geojson_text(line_map))
    assert tree["type"] == "FeatureCollection"
    assert "local metres" in tree["coordinates"]
    assert tree["simulated"] is True
    by_kind = {f["properties"].get("kind", "drive"): f for f in tree["features"]}
    pole = by_kind["pole"]
    assert pole["geometry"] == {"type": "Point", "coordinates": [10.0, 4.0, 0.5]}
    assert (pole["properties"]["height_m"], pole["properties"]["top_m"]) == (3.5, 4.0)
    assert by_kind["vertical_edge"]["geometry"]["type"] == "Point"
    eave = by_kind["other_edge"]["geometry"]
    assert eave["type"] == "LineString"
    assert sorted(eave["coordinates"]) == [[5.0, 9.0, 5.0], [25.0, 9.0, 5.0]]
    assert by_kind["drive"]["geometry"]["coordinates"][2] == [8.0, 1.0, 0.0]
    assert len(tree["features"]) == 4


def test_las_samples_every_line_and_keeps_the_cloud(line_map):
    laspy = pytest.importorskip("laspy", reason="needs the extra 'export'")
    las = laspy.read(io.BytesIO(las_bytes(line_map)))
    landmark = np.asarray(las.landmark)
    for k in range(3):
        points = las.xyz[landmark == k]
        start, end = line_map.lines.endpoints[k]
        length = np.linalg.norm(end - start)
        assert len(points) == np.ceil(length / 0.1) + 1
        axis = (end - start) / length
        assert distance_to_line_m(points, start, axis).max() < 0.001  # the scale of the file
        assert np.ptp(points @ axis) == pytest.approx(length, abs=0.002)
        assert set(las.classification[landmark == k]) == {64 + line_map.lines.kinds[k]}
        assert set(las.support[landmark == k]) == {4}
    assert (landmark == -1).sum() == len(line_map.cloud)
    assert set(las.classification[landmark == -1]) == {1}


def test_las_without_laspy_says_how_to_install_it(line_map, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'sl3d-slam\[export\]'"):
        las_bytes(line_map)


def test_verb_writes_each_form_and_refuses_others(tmp_path, line_map):
    path = tmp_path / "map.sl3d"
    line_map.save(path)
    for suffix, start in ((".ply", b"ply\n"), (".geojson", b'{"type": "FeatureCollection"')):
        done = CliRunner().invoke(app, ["export", str(path), str(tmp_path / f"out{suffix}")])
        assert done.exit_code == 0
        assert "3 landmarks (simulated)" in done.output
        assert (tmp_path / f"out{suffix}").read_bytes().startswith(start)
    for arguments in ([path, tmp_path / "out.obj"], [tmp_path / "no.sl3d", tmp_path / "o.ply"]):
        refused = CliRunner().invoke(app, ["export", *map(str, arguments)])
        assert refused.exit_code == 2
        assert refused.stderr.count("\n") == 1
        assert "expected" in refused.stderr
