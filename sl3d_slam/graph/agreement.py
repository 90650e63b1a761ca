"""The table of which loops agree with which, grown one loop at a time."""

import numpy as np
from jaxtyping import Bool, Float64

from sl3d_slam.graph.chain import OdometryChain
from sl3d_slam.graph.consistency import LoopArrays, check_pairs, drift_spread

INFORMATIVE = 0.25  # of odometry's variance: predicted at least twice as sharply


class Agreement:
    """Pairwise consistency of loops; members count from 0 in the order they were added.

    ``consistent[i, j]``: the cycle through both closes within the threshold (a squared
    Mahalanobis distance). ``confirms[i, j]``: it closes, and j says much more about i than the
    odometry does; loops far apart are consistent without telling anything about each other.
    """

    def __init__(self, chain: OdometryChain, threshold: float) -> None:
        self._chain = chain
        self._threshold = threshold
        self._consistent = np.zeros((64, 64), dtype=bool)
        self._confirms = np.zeros((64, 64), dtype=bool)
        self._drift = np.zeros(64)
        self._loops = LoopArrays(
            np.zeros(64, np.int64),
            np.zeros(64, np.int64),
            np.zeros((64, 4, 4)),
            np.zeros((64, 6, 6)),
        )
        self._count = 0

    def __len__(self) -> int:
        """Return the number of loops in the table."""
        return self._count

    @property
    def loops(self) -> LoopArrays:
        """Return all members as columns (views)."""
        return self._loops.take(slice(0, self._count))

    @property
    def consistent(self) -> Bool[np.ndarray, "N N"]:
        """Return which loops agree, symmetric with a true diagonal."""
        return self._consistent[: self._count, : self._count]

    @property
    def confirms(self) -> Bool[np.ndarray, "N N"]:
        """Return ``[i, j]``: whether loop j confirms loop i."""
        return self._confirms[: self._count, : self._count]

    def append(self, loop: LoopArrays) -> None:
        """Add one loop (columns of length 1) and compare it with all before."""
        count = self._count
        if count == len(self._drift):
            self._grow()
        squared, spread = check_pairs(self._chain, loop, self.loops)
        drift = drift_spread(self._chain, loop)
        agrees = squared <= self._threshold
        self._set_pairs(count, agrees, spread < INFORMATIVE * float(drift[0]), spread)
        self._drift[count] = drift[0]
        for column, value in zip(_columns(self._loops), _columns(loop), strict=True):
            column[count] = value[0]
        self._count += 1

    def _set_pairs(
        self,
        count: int,
        agrees: Bool[np.ndarray, "N"],
        informed: Bool[np.ndarray, "N"],
        spread: Float64[np.ndarray, "N"],
    ) -> None:
        informs = spread < INFORMATIVE * self._drift[:count]
        self._consistent[count, :count] = agrees
        self._consistent[:count, count] = agrees
        self._consistent[count, count] = True
        self._confirms[count, :count] = agrees & informed
        self._confirms[:count, count] = agrees & informs

    def _grow(self) -> None:
        """Double the room, so that appending costs the same on average however many there are."""
        count = self._count
        self._consistent = np.pad(self._consistent, (0, count))
        self._confirms = np.pad(self._confirms, (0, count))
        self._drift = np.pad(self._drift, (0, count))
        self._loops = LoopArrays(
            *(np.concatenate([column, np.zeros_like(column)]) for column in _columns(self._loops))
        )


def _columns(loops: LoopArrays) -> tuple[np.ndarray, ...]:
    return loops.targets, loops.queries, loops.T_target_query, loops.covariances
