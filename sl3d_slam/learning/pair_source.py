"""The pairs that a training run sees: which ones follows from the seed and the step alone."""

from collections.abc import Sequence

import numpy as np

from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Transform, invert
from sl3d_slam.learning.augment import augment, without_faint_lines
from sl3d_slam.learning.batch import PairBatch, make_batch
from sl3d_slam.learning.joint_settings import JointSettings
from sl3d_slam.learning.pairs import close_pairs, draw_pair, gaps_of, same_lines
from sl3d_slam.learning.prepared import PreparedDrive, PreparedScan
from sl3d_slam.learning.virtual_view import draw_places, two_views
from sl3d_slam.lines.network.settings import NetworkSettings

Pair = tuple[tuple[PreparedScan, PreparedScan], Transform]


class PairSource:
    """Draws pairs of scans, real and simulated in the share that the settings ask for.

    ``singles`` are scans of unrelated places: each makes pairs by itself, as seen from two places.
    """

    def __init__(
        self,
        drives: Sequence[PreparedDrive],
        settings: JointSettings,
        network: NetworkSettings,
        singles: Sequence[PreparedDrive] = (),
    ) -> None:
        """Find all pairs of all drives.

        Raises
        ------
        InputError
            where no drive has two scans close enough.
        """
        self._settings, self._network = settings, network
        self._singles = [scan for drive in singles for scan in drive.scans]
        pairs = [close_pairs(d.T_world_lidar, settings.max_pair_distance_m) for d in drives]
        usable = [k for k in range(len(drives)) if len(pairs[k])]
        if not usable:
            raise InputError(
                f"no two scans of one drive lie within {settings.max_pair_distance_m:g} m; "
                "expected a drive of overlapping scans"
            )
        self._drives = [drives[k] for k in usable]
        self._pairs = [pairs[k] for k in usable]
        self._gaps_m = [
            gaps_of(drive.T_world_lidar, index)
            for drive, index in zip(self._drives, self._pairs, strict=True)
        ]

    @property
    def num_pairs(self) -> int:
        """How many pairs there are to draw from; a single scan counts as one."""
        return sum(map(len, self._pairs)) + len(self._singles)

    def draw(self, number: int) -> PairBatch:
        """Return pair ``number`` of the run, augmented."""
        rng = np.random.default_rng([self._settings.seed, number])
        scans, T_first_second = self._draw_pair(rng)
        matches = same_lines(
            scans[0].endpoints, scans[1].endpoints, T_first_second, self._settings.match_distance_m
        )
        mirrored = bool(rng.random() < 0.5)
        changed = [
            without_faint_lines(
                augment(scan, self._settings.augment, self._settings.points, mirrored, rng),
                self._settings.min_line_points,
            )
            for scan in scans
        ]
        return make_batch(changed[0], changed[1], matches, self._network)

    def _draw_pair(self, rng: np.random.Generator) -> Pair:
        """Draw a drive (more scans, more often, real and simulated apart), then a pair of it."""
        simulated = np.array([*(drive.simulated for drive in self._drives), False])
        weights = np.sqrt([*(len(drive.scans) for drive in self._drives), len(self._singles) ** 2])
        if simulated.any() and weights[~simulated].any():
            share = self._settings.real_share
            weights[~simulated] *= share / weights[~simulated].sum()
            weights[simulated] *= (1.0 - share) / weights[simulated].sum()
        drive = int(rng.choice(len(weights), p=weights / weights.sum()))
        wanted_m = rng.uniform(0.0, self._settings.max_pair_distance_m)
        if drive == len(self._drives):
            scan = self._singles[int(rng.integers(len(self._singles)))]
            return two_views(scan, draw_places(wanted_m, rng), rng)
        first, second = draw_pair(self._pairs[drive], self._gaps_m[drive], wanted_m, rng)
        chosen = self._drives[drive]
        T_first_second = invert(chosen.T_world_lidar[first]) @ chosen.T_world_lidar[second]
        return (chosen.scans[first], chosen.scans[second]), T_first_second
