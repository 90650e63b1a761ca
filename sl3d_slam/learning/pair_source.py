"""The pairs that a training run sees: which ones follows from the seed and the step alone."""

from collections.abc import Sequence

import numpy as np

from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import invert
from sl3d_slam.learning.augment import augment, without_faint_lines
from sl3d_slam.learning.batch import PairBatch, make_batch
from sl3d_slam.learning.joint_settings import JointSettings
from sl3d_slam.learning.pairs import close_pairs, draw_pair, same_lines
from sl3d_slam.learning.prepared import PreparedDrive
from sl3d_slam.lines.network.settings import NetworkSettings


class PairSource:
    """Draws pairs of scans, real and simulated in the share that the settings ask for."""

    def __init__(
        self, drives: Sequence[PreparedDrive], settings: JointSettings, network: NetworkSettings
    ) -> None:
        """Find all pairs of all drives.

        Raises
        ------
        InputError
            where no drive has two scans close enough.
        """
        self._settings, self._network = settings, network
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
            np.linalg.norm(np.diff(drive.T_world_lidar[index, :3, 3], axis=1)[:, 0], axis=1)
            for drive, index in zip(self._drives, self._pairs, strict=True)
        ]

    @property
    def num_pairs(self) -> int:
        """How many pairs there are to draw from."""
        return sum(map(len, self._pairs))

    def draw(self, number: int) -> PairBatch:
        """Return pair ``number`` of the run, augmented."""
        rng = np.random.default_rng([self._settings.seed, number])
        drive, first, second = self._draw_scans(rng)
        chosen = self._drives[drive]
        T_first_second = invert(chosen.T_world_lidar[first]) @ chosen.T_world_lidar[second]
        scans = (chosen.scans[first], chosen.scans[second])
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

    def _draw_scans(self, rng: np.random.Generator) -> tuple[int, int, int]:
        """Draw a drive (more scans, more often, real and simulated apart), then a pair of it."""
        simulated = np.array([drive.simulated for drive in self._drives])
        weights = np.sqrt([len(drive.scans) for drive in self._drives])
        if simulated.any() and not simulated.all():
            share = self._settings.real_share
            weights[~simulated] *= share / weights[~simulated].sum()
            weights[simulated] *= (1.0 - share) / weights[simulated].sum()
        drive = int(rng.choice(len(weights), p=weights / weights.sum()))
        wanted_m = rng.uniform(0.0, self._settings.max_pair_distance_m)
        first, second = draw_pair(self._pairs[drive], self._gaps_m[drive], wanted_m, rng)
        return drive, first, second
