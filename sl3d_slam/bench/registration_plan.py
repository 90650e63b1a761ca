"""Which pairs ``bench registration`` registers: how they are asked for, and the choice."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sl3d_slam.bench.drives import Drive
from sl3d_slam.bench.pairs import (
    Poses,
    PosesOfAny,
    ScanPair,
    choose_pairs,
    random_turn,
    read_pair_list,
)
from sl3d_slam.bench.registration_methods import OURS, PEERS
from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Transform, invert
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.odometry.odometry import Odometry


@dataclass(frozen=True, slots=True)
class RegistrationBench:
    """What is compared, on which pairs.

    Attributes
    ----------
    drives : what pairs come from.
    distances_m : how far apart the scans of a pair are, within 1 m.
    num_pairs : pairs for each distance, over all drives together.
    peer_pairs : peers register the first so many of each distance, as evenly from the drives as all
        are; None lets them register all.
    pair_list : a public list of pairs, taken in place of ``distances_m``; ``drives`` then holds one
        KITTI root that has its sequences.
    different : drives through other places: their scans against those of ``drives``.
    truth : ``given`` takes the drives' true poses; ``odometry`` takes KISS-ICP's, which are better
        over tens of metres than a GPS, and leaves out pairs with much travel between them.
    tilt_deg : roll and pitch of both sensors, each up to this either way.
    iterations : RANSAC with so many iterations each, for a curve.
    """

    drives: Sequence[Drive]
    distances_m: Sequence[float] = (10.0, 20.0, 30.0, 40.0)
    num_pairs: int = 200
    peer_pairs: int | None = None
    seed: int = 0
    peers: Sequence[str] = PEERS
    pair_list: Path | None = None
    different: Sequence[Drive] = ()
    truth: str = "given"
    tilt_deg: float = 0.0
    iterations: Sequence[int] = ()
    config: SlamConfig = field(default_factory=SlamConfig)

    @property
    def processes(self) -> list[tuple[str, ...]]:
        """The methods of each process; ours share one and come first."""
        return [OURS, *((peer,) for peer in self.peers), *((name,) for name in self._curve)]

    @property
    def _curve(self) -> list[str]:
        return [f"fpfh-ransac@{n}" for n in self.iterations]

    def pairs_for(self, methods: Sequence[str], pairs: Sequence[ScanPair]) -> Sequence[ScanPair]:
        """Return which of a group's pairs the methods of one process register."""
        return pairs if tuple(methods) == OURS else pairs[: self.peer_pairs]

    def num_steps(self, plan: "Plan") -> int:
        """Return over how many pairs the processes go, all together."""
        return sum(
            len(self.pairs_for(methods, group.pairs))
            for methods in self.processes
            for group in plan.groups
        )


@dataclass(frozen=True, slots=True, eq=False)
class PairGroup:
    """Pairs that are counted together."""

    name: str
    pairs: list[ScanPair]


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """All pairs of a benchmark and the drives that their scans come from."""

    places: Mapping[int, Drive]
    groups: Sequence[PairGroup]
    simulated: bool


def make_plan(bench: RegistrationBench) -> Plan:
    """Choose the pairs; the same seed chooses the same ones.

    Raises
    ------
    InputError
        where a drive or list cannot be read, a peer is unknown, or no pair is so far apart.
    """
    unknown = [peer for peer in bench.peers if peer not in PEERS]
    if unknown:
        raise InputError(f"{unknown[0]}: unknown peer; expected some of {', '.join(PEERS)}")
    rng = np.random.default_rng(bench.seed)
    if bench.pair_list is not None:
        return _listed(bench, bench.pair_list, rng)
    opened = [drive.open(bench.config.input) for drive in bench.drives]
    poses = [poses_of(drive, bench.truth, bench.config) for drive in opened]
    groups = [
        PairGroup(f"{distance_m:g} m", _apart(poses, distance_m, bench, rng))
        for distance_m in bench.distances_m
    ]
    places = dict(enumerate(bench.drives))
    if bench.different:
        places = dict(enumerate([*bench.drives, *bench.different]))
        others = [drive.open(bench.config.input) for drive in bench.different]
        groups.append(PairGroup("different places", _different(opened, others, bench, rng)))
    return Plan(places, groups, any(drive.simulated for drive in opened))


def _listed(bench: RegistrationBench, path: Path, rng: np.random.Generator) -> Plan:
    if len(bench.drives) != 1:
        raise InputError(f"{path}: a list of pairs needs one KITTI root with its sequences")
    pairs = [
        ScanPair(first, i, second, j, T, *_turns(bench, rng))
        for first, i, second, j, T in read_pair_list(path)
    ]
    if bench.num_pairs < len(pairs):
        chosen = np.sort(rng.choice(len(pairs), bench.num_pairs, replace=False))
        pairs = [pairs[k] for k in chosen]
    numbers = sorted({n for pair in pairs for n in (pair.source_drive, pair.target_drive)})
    places: dict[int, Drive] = {
        number: replace(bench.drives[0], sequence=f"{number:02d}") for number in numbers
    }
    opened = [drive.open(bench.config.input) for drive in places.values()]
    simulated = any(drive.simulated for drive in opened)
    return Plan(places, [PairGroup(path.stem, pairs)], simulated)


def _apart(
    poses: Sequence[PosesOfAny],
    distance_m: float,
    bench: RegistrationBench,
    rng: np.random.Generator,
) -> list[ScanPair]:
    along_track = bench.truth == "odometry"
    chosen = choose_pairs(poses, distance_m, bench.num_pairs, rng, along_track)
    if not chosen:
        raise InputError(f"--distances {distance_m:g}: no two scans are so far apart")
    return [
        ScanPair(
            drive,
            source,
            drive,
            target,
            invert(poses[drive][target]) @ poses[drive][source],
            *_turns(bench, rng),
        )
        for drive, source, target in chosen
    ]


def _different(
    opened: Sequence[Dataset],
    others: Sequence[Dataset],
    bench: RegistrationBench,
    rng: np.random.Generator,
) -> list[ScanPair]:
    """Return scans of either side's drives, each drive as often as the others of its side."""
    pairs = []
    for k in range(bench.num_pairs):
        drive, place = int(rng.integers(len(opened))), k % len(others)
        source, target = (
            int(rng.integers(len(opened[drive]))),
            int(rng.integers(len(others[place]))),
        )
        other = len(opened) + place
        pairs.append(ScanPair(drive, source, other, target, None, *_turns(bench, rng)))
    return pairs


def _turns(bench: RegistrationBench, rng: np.random.Generator) -> tuple[Transform, Transform]:
    source = random_turn(rng, True, bench.tilt_deg)
    return source, random_turn(rng, False, bench.tilt_deg)


def poses_of(drive: Dataset, truth: str, config: SlamConfig) -> Poses:
    """Return the drive's true poses (``given``) or KISS-ICP's (``odometry``).

    Raises
    ------
    InputError
        where ``truth`` is neither, or the drive has no true poses.
    """
    if truth not in ("given", "odometry"):
        raise InputError(f"--truth {truth}: expected given or odometry")
    if truth == "odometry":
        odometry = Odometry(config.odometry, config.input)
        return np.array([odometry.register(scan).T_odom_lidar for scan in drive])
    if drive.truth is None:
        raise InputError(f"{drive.name}: has no true poses; --truth odometry does without")
    return drive.truth
