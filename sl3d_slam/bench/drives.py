"""The drives that benchmarks are made on, told to processes in plain words."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sl3d_slam.bench.outback import out_and_back
from sl3d_slam.config import InputSettings, SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.io.dataset import Dataset
from sl3d_slam.io.open import open_dataset
from sl3d_slam.types import Scan


@dataclass(frozen=True, slots=True)
class Drive:
    """One sequence: where it is, which where a dataset has several, how much of it, how driven.

    Attributes
    ----------
    scans : only the first so many; with ``turned_back`` of the one-way drive.
    turned_back : made into a drive that comes back (:mod:`sl3d_slam.bench.outback`).
    """

    data: str
    sequence: str | None = None
    dataset: str = "auto"
    scans: int | None = None
    turned_back: bool = False

    def open(self, settings: InputSettings) -> Dataset:
        """Open it, turned back where asked for. Raises InputError."""
        opened = open_dataset(Path(self.data), settings, self.dataset, self.sequence)
        return out_and_back(opened, self.scans) if self.turned_back else opened

    def count(self, opened: Dataset) -> int:
        """Return how many scans are used."""
        limited = None if self.turned_back else self.scans
        return len(opened) if limited is None else min(limited, len(opened))

    def stream(self, opened: Dataset) -> Iterator[Scan]:
        """Stream the scans that are used."""
        return opened.iterate(0, self.count(opened))


@dataclass(frozen=True, slots=True)
class Comparison:
    """What is compared side by side: the drives, the peers, our settings.

    The peers run with their own defaults.
    """

    drives: Sequence[Drive]
    peers: Sequence[str]
    config: SlamConfig = field(default_factory=SlamConfig)

    def num_steps(self) -> int:
        """Return how many scans this package and all peers will process. Raises InputError."""
        counts = [drive.count(drive.open(self.config.input)) for drive in self.drives]
        return sum(counts) * (1 + len(self.peers))

    def refuse_unknown_peers(self, known: Collection[str]) -> None:
        """Raise InputError where a peer is not among those known."""
        unknown = [peer for peer in self.peers if peer not in known]
        if unknown:
            raise InputError(f"{unknown[0]}: unknown peer; expected some of {', '.join(known)}")
