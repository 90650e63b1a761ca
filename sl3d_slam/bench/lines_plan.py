"""What ``bench lines`` compares: line extractors, drives, pairs of scans with their true poses."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sl3d_slam.bench.drives import Drive
from sl3d_slam.bench.pairs import Poses, choose_pairs
from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.lines.extract import LineExtractor

KINDS = ("geometric", "learned")


@dataclass(frozen=True, slots=True)
class LineMethod:
    """One row of the tables: its name, the kind of extractor, and its weights.

    ``weights`` None takes those that ship with the package, where it is a learned one.
    """

    name: str
    kind: str
    weights: Path | None = None


@dataclass(frozen=True, slots=True)
class LinesBench:
    """What is compared, on which pairs.

    Attributes
    ----------
    distances_m : how far apart the scans of a pair are, within 1 m.
    num_pairs : pairs for each distance and drive.
    num_registered : of those at 10 m and more, how many are registered, too.
    truth : ``given`` takes the drives' true poses, ``odometry`` KISS-ICP's.
    """

    drives: Sequence[Drive]
    methods: Sequence[LineMethod]
    distances_m: Sequence[float] = (5.0, 10.0, 20.0, 30.0)
    num_pairs: int = 20
    num_registered: int = 10
    truth: str = "given"
    seed: int = 0
    config: SlamConfig = field(default_factory=SlamConfig)


@dataclass(frozen=True, slots=True)
class PlannedPair:
    """Two scans of a drive; ``registered`` where their registration is tried, too."""

    source: int
    target: int
    registered: bool


def make_methods(names: Sequence[str], weights: Sequence[str]) -> list[LineMethod]:
    """Return the methods to compare: one for each name, and one for each weights file.

    ``weights`` are ``FILE`` or ``NAME=FILE``; with them ``learned`` stands for those files.

    Raises
    ------
    InputError
        where a method is not known, or two have the same name.
    """
    unknown = [name for name in names if name not in KINDS]
    if unknown:
        raise InputError(f"--methods {unknown[0]}: expected some of {', '.join(KINDS)}")
    files = [text.rpartition("=") for text in weights]
    trained = [
        LineMethod(name or Path(file).stem, "learned", Path(file)) for name, _, file in files
    ]
    methods: list[LineMethod] = []
    for name in names:
        if name == "learned" and trained:
            methods += trained
        else:
            methods.append(LineMethod(name, name))
    if trained and "learned" not in names:
        methods += trained
    twice = [m.name for k, m in enumerate(methods) if m.name in [n.name for n in methods[:k]]]
    if twice or not methods:
        raise InputError(f"--methods: {twice[0] if twice else 'none'}: name each method once")
    return methods


def make_extractor(method: LineMethod, config: SlamConfig) -> LineExtractor:
    """Return the extractor of a method; raises an Sl3dError where its weights are not there."""
    weights = None if method.weights is None else str(method.weights)
    return LineExtractor(
        config.lines.model_copy(update={"method": method.kind, "weights": weights})
    )


def choose(bench: LinesBench, poses: Poses, drive: int) -> dict[float, list[PlannedPair]]:
    """Choose the pairs of one drive for each distance at which it has any."""
    rng = np.random.default_rng([bench.seed, drive])
    chosen: dict[float, list[PlannedPair]] = {}
    for distance_m in bench.distances_m:
        along_track = bench.truth == "odometry"
        drawn = choose_pairs([poses], distance_m, bench.num_pairs, rng, along_track)
        count = bench.num_registered if distance_m >= 10.0 else 0
        if drawn:
            chosen[distance_m] = [
                PlannedPair(source, target, k < count)
                for k, (_, source, target) in enumerate(drawn)
            ]
    return chosen
