"""A line map for other programs: PLY edges, GeoJSON features, LAS points; all in the map frame."""

import json
from io import BytesIO
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from sl3d_slam.errors import MissingExtraError
from sl3d_slam.geometry.segments import lengths_m
from sl3d_slam.mapping.line_map import LineMap, landmark_up
from sl3d_slam.mapping.merge import standing
from sl3d_slam.types import LineKind

COLOURS = np.array([(138, 138, 138), (213, 94, 0), (0, 114, 178), (0, 158, 115)], np.uint8)
LAS_STEP_M = 0.1
LAS_SCALE_M = 0.001
LAS_CLOUD_CLASS = 1  # unclassified
LAS_FIRST_CLASS = 64  # the first that the LAS standard leaves to users; plus the kind
FRAME = "local metres in the map frame, x y z; not longitude and latitude"


def ply_bytes(line_map: LineMap) -> bytes:
    """Return a binary PLY: two vertices and an edge for each landmark, coloured by kind.

    Edges carry the support, vertices double coordinates, as Open3D and CloudCompare read them.
    """
    count = len(line_map)
    vertex = np.zeros(2 * count, [(axis, "<f8") for axis in "xyz"])
    for axis, values in zip("xyz", line_map.lines.endpoints.reshape(-1, 3).T, strict=True):
        vertex[axis] = values
    names = ("vertex1", "vertex2", "support")
    edge = np.zeros(
        count, [(n, "<i4") for n in names] + [(n, "u1") for n in ("red", "green", "blue")]
    )
    edge["vertex1"], edge["vertex2"] = 2 * np.arange(count), 2 * np.arange(count) + 1
    edge["support"] = line_map.support
    for name, values in zip(("red", "green", "blue"), COLOURS[line_map.lines.kinds].T, strict=True):
        edge[name] = values
    header = [
        "ply", "format binary_little_endian 1.0",
        f"comment line map, {'simulated, ' if line_map.simulated else ''}metres",
        f"element vertex {2 * count}", *(f"property double {axis}" for axis in "xyz"),
        f"element edge {count}", *(f"property int {name}" for name in names),
        "property uchar red", "property uchar green", "property uchar blue", "end_header\n",
    ]  # fmt: skip
    return "\n".join(header).encode("ascii") + vertex.tobytes() + edge.tobytes()


def geojson_text(line_map: LineMap) -> str:
    """Return GeoJSON in local metres: standing landmarks as points, others as lines, the drive.

    A point stands at the landmark's lower end; its properties tell how high it reaches.
    """
    upright = standing(line_map.lines.endpoints, landmark_up(line_map))
    features = [_landmark_feature(line_map, k, bool(upright[k])) for k in range(len(line_map))]
    positions = line_map.T_map_keyframe[:, :3, 3]
    if len(positions) > 1:
        way = {"type": "LineString", "coordinates": _rounded(positions)}
        features.append(_feature(way, {"what": "keyframes"}))
    tree = {
        "type": "FeatureCollection",
        "coordinates": FRAME,
        "simulated": line_map.simulated,
        "features": features,
    }
    return json.dumps(tree, allow_nan=False) + "\n"


def las_bytes(line_map: LineMap) -> bytes:
    """Return LAS 1.4 points: landmarks every 0.1 m, and the cloud where the map keeps one.

    Landmarks have class 64 plus their kind and the extra dimensions ``landmark`` (the cloud: -1)
    and ``support``.

    Raises
    ------
    MissingExtraError
        where laspy is not installed.
    """
    try:
        import laspy
    except ModuleNotFoundError:
        raise MissingExtraError(
            "writing LAS needs laspy, which is not installed; pip install 'sl3d-slam[export]'"
        ) from None
    points, landmark = _samples(line_map)
    cloud = np.zeros((0, 3)) if line_map.cloud is None else line_map.cloud.all_points()
    landmark = np.concatenate([landmark, np.full(len(cloud), -1)])
    known = landmark >= 0
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, LAS_SCALE_M)
    header.add_extra_dims(
        [laspy.ExtraBytesParams("landmark", "int32"), laspy.ExtraBytesParams("support", "uint32")]
    )
    las = laspy.LasData(header)
    las.xyz = np.concatenate([points, cloud])
    las.classification = _las_classes(line_map, landmark, known)
    las.landmark = landmark
    las.support = np.where(known, np.append(line_map.support, 0)[landmark], 0)
    buffer = BytesIO()
    las.write(buffer)
    return buffer.getvalue()


def _las_classes(
    line_map: LineMap, landmark: Int64[np.ndarray, "N"], known: Bool[np.ndarray, "N"]
) -> np.ndarray:
    kinds = np.append(line_map.lines.kinds, 0).astype(np.int64)
    return np.where(known, LAS_FIRST_CLASS + kinds[landmark], LAS_CLOUD_CLASS).astype(np.uint8)


def _samples(line_map: LineMap) -> tuple[Float64[np.ndarray, "N 3"], Int64[np.ndarray, "N"]]:
    """Return points along every landmark, both ends included, and whose they are."""
    endpoints = line_map.lines.endpoints
    count = np.ceil(lengths_m(endpoints) / LAS_STEP_M).astype(np.int64) + 1
    landmark = np.repeat(np.arange(len(endpoints)), count)
    step = np.arange(len(landmark)) - np.repeat(np.cumsum(count) - count, count)
    fraction = (step / np.maximum(count[landmark] - 1, 1))[:, None]
    points = endpoints[landmark, 0] * (1 - fraction) + endpoints[landmark, 1] * fraction
    return points, landmark


def _landmark_feature(line_map: LineMap, k: int, upright: bool) -> dict[str, Any]:
    lines = line_map.lines
    low, high = sorted(_rounded(lines.endpoints[k]), key=lambda point: point[2])
    facts = {
        "landmark": k,
        "kind": LineKind(int(lines.kinds[k])).name.lower(),
        "support": int(line_map.support[k]),
        "score": round(float(lines.scores[k]), 3),
    }
    if not upright:
        return _feature({"type": "LineString", "coordinates": [low, high]}, facts)
    height = {"height_m": round(high[2] - low[2], 3), "top_m": high[2]}
    return _feature({"type": "Point", "coordinates": low}, facts | height)


def _feature(geometry: dict[str, Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _rounded(points: Float64[np.ndarray, "N 3"]) -> list[list[float]]:
    return points.round(3).tolist()
