"""The table of triangles against looking at every pair."""

import numpy as np
import pytest

from sl3d_slam.loops.triangle_table import TriangleTable, corners_of, owner_of
from sl3d_slam.loops.triangles import all_triangles, local_triangles, sides_m, turns_left

SLACK_M = 0.35
NUM_OWNERS = 6
PLENTY = 100_000


@pytest.fixture
def stored(rng):
    """Six owners of 14 points and their triangles; two of them nearly the same points."""
    sets = [rng.uniform(-25, 25, (14, 2)).astype(np.float32) for _ in range(NUM_OWNERS - 1)]
    sets.insert(3, (sets[1] + rng.normal(0, 0.1, (14, 2))).astype(np.float32))
    return [(xy, local_triangles(xy.astype(float), 6)) for xy in sets]


def table_of(stored):
    table = TriangleTable()
    for owner, (xy, triangles) in enumerate(stored):
        table.add(owner, xy, triangles)
    return table


def look_at_every_pair(stored, xy, triangles):
    """Owner and corners of every stored triangle that is alike, by row of the query."""
    found = set()
    for row, own in enumerate(triangles):
        for owner, (points, others) in enumerate(stored):
            for other in others:
                gap_m = np.subtract(sides_m(xy, *own), sides_m(points, *other))
                same_sense = turns_left(xy, *own) == turns_left(points, *other)
                if same_sense and np.abs(gap_m).max() < SLACK_M:
                    found.add((row, owner, *other.tolist()))
    return found


def as_set(rows, names):
    return {
        (int(row), owner_of(name), *corners_of(name)) for row, name in zip(rows, names, strict=True)
    }


def test_what_is_alike_is_found_wherever_the_cells_of_the_table_begin(stored, rng):
    table = table_of(stored)
    assert len(table) == sum(len(triangles) for _, triangles in stored)
    xy = stored[1][0] + rng.normal(0, 0.08, (14, 2))
    triangles = all_triangles(xy, SLACK_M)
    expected = look_at_every_pair(stored, xy, triangles)
    assert len(expected) > 2 * len(stored[1][1])
    assert as_set(*table.alike(xy, triangles, NUM_OWNERS, SLACK_M, PLENTY)) == expected


def test_newer_owners_take_no_part_and_no_more_is_found_than_asked_for(stored):
    table, (xy, _) = table_of(stored), stored[1]
    triangles = all_triangles(xy.astype(float), SLACK_M)
    every = as_set(*table.alike(xy.astype(float), triangles, NUM_OWNERS, SLACK_M, PLENTY))
    older = as_set(*table.alike(xy.astype(float), triangles, 3, SLACK_M, PLENTY))
    assert older == {pair for pair in every if pair[1] < 3}
    assert 0 < len(older) < len(every)
    few = table.alike(xy.astype(float), triangles, NUM_OWNERS, SLACK_M, 5)
    assert [len(part) for part in few] == [5, 5]


def test_a_full_cell_goes_on_in_further_blocks():
    """Forty owners of one and the same triangle, which all lie in one cell."""
    xy = np.array([[0.0, 0.0], [0.0, 6.0], [8.0, 0.0]], np.float32)
    table, one = TriangleTable(), all_triangles(xy.astype(float), 0.0)
    for owner in range(40):
        table.add(owner, xy, one)
    found = as_set(*table.alike(xy.astype(float), one, 40, SLACK_M, PLENTY))
    assert found == {(0, owner, *one[0].tolist()) for owner in range(40)}


def test_the_longest_sides_that_triangles_have_are_in_the_table():
    xy = np.array([[0.0, 0.0], [40.0, 0.0], [17.0, 28.0]], np.float32)
    table, one = TriangleTable(), all_triangles(xy.astype(float), 0.0)
    table.add(0, xy, one)
    rows, _ = table.alike(xy.astype(float), one, 1, SLACK_M, PLENTY)
    assert len(one) == 1
    assert len(rows) == 1
