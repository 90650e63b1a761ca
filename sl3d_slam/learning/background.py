"""What stands beside the shapes of the synthetic stage: clips of scans in which no line is."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import cKDTree

from sl3d_slam.errors import InputError
from sl3d_slam.learning.thinning import voxel_choice
from sl3d_slam.simulation.drive import plan_drive, simulate_drive
from sl3d_slam.simulation.roads import builtin_road
from sl3d_slam.simulation.town import build_town

NUM_CLIPS = 40
CLIP_POINTS = 1000
NUM_SCANS = 8
VOXEL_M = 0.25
CENTRE_RANGE_M = (4.0, 40.0)
MAX_LINE_SHARE = 0.01
MAX_TRIES = 40

Clip = Float64[np.ndarray, "_ 3"]
LabelledScan = tuple[Clip, Int64[np.ndarray, "_"]]


def simulated_clips(seed: int, road: str = "street") -> tuple[Clip, ...]:
    """Return 40 clips of 1,000 points from a street of the simulator.

    Ground, walls, cars, shrubs and crowns as an HDL-64E samples them, thinned to 0.25 m; places
    where the simulator knows of a line are left out.
    """
    drive = plan_drive(build_town(builtin_road(road), seed))
    rng = np.random.default_rng([seed, 40])
    chosen = np.sort(rng.choice(len(drive), min(NUM_SCANS, len(drive)), replace=False))
    scans = ((s.points_lidar, s.line_ids) for s in simulate_drive(drive, chosen.tolist()))
    return cut_clips(list(scans), rng)


def clips_of_scans(scans: Sequence[Clip], seed: int) -> tuple[Clip, ...]:
    """Return 40 clips of 1,000 points from any scans; all of it counts as background.

    Raises
    ------
    InputError
        where the scans are too small for a clip.
    """
    rng = np.random.default_rng([seed, 41])
    return cut_clips([(points, np.full(len(points), -1)) for points in scans], rng)


def cut_clips(scans: Sequence[LabelledScan], rng: np.random.Generator) -> tuple[Clip, ...]:
    """Cut the clips, as many from each scan, centred on their mean."""
    share = -(-NUM_CLIPS // max(len(scans), 1))
    clips = [clip for scan in scans for clip in _clips_of(scan, share, rng)]
    if not clips:
        raise InputError(
            f"background: no place with {CLIP_POINTS} points within {CENTRE_RANGE_M[1]:g} m "
            "in the scans; expected whole sweeps"
        )
    return tuple(clips[:NUM_CLIPS])


def _clips_of(scan: LabelledScan, count: int, rng: np.random.Generator) -> Iterator[Clip]:
    kept = voxel_choice(scan[0], VOXEL_M, rng)
    points, on_line = scan[0][kept], scan[1][kept] >= 0
    ranges = np.hypot(points[:, 0], points[:, 1])
    centres = np.flatnonzero((ranges > CENTRE_RANGE_M[0]) & (ranges < CENTRE_RANGE_M[1]))
    if len(points) < 2 * CLIP_POINTS or len(centres) == 0:
        return
    tree, found = cKDTree(points), 0
    for centre in rng.choice(centres, MAX_TRIES * count):
        near = tree.query(points[centre], 2 * CLIP_POINTS)[1]
        if on_line[near].mean() <= MAX_LINE_SHARE:
            clip = points[near[~on_line[near]][:CLIP_POINTS]]
            yield clip - clip.mean(axis=0)
            found += 1
        if found == count:
            return
