"""Places by constellation: triangles of standing lines vote for a view and a pose in it.

Every stored view anywhere in the map takes part; neither the odometry nor the time since plays a
role. A matched triangle gives a whole planar pose, so false matches scatter over millions of cells
while the lines of a true revisit agree on one.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float64
from numba import njit

from sl3d_slam.loops.triangles import (
    BIN_M,
    NUM_HEADS,
    all_triangles,
    bucket,
    insert,
    local_triangles,
    sides_m,
    turns_left,
)

NEIGHBOURS = 9
MAX_LINES = 40
SIDE_TOLERANCE_M = 0.35
YAW_CELLS = 60
SHIFT_CELL_M = 2.0
SHIFT_CELLS = 64
NEAR_YAW_RAD = np.radians(6.0)
MAX_VOTES = 400_000


@dataclass(frozen=True, slots=True)
class PlaceVote:
    """One view, and the planar pose (yaw_rad, x_m, y_m) of the query in it with its votes."""

    view_id: int
    pose: tuple[float, float, float]
    votes: float


class ConstellationIndex:
    """All views seen so far, by the triangles of their standing lines.

    A triangle takes 11 bytes: the next one in its slot, the row of its view, three lines of it.
    """

    def __init__(self) -> None:
        self._heads = np.full(NUM_HEADS, -1, np.int32)
        self._links = np.empty(0, np.int32)
        self._owners = np.empty(0, np.int32)
        self._picks = np.empty((0, 3), np.uint8)
        self._num_entries = 0
        self._view_ids = np.empty(0, np.int64)
        self._xy = np.empty((0, MAX_LINES, 2), np.float32)
        self._num_views = 0

    def __len__(self) -> int:
        """Return the number of stored triangles."""
        return self._num_entries

    def add(
        self, view_id: int, xy: Float64[np.ndarray, "V 2"], weights: Float64[np.ndarray, "V"]
    ) -> None:
        """Store the triangles of a view's strongest lines, in its levelled frame."""
        xy = xy[_strongest(weights)]
        triangles = local_triangles(xy, NEIGHBOURS)
        first, last, row = self._num_entries, self._num_entries + len(triangles), self._num_views
        self._links, self._owners, self._picks = (
            _with_room(array, last) for array in (self._links, self._owners, self._picks)
        )
        self._view_ids, self._xy = (_with_room(a, row + 1) for a in (self._view_ids, self._xy))
        self._view_ids[row], self._xy[row, : len(xy)] = view_id, xy
        insert(self._heads, self._links, first, xy, triangles)
        self._owners[first:last], self._picks[first:last] = row, triangles
        self._num_entries, self._num_views = last, row + 1

    def query(
        self,
        xy: Float64[np.ndarray, "V 2"],
        weights: Float64[np.ndarray, "V"],
        newest_view_id: int,
        limit: int,
    ) -> list[PlaceVote]:
        """Return the best-voted pose in each of the best views with id up to ``newest_view_id``."""
        xy = xy[_strongest(weights)]
        poses, owners = _collect(
            xy,
            all_triangles(xy, SIDE_TOLERANCE_M),
            self._heads,
            (self._links, self._owners, self._picks),
            (self._view_ids, self._xy),
            newest_view_id,
        )
        return _best_per_view(poses, owners, limit)


def _with_room(array: np.ndarray, count: int) -> np.ndarray:
    """Return the array, or a copy with room for at least so many rows; fresh rows hold anything."""
    if count <= len(array):
        return array
    grown = np.empty((max(count, 2 * len(array), 64), *array.shape[1:]), array.dtype)
    grown[: len(array)] = array
    return grown


def _strongest(weights: np.ndarray) -> np.ndarray:
    return np.sort(np.argsort(-weights, kind="stable")[:MAX_LINES])


def _best_per_view(poses: np.ndarray, owners: np.ndarray, limit: int) -> list[PlaceVote]:
    """Count votes in overlapping cells, then average the poses around each view's fullest cell."""
    if len(poses) == 0:
        return []
    yaw_cell = np.floor((poses[:, 0] + np.pi) / (2 * np.pi) * YAW_CELLS).astype(np.int64)
    shift_cell = np.floor(poses[:, 1:] / SHIFT_CELL_M).astype(np.int64) + SHIFT_CELLS // 2
    keep = np.all((shift_cell >= 0) & (shift_cell < SHIFT_CELLS), axis=1)
    poses, owners = poses[keep], owners[keep].astype(np.int64)
    if len(poses) == 0:
        return []
    cell = (yaw_cell[keep] % YAW_CELLS) * SHIFT_CELLS + shift_cell[keep, 0]
    key = (owners * YAW_CELLS * SHIFT_CELLS + cell) * SHIFT_CELLS + shift_cell[keep, 1]
    _, first, counts = np.unique(key, return_index=True, return_counts=True)
    fullest = np.argsort(-counts, kind="stable")[: 2 * limit]
    by_owner = np.argsort(owners, kind="stable")
    poses, owners = poses[by_owner], owners[by_owner]
    around = np.empty(len(by_owner), np.int64)
    around[by_owner] = np.arange(len(by_owner))
    best: dict[int, PlaceVote] = {}
    for start in around[first[fullest]]:
        view_id = int(owners[start])
        begin, end = np.searchsorted(owners, [view_id, view_id + 1])
        yaw, x, y, votes = _gather(poses[begin:end], poses[start])
        if view_id not in best or votes > best[view_id].votes:
            best[view_id] = PlaceVote(view_id, (yaw, x, y), votes)
    return sorted(best.values(), key=lambda vote: (-vote.votes, vote.view_id))[:limit]


@njit(cache=True)
@no_type_check
def _gather(poses: np.ndarray, around: np.ndarray) -> tuple[float, float, float, float]:
    """Return the mean of the poses around one (moved there twice), and how many they are."""
    yaw, x, y, count = around[0], around[1], around[2], 0
    for _ in range(2):
        turn_sum, x_sum, y_sum, count = 0.0, 0.0, 0.0, 0
        for p in range(len(poses)):
            turn = (poses[p, 0] - yaw + np.pi) % (2.0 * np.pi) - np.pi
            gap = (poses[p, 1] - x) ** 2 + (poses[p, 2] - y) ** 2
            if abs(turn) < NEAR_YAW_RAD and gap < SHIFT_CELL_M**2:
                turn_sum += turn
                x_sum += poses[p, 1]
                y_sum += poses[p, 2]
                count += 1
        if count > 0:
            yaw, x, y = yaw + turn_sum / count, x_sum / count, y_sum / count
    return yaw, x, y, float(count)


@njit(cache=True)
@no_type_check
def _collect(
    xy: np.ndarray,
    triangles: np.ndarray,
    heads: np.ndarray,
    entries: tuple[np.ndarray, np.ndarray, np.ndarray],
    views: tuple[np.ndarray, np.ndarray],
    newest_view_id: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return a planar pose and a view for each stored triangle that equals one of the query's."""
    links, owners, picks = entries
    view_ids, view_xy = views
    poses, voters = np.empty((MAX_VOTES, 3)), np.empty(MAX_VOTES, np.int32)
    stored = np.empty((3, 2), np.float32)
    n = 0
    slots = np.empty(8, np.int64)
    for t in range(len(triangles)):
        corner = np.stack((xy[triangles[t, 0]], xy[triangles[t, 1]], xy[triangles[t, 2]]))
        _neighbour_slots(corner, slots)
        for s in range(8):
            entry = heads[slots[s]] if np.sum(slots[:s] == slots[s]) == 0 else -1
            while entry >= 0 and n < MAX_VOTES:
                row = owners[entry]
                for k in range(3):
                    stored[k, 0] = view_xy[row, picks[entry, k], 0]
                    stored[k, 1] = view_xy[row, picks[entry, k], 1]
                if view_ids[row] <= newest_view_id and _same_sides(corner, stored):
                    _lay_on(corner, stored, poses[n])
                    voters[n] = view_ids[row]
                    n += 1
                entry = links[entry]
    return poses[:n], voters[:n]


@njit(cache=True)
@no_type_check
def _neighbour_slots(corner: np.ndarray, slots: np.ndarray) -> None:
    """Name the 8 table slots whose cells touch the half-cell cube around a triangle's sides."""
    a, b, c = sides_m(corner, 0, 1, 2)
    left = turns_left(corner, 0, 1, 2)
    side = (a, b, c)
    shift = np.zeros(3, np.int64)
    for s in range(8):
        for axis in range(3):
            cells = side[axis] / BIN_M
            towards = 1 if cells - np.floor(cells) > 0.5 else -1
            shift[axis] = towards * ((s >> axis) & 1)
        slots[s] = bucket(a, b, c, left, shift)


@njit(cache=True)
@no_type_check
def _same_sides(query: np.ndarray, stored: np.ndarray) -> bool:
    if turns_left(query, 0, 1, 2) != turns_left(stored, 0, 1, 2):
        return False
    a, b, c = sides_m(query, 0, 1, 2)
    d, e, f = sides_m(stored, 0, 1, 2)
    return max(abs(a - d), abs(b - e), abs(c - f)) < SIDE_TOLERANCE_M


@njit(cache=True)
@no_type_check
def _lay_on(query: np.ndarray, stored: np.ndarray, pose: np.ndarray) -> None:
    """Write the planar pose (yaw, x, y) that lays one triangle on the other, least squares."""
    qx, qy = np.mean(query[:, 0]), np.mean(query[:, 1])
    sx, sy = np.mean(stored[:, 0]), np.mean(stored[:, 1])
    dot, cross = 0.0, 0.0
    for v in range(3):
        ax, ay = query[v, 0] - qx, query[v, 1] - qy
        bx, by = stored[v, 0] - sx, stored[v, 1] - sy
        dot += ax * bx + ay * by
        cross += ax * by - ay * bx
    pose[0] = np.arctan2(cross, dot)
    cosine, sine = np.cos(pose[0]), np.sin(pose[0])
    pose[1] = sx - (cosine * qx - sine * qy)
    pose[2] = sy - (sine * qx + cosine * qy)
