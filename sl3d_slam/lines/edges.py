"""Standing edges of buildings: where two walls meet, and where a wall truly ends."""

import numpy as np
from jaxtyping import Float64, Int64

from sl3d_slam.lines.poles import Upright
from sl3d_slam.lines.scene import Scene
from sl3d_slam.lines.view import hidden_share
from sl3d_slam.lines.wall_fit import SLICE_M, straight_end
from sl3d_slam.lines.walls import Wall, find_walls

CORNER_REACH_M = 0.4
CORNER_SUPPORT_M = 0.8
MIN_CORNER_SINE = 0.5
END_ZONE_M = 1.0
MIN_END_HEIGHT_M = 1.0
HIDDEN_MARGIN_M = 0.4
MAX_HIDDEN_SHARE = 0.3
CLEAR_BEYOND_M = 0.7
CORNER_SCORE = 0.75
END_SCORE = 0.45

Corner = tuple[int, int, Float64[np.ndarray, "2"]]


def find_edges(scene: Scene, grow_radius_m: float, min_length_m: float) -> list[Upright]:
    """Return the corners, then the true ends, of the walls of a scene."""
    walls = find_walls(scene, grow_radius_m)
    meetings = _meetings(walls)
    edges = [_corner(scene, (walls[a], walls[b]), place, min_length_m) for a, b, place in meetings]
    taken = np.array([place for _, _, place in meetings]).reshape(-1, 2)
    edges += [
        _end(scene, wall, sign, taken, min_length_m) for wall in walls for sign in (-1.0, 1.0)
    ]
    return [edge for edge in edges if edge is not None]


def _meetings(walls: list[Wall]) -> list[Corner]:
    """Return the pairs of walls that meet near an end of both, and where, seen from above."""
    if len(walls) < 2:
        return []
    normal = np.array([wall.normal for wall in walls])
    along = np.array([wall.along for wall in walls])
    offset = np.array([wall.offset for wall in walls])
    ends = np.array([wall.positions[[0, -1]] for wall in walls])
    a, b = np.triu_indices(len(walls), 1)
    sine = normal[a, 0] * normal[b, 1] - normal[a, 1] * normal[b, 0]
    crossing = np.abs(sine) >= MIN_CORNER_SINE
    a, b, sine = a[crossing], b[crossing], sine[crossing]
    x = (offset[a] * normal[b, 1] - offset[b] * normal[a, 1]) / sine
    y = (offset[b] * normal[a, 0] - offset[a] * normal[b, 0]) / sine
    place = np.stack([x, y], axis=1)
    miss = [
        np.abs(np.sum(place * along[side], axis=1)[:, None] - ends[side]).min(axis=1)
        for side in (a, b)
    ]
    close = np.flatnonzero((miss[0] < CORNER_REACH_M) & (miss[1] < CORNER_REACH_M))
    return [(int(a[k]), int(b[k]), place[k]) for k in close]


def _corner(
    scene: Scene, pair: tuple[Wall, Wall], place: Float64[np.ndarray, "2"], min_length_m: float
) -> Upright | None:
    spans, support = [], 0
    for wall in pair:
        near = wall.near(float(place @ wall.along), CORNER_SUPPORT_M)
        if len(near) < 5:
            return None
        spans.append(_span(scene.points[near, 2]))
        support += int(scene.counts[near].sum())
    low, high = max(spans[0][0], spans[1][0]), min(spans[0][1], spans[1][1])
    if high - low < min_length_m:
        return None
    return _upright(scene, place, (low, high), support, CORNER_SCORE)


def _end(
    scene: Scene,
    wall: Wall,
    sign: float,
    taken: Float64[np.ndarray, "C 2"],
    min_length_m: float,
) -> Upright | None:
    """Return the edge at one end of a wall, if its outermost points stand above each other."""
    limit = wall.positions[-1] if sign > 0 else wall.positions[0]
    near = wall.near(float(limit), END_ZONE_M)
    outward = sign * (scene.points[near, :2] @ wall.along)
    band = straight_end(scene.points[near, 2], outward)
    if len(band) == 0:
        return None
    place = wall.normal * wall.offset + wall.along * sign * float(outward[band].max())
    if len(taken) and np.linalg.norm(taken - place, axis=1).min() < CORNER_SUPPORT_M:
        return None
    voxels = near[band]
    low, high = _span(scene.points[voxels, 2])
    if high - low < max(min_length_m, MIN_END_HEIGHT_M):
        return None
    if _is_hidden(scene, voxels, place, sign * wall.along):
        return None
    if _goes_on(scene, place, sign * wall.along, (low, high)):
        return None
    return _upright(scene, place, (low, high), int(scene.counts[voxels].sum()), END_SCORE)


def _is_hidden(
    scene: Scene,
    voxels: Int64[np.ndarray, "N"],
    place: Float64[np.ndarray, "2"],
    outward: Float64[np.ndarray, "2"],
) -> bool:
    """Tell whether something nearer stands where the wall would go on, as seen from the sensor."""
    begin, stop = place + 0.1 * outward, place + 0.6 * outward
    turn = float(np.arctan2(begin[0] * stop[1] - begin[1] * stop[0], begin @ stop))
    azimuth = float(np.arctan2(begin[1], begin[0]))
    least = np.radians(0.75)
    turn = float(np.copysign(max(abs(turn), least), turn))
    share = hidden_share(
        scene.ranges, scene.points[voxels], azimuth, azimuth + turn, HIDDEN_MARGIN_M
    )
    return share > MAX_HIDDEN_SHARE


def _goes_on(
    scene: Scene,
    place: Float64[np.ndarray, "2"],
    outward: Float64[np.ndarray, "2"],
    span: tuple[float, float],
) -> bool:
    """Tell whether structure continues past an end: a bend, a curve, a recess, a hedge."""
    near = scene.around(place, CLEAR_BEYOND_M + 0.2)
    offset, z = scene.points[near, :2] - place, scene.points[near, 2]
    ahead = offset @ outward
    aside = np.abs(offset[:, 0] * outward[1] - offset[:, 1] * outward[0])
    beyond = (ahead > 0.1) & (ahead < CLEAR_BEYOND_M) & (aside < 0.25)
    beyond &= (z > span[0]) & (z < span[1])
    levels = np.unique(np.floor((z[beyond] - span[0]) / SLICE_M))
    return bool(len(levels) > 0.34 * np.ceil((span[1] - span[0]) / SLICE_M))


def _span(z: Float64[np.ndarray, "N"]) -> tuple[float, float]:
    """Return the lowest and highest value but for the outermost 2 %."""
    ordered, cut = np.sort(z), len(z) // 50
    return float(ordered[cut]), float(ordered[-1 - cut])


def _upright(
    scene: Scene,
    place: Float64[np.ndarray, "2"],
    span: tuple[float, float],
    support: int,
    base_score: float,
) -> Upright:
    near = scene.around(place, 1.0)
    ground = float(np.median(scene.points[near, 2] - scene.heights[near])) if len(near) else span[0]
    low, high = span
    endpoints = np.array([[*place, low], [*place, high]], dtype=np.float64)
    score = base_score * (0.5 + 0.5 * min((high - low) / 3.0, 1.0))
    return Upright(endpoints, support, 0.0, low - ground, high - ground, score)
