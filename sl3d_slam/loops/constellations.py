"""Places by constellation: triangles of standing lines vote for a view and a pose in it.

Every stored view anywhere in the map takes part; neither the odometry nor the time since plays a
role. A matched triangle gives a whole planar pose, so false matches scatter over millions of cells
while the lines of a true revisit agree on one. Asked for are the triangles that are stored, those
of neighbouring lines: with any three lines of a scan asking takes twice as long, and recognises
288 in place of 290 loops of a simulated town on KITTI 00's roads.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float64, Int64
from numba import njit

from sl3d_slam.loops.triangle_table import TriangleTable, corners_of, owner_of, with_room
from sl3d_slam.loops.triangles import local_triangles

NEIGHBOURS = 9
MAX_LINES = 40
SIDE_TOLERANCE_M = 0.35
YAW_CELLS = 60
SHIFT_CELL_M = 2.0
SHIFT_CELLS = 64
NEAR_YAW_RAD = np.radians(6.0)
CELLS_PER_VIEW = YAW_CELLS * SHIFT_CELLS**2
MAX_VOTES = 400_000
VOTE_BITS = 19
VOTE_ROOM = 1 << VOTE_BITS


@dataclass(frozen=True, slots=True)
class PlaceVote:
    """One view, and the planar pose (yaw_rad, x_m, y_m) of the query in it with its votes."""

    view_id: int
    pose: tuple[float, float, float]
    votes: float


class ConstellationIndex:
    """All views seen so far, by the triangles of their standing lines."""

    def __init__(self) -> None:
        self._table = TriangleTable()
        self._view_ids = np.empty(0, np.int64)
        self._xy = np.empty((0, MAX_LINES, 2), np.float32)
        self._num_views = 0

    def __len__(self) -> int:
        """Return the number of stored triangles."""
        return len(self._table)

    def add(
        self, view_id: int, xy: Float64[np.ndarray, "V 2"], weights: Float64[np.ndarray, "V"]
    ) -> None:
        """Store the triangles of a view's strongest lines, in its levelled frame; ids grow."""
        xy = xy[_strongest(weights)]
        row = self._num_views
        self._view_ids, self._xy = (with_room(a, row + 1) for a in (self._view_ids, self._xy))
        self._view_ids[row], self._xy[row, : len(xy)] = view_id, xy
        triangles = local_triangles(xy, NEIGHBOURS)
        self._table.add(row, self._xy[row, : len(xy)], triangles)
        self._num_views = row + 1

    def query(
        self,
        xy: Float64[np.ndarray, "V 2"],
        weights: Float64[np.ndarray, "V"],
        newest_view_id: int,
        limit: int,
    ) -> list[PlaceVote]:
        """Return the best-voted pose in each of the best views with id up to ``newest_view_id``."""
        xy = xy[_strongest(weights)]
        num_old = int(np.searchsorted(self._view_ids[: self._num_views], newest_view_id, "right"))
        triangles = local_triangles(xy, NEIGHBOURS, SIDE_TOLERANCE_M)
        alike = self._table.alike(xy, triangles, num_old, SIDE_TOLERANCE_M, MAX_VOTES)
        poses, keys = _lay_all(xy, triangles, *alike, self._xy)
        return _best_per_view(poses, np.sort(keys[keys >= 0]), self._view_ids, limit)


def _strongest(weights: np.ndarray) -> np.ndarray:
    return np.sort(np.argsort(-weights, kind="stable")[:MAX_LINES])


def _best_per_view(
    poses: Float64[np.ndarray, "T 3"],
    sorted_keys: Int64[np.ndarray, "K"],
    view_ids: Int64[np.ndarray, "V"],
    limit: int,
) -> list[PlaceVote]:
    """Count votes by cell, then average the poses around the first vote of each fullest cell."""
    if len(sorted_keys) == 0:
        return []
    votes, cells = sorted_keys & (VOTE_ROOM - 1), sorted_keys >> VOTE_BITS
    starts = np.flatnonzero(np.r_[True, cells[1:] != cells[:-1]])
    counts = np.diff(np.r_[starts, len(cells)])
    owners = cells // CELLS_PER_VIEW
    best: dict[int, PlaceVote] = {}
    for start in starts[np.argsort(-counts, kind="stable")[: 2 * limit]]:
        owner = int(owners[start])
        begin, end = np.searchsorted(owners, [owner, owner + 1])
        yaw, x, y, num_votes = _gather(poses, votes[begin:end], poses[votes[start]])
        view_id = int(view_ids[owner])
        if view_id not in best or num_votes > best[view_id].votes:
            best[view_id] = PlaceVote(view_id, (yaw, x, y), num_votes)
    return sorted(best.values(), key=lambda vote: (-vote.votes, vote.view_id))[:limit]


@njit(cache=True)
@no_type_check
def _gather(
    poses: np.ndarray, votes: np.ndarray, around: np.ndarray
) -> tuple[float, float, float, float]:
    """Return the mean of the votes' poses around one (moved there twice), and how many they are."""
    yaw, x, y, count = around[0], around[1], around[2], 0
    for _ in range(2):
        turn_sum, x_sum, y_sum, count = 0.0, 0.0, 0.0, 0
        for vote in votes:
            turn = (poses[vote, 0] - yaw + np.pi) % (2.0 * np.pi) - np.pi
            gap = (poses[vote, 1] - x) ** 2 + (poses[vote, 2] - y) ** 2
            if abs(turn) < NEAR_YAW_RAD and gap < SHIFT_CELL_M**2:
                turn_sum += turn
                x_sum += poses[vote, 1]
                y_sum += poses[vote, 2]
                count += 1
        if count > 0:
            yaw, x, y = yaw + turn_sum / count, x_sum / count, y_sum / count
    return yaw, x, y, float(count)


@njit(cache=True)
@no_type_check
def _lay_all(
    xy: np.ndarray,
    triangles: np.ndarray,
    rows: np.ndarray,
    names: np.ndarray,
    view_xy: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return for each pair of triangles the planar pose that lays the query on the view.

    Also a key of owner, cell of the pose and number of the pair; -1 where the pose is too far off.
    """
    poses, keys = np.empty((len(rows), 3)), np.empty(len(rows), np.int64)
    for n in range(len(rows)):
        i, j, k = triangles[rows[n], 0], triangles[rows[n], 1], triangles[rows[n], 2]
        owner, (u, v, w) = owner_of(names[n]), corners_of(names[n])
        stored = view_xy[owner]
        qx, qy = (xy[i, 0] + xy[j, 0] + xy[k, 0]) / 3.0, (xy[i, 1] + xy[j, 1] + xy[k, 1]) / 3.0
        sx = (stored[u, 0] + stored[v, 0] + stored[w, 0]) / 3.0
        sy = (stored[u, 1] + stored[v, 1] + stored[w, 1]) / 3.0
        dot, cross = 0.0, 0.0
        for q, s in ((i, u), (j, v), (k, w)):
            ax, ay = xy[q, 0] - qx, xy[q, 1] - qy
            bx, by = stored[s, 0] - sx, stored[s, 1] - sy
            dot += ax * bx + ay * by
            cross += ax * by - ay * bx
        length = np.sqrt(dot * dot + cross * cross)
        cosine, sine = dot / length, cross / length
        poses[n, 0] = np.arctan2(cross, dot)
        poses[n, 1] = sx - (cosine * qx - sine * qy)
        poses[n, 2] = sy - (sine * qx + cosine * qy)
        keys[n] = _key(owner, poses[n], n)
    return poses, keys


@njit(cache=True)
@no_type_check
def _key(owner: int, pose: np.ndarray, number: int) -> int:
    """Return owner, cell of the pose and number of a vote in one integer; -1 for a far pose."""
    turn = int(np.floor((pose[0] + np.pi) / (2 * np.pi) * YAW_CELLS)) % YAW_CELLS
    u = int(np.floor(pose[1] / SHIFT_CELL_M)) + SHIFT_CELLS // 2
    v = int(np.floor(pose[2] / SHIFT_CELL_M)) + SHIFT_CELLS // 2
    if not (0 <= u < SHIFT_CELLS and 0 <= v < SHIFT_CELLS):
        return -1
    cell = (turn * SHIFT_CELLS + u) * SHIFT_CELLS + v
    return ((owner * CELLS_PER_VIEW + cell) << VOTE_BITS) + number
