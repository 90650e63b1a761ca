"""How large a map is, on the ground and on disk."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from sl3d_slam.geometry.geodesy import GeoReference
from sl3d_slam.geometry.se3 import distances_travelled_m
from sl3d_slam.mapping.file import VERSION, to_bytes
from sl3d_slam.mapping.line_map import LineMap
from sl3d_slam.types import LineKind

REVISIT_M = 8.0
LOOP_M = 50.0
GAP_FACTOR, GAP_M = 10.0, 30.0
VIEW_M = 30.0
CELL_M = 5.0

Fact = str | int | float | bool | None | dict[str, int]


def map_facts(line_map: LineMap) -> dict[str, Fact]:
    """Return what ``sl3d info`` tells of a map; sizes as :func:`to_bytes` writes it.

    ``street_km`` counts a street once, however often it was driven; ``travelled_km`` each time.
    ``area_km2`` is the ground within 30 m of a keyframe.
    """
    positions = line_map.T_map_keyframe[:, :3, 3]
    steps_m, again = street_steps(positions)
    street_km = float(steps_m[~again].sum()) / 1e3
    size_kb = len(to_bytes(line_map)) / 1e3
    lines_kb = len(to_bytes(replace(line_map, cloud=None))) / 1e3
    kinds = np.bincount(line_map.lines.kinds, minlength=len(LineKind))
    return {
        "format_version": VERSION,
        "model": line_map.model,
        "simulated": line_map.simulated,
        "georeference": _georeference_text(line_map.origin.georeference),
        "landmarks": len(line_map),
        "landmarks_by_kind": {kind.name.lower(): int(kinds[kind]) for kind in LineKind},
        "descriptor_dimension": line_map.lines.descriptors.shape[1],
        "median_support": float(np.median(line_map.support)) if len(line_map) else 0.0,
        "keyframes": len(positions),
        "street_km": street_km,
        "travelled_km": float(steps_m.sum()) / 1e3,
        "area_km2": area_m2(positions) / 1e6,
        "cloud_voxels": 0 if line_map.cloud is None else len(line_map.cloud),
        "cloud_voxel_m": None if line_map.cloud is None else line_map.cloud.voxel_m,
        "size_kb": size_kb,
        "lines_kb": lines_kb,
        "kb_per_km": size_kb / street_km if street_km else None,
        "lines_kb_per_km": lines_kb / street_km if street_km else None,
    }


def _georeference_text(georeference: GeoReference | None) -> str | None:
    """Return origin and T_enu_map in a line."""
    if georeference is None:
        return None
    T, origin = georeference.T_enu_map, georeference.origin
    where = (
        "a metric frame"
        if origin is None
        else f"{origin.latitude_deg:.9f} {origin.longitude_deg:.9f} deg {origin.altitude_m:.3f} m"
    )
    yaw_deg = float(np.degrees(np.arctan2(T[1, 0], T[0, 0])))
    shift = " ".join(f"{x:.3f}" for x in T[:3, 3])
    return f"ENU of {where}; map's origin at {shift} m, its x axis {yaw_deg:.3f} deg from east"


def street_steps(
    positions: Float64[np.ndarray, "K 3"],
) -> tuple[Float64[np.ndarray, "J"], np.ndarray]:
    """Return the metres between successive keyframes, and which steps go where the map has been.

    A keyframe is on known ground when another one is within 8 m of it that came at least 50 m
    earlier on the way. A leap from one drive to the next counts nothing.
    """
    if len(positions) < 2:
        return np.zeros(0), np.zeros(0, np.bool_)
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    way_m = distances_travelled_m(positions)
    pairs = cKDTree(positions[:, :2]).query_pairs(REVISIT_M, output_type="ndarray")
    later = pairs.max(axis=1)[np.abs(way_m[pairs[:, 1]] - way_m[pairs[:, 0]]) > LOOP_M]
    known = np.zeros(len(positions), np.bool_)
    known[later] = True
    leap = steps_m > max(GAP_M, GAP_FACTOR * float(np.median(steps_m)))
    return np.where(leap, 0.0, steps_m), known[1:]


def area_m2(positions: Float64[np.ndarray, "K 3"]) -> float:
    """Return the ground within 30 m of any keyframe, in cells of 5 m."""
    reach = np.arange(-int(VIEW_M / CELL_M), int(VIEW_M / CELL_M) + 1)
    disc = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
    disc = disc[np.hypot(disc[:, 0], disc[:, 1]) * CELL_M <= VIEW_M]
    cells = np.floor(positions[:, :2] / CELL_M).astype(np.int64)
    around = (cells[:, None] + disc[None]).reshape(-1, 2)
    return len(np.unique(around, axis=0)) * CELL_M**2
