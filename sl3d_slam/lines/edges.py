"""Standing edges of buildings: where two walls meet, and where a wall truly ends."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from sl3d_slam.lines.poles import Upright
from sl3d_slam.lines.scene import Scene
from sl3d_slam.lines.sheets import grow_sheets, hidden_share

MAX_THICKNESS_M = 0.08
MIN_WIDTH_M = 0.12
MIN_SHEET_VOXELS = 25
MIN_SHEET_LENGTH_M = 0.8
MIN_SHEET_TOP_M = 1.9
CORNER_REACH_M = 0.7
MIN_CORNER_SINE = 0.5
END_BAND_M = 0.35
MAX_END_SPREAD_M = 0.12
MAX_HIDDEN_SHARE = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """An upright planar patch: ``normal . xy = offset`` in the level frame.

    ``along`` is the horizontal direction in the patch; ``first`` and ``last`` its extent along it.
    """

    voxels: Int64[np.ndarray, "N"]
    along: Float64[np.ndarray, "2"]
    normal: Float64[np.ndarray, "2"]
    offset: float
    positions: Float64[np.ndarray, "N"]
    first: float
    last: float


def find_edges(scene: Scene, grow_radius_m: float, min_length_m: float) -> list[Upright]:
    """Return the corners and true ends of the walls of a scene."""
    sheets = find_sheets(scene, grow_radius_m)
    edges: list[Upright] = []
    used: set[tuple[int, bool]] = set()
    for a in range(len(sheets)):
        for b in range(a + 1, len(sheets)):
            found = _corner(scene, (sheets[a], sheets[b]), min_length_m)
            if found is not None:
                edge, at_last_a, at_last_b = found
                edges.append(edge)
                used |= {(a, at_last_a), (b, at_last_b)}
    for a, sheet in enumerate(sheets):
        for at_last in (False, True):
            if (a, at_last) not in used:
                end = _end(scene, sheet, at_last, min_length_m)
                if end is not None:
                    edges.append(end)
    return edges


def find_sheets(scene: Scene, grow_radius_m: float) -> list[Sheet]:
    """Return the upright planar patches of a scene, best seed first."""
    core, thickness, width = scene.structure[:, 0], scene.structure[:, 4], scene.structure[:, 5]
    eligible = (thickness < MAX_THICKNESS_M) & (width > MIN_WIDTH_M) & (core >= 3)
    seeds = np.flatnonzero(eligible)
    seeds = seeds[np.argsort(thickness[seeds], kind="stable")]
    normals = np.ascontiguousarray(scene.structure[:, 2:4])
    labels = grow_sheets(
        scene.points, normals, seeds, scene.index, scene.half_width_m, grow_radius_m
    )
    order = np.argsort(labels, kind="stable")
    order = order[np.searchsorted(labels[order], 0) :]
    if len(order) == 0:
        return []
    groups = np.split(order, np.flatnonzero(np.diff(labels[order])) + 1)
    sheets = (_fit_sheet(scene, group) for group in groups if len(group) >= MIN_SHEET_VOXELS)
    return [sheet for sheet in sheets if sheet is not None]


def _fit_sheet(scene: Scene, voxels: Int64[np.ndarray, "N"]) -> Sheet | None:
    if np.percentile(scene.heights[voxels], 98) < MIN_SHEET_TOP_M:
        return None
    plan = scene.points[voxels, :2]
    weights = np.ones(len(plan))
    for _ in range(4):
        mean = weights @ plan / weights.sum()
        centred = plan - mean
        vectors = np.linalg.eigh((centred * weights[:, None]).T @ centred)[1]
        residual = centred @ vectors[:, 0]
        weights = 1.0 / (1.0 + (residual / 0.05) ** 2) ** 2
    along, normal = vectors[:, 1], vectors[:, 0]
    positions = plan @ along
    first, last = np.percentile(positions, [1, 99])
    if last - first < MIN_SHEET_LENGTH_M:
        return None
    return Sheet(voxels, along, normal, float(normal @ mean), positions, float(first), float(last))


def _corner(
    scene: Scene, pair: tuple[Sheet, Sheet], min_length_m: float
) -> tuple[Upright, bool, bool] | None:
    one, two = pair
    if abs(one.normal[0] * two.normal[1] - one.normal[1] * two.normal[0]) < MIN_CORNER_SINE:
        return None
    meeting = np.linalg.solve(
        np.array([one.normal, two.normal]), np.array([one.offset, two.offset])
    )
    sides, spans, support = [], [], 0
    for sheet in pair:
        position = float(meeting @ sheet.along)
        to_first, to_last = abs(position - sheet.first), abs(position - sheet.last)
        if min(to_first, to_last) > CORNER_REACH_M:
            return None
        near = sheet.voxels[np.abs(sheet.positions - position) < CORNER_REACH_M + 0.3]
        if len(near) < 5:
            return None
        sides.append(to_last < to_first)
        spans.append(np.percentile(scene.points[near, 2], [2, 98]))
        support += int(scene.counts[near].sum())
    low, high = max(spans[0][0], spans[1][0]), min(spans[0][1], spans[1][1])
    if high - low < min_length_m:
        return None
    edge = _upright(scene, meeting, (low, high), support, 0.7)
    return edge, sides[0], sides[1]


def _end(scene: Scene, sheet: Sheet, at_last: bool, min_length_m: float) -> Upright | None:
    sign = 1.0 if at_last else -1.0
    outward = sign * sheet.positions
    limit = sign * (sheet.last if at_last else sheet.first)
    near = np.flatnonzero(outward > limit - 1.0)
    z = scene.points[sheet.voxels[near], 2]
    slices = np.floor(z / 0.3).astype(np.int64)
    reach = {s: outward[near[slices == s]].max() for s in np.unique(slices)}
    values = np.array(list(reach.values()))
    middle = float(np.median(values))
    good = np.abs(values - middle) < MAX_END_SPREAD_M
    levels = np.array(list(reach.keys()))[good]
    if good.mean() < 0.6 or len(levels) < 3:
        return None
    band = near[(np.abs(outward[near] - middle) < END_BAND_M) & np.isin(slices, levels)]
    low, high = np.percentile(scene.points[sheet.voxels[band], 2], [2, 98])
    if high - low < max(min_length_m, 1.0):
        return None
    place = sheet.normal * sheet.offset + sheet.along * sign * middle
    if _end_is_hidden(scene, sheet.voxels[band], place, sign * sheet.along):
        return None
    support = int(scene.counts[sheet.voxels[band]].sum())
    return _upright(scene, place, (float(low), float(high)), support, 0.5)


def _end_is_hidden(
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
    if abs(turn) < least:
        turn = least if turn >= 0 else -least
    points = scene.points[voxels]
    return hidden_share(scene.ranges, points, azimuth, azimuth + turn, 0.4) > MAX_HIDDEN_SHARE


def _upright(
    scene: Scene,
    place: Float64[np.ndarray, "2"],
    span: tuple[float, float],
    support: int,
    base_score: float,
) -> Upright:
    distance = np.linalg.norm(scene.points[:, :2] - place, axis=1)
    nearest = np.argmin(distance)
    ground = scene.points[nearest, 2] - scene.heights[nearest]
    low, high = span
    endpoints = np.array([[*place, low], [*place, high]], dtype=np.float64)
    score = base_score * (0.5 + 0.5 * min((high - low) / 3.0, 1.0))
    return Upright(endpoints, support, 0.0, low - ground, high - ground, float(score))
