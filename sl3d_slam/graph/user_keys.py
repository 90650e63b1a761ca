"""A user's own keys for keyframes: any integers, in any order; inside, ids count from 0."""

import operator
from dataclasses import replace
from typing import SupportsIndex

import gtsam

from sl3d_slam.errors import GraphError
from sl3d_slam.graph.verdicts import Verdict
from sl3d_slam.types import Rejection

MAP_ID = -1  # the frame of a saved map has a key, too
MAX_KEY = (1 << 64) - 1
FIRST_SYMBOL = 1 << 56  # a gtsam.symbol has its letter in the highest byte


class UserKeys:
    """Keys by id and ids by key."""

    def __init__(self) -> None:
        self._keys: dict[int, int] = {}
        self._ids: dict[int, int] = {}

    def checked(self, key: SupportsIndex) -> int:
        """Return a key that may be added; raises GraphError for a taken one or no integer."""
        try:
            number = operator.index(key)
        except TypeError:
            raise GraphError(f"key {key!r}: expected an integer or a gtsam.symbol") from None
        if not 0 <= number <= MAX_KEY:
            raise GraphError(f"key {number}: expected 0 to 2^64 - 1")
        if number in self._ids:
            raise GraphError(f"key {key_name(number)} was added before; every key must be new")
        return number

    def add(self, item_id: int, key: int) -> None:
        """Give a keyframe (or the map) its key."""
        self._keys[item_id] = key
        self._ids[key] = item_id

    def key(self, item_id: int) -> int:
        """Return the key of an id that was added."""
        return self._keys[item_id]

    def keyframe_id(self, key: int) -> int:
        """Return the id of a keyframe; raises GraphError where the key is not one."""
        item_id = self._ids.get(key, MAP_ID)
        if item_id == MAP_ID:
            raise GraphError(f"key {key_name(key)} is no keyframe; add it before its loops")
        return item_id

    def keyframes(self) -> dict[int, int]:
        """Return the keys of all keyframes by id, in the order they were added."""
        return {item_id: key for item_id, key in self._keys.items() if item_id != MAP_ID}

    def verdict(self, verdict: Verdict) -> Verdict:
        """Express a verdict in keys."""
        ends = self._keys[verdict.loop.target_id], self._keys[verdict.loop.query_id]
        return replace(verdict, loop=replace(verdict.loop, target_id=ends[0], query_id=ends[1]))

    def rejection(self, no: Rejection) -> Rejection:
        """Express a rejection in keys."""
        return replace(no, target_id=self._keys[no.target_id], query_id=self._keys[no.query_id])


def key_name(key: int) -> str:
    """Return how a key reads: 12, or x3 for ``gtsam.symbol("x", 3)``."""
    return str(key) if key < FIRST_SYMBOL else str(gtsam.Symbol(key).string())
