"""Figures of line extractors on hand-made lines whose right values are known."""

import math
import time
from collections import Counter

import numpy as np
import pytest

from sl3d_slam.bench.drives import Drive
from sl3d_slam.bench.extract import compared
from sl3d_slam.bench.extract_stages import STAGES, Stopwatch
from sl3d_slam.bench.lines import run
from sl3d_slam.bench.lines_agreement import agreeing_pairs, gaps_m, partner_ranks
from sl3d_slam.bench.lines_figures import PairCounts, pair_figures, scan_figures
from sl3d_slam.bench.lines_plan import LineMethod, LinesBench, make_methods
from sl3d_slam.bench.lines_scans import SeenScan, best, count_pair
from sl3d_slam.bench.lines_sight import is_seen, sight_of
from sl3d_slam.bench.lines_truth import (
    TrueScan,
    count_scan,
    false_ones_on,
    open_truth,
    visible_lines,
)
from sl3d_slam.config import LineSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import from_yaw, invert
from sl3d_slam.simulation.primitives import Semantic
from sl3d_slam.types import LineSet

T_TARGET_SOURCE = from_yaw(0.4, np.array([6.0, -2.0, 0.1]))


def upright(x, y, low=-1.0, high=1.0, lean_deg=0.0):
    """A standing line; it leans along x."""
    aside = (high - low) * math.tan(math.radians(lean_deg))
    return [[x, y, low], [x + aside, y, high]]


def line_set(endpoints, descriptors=None, scores=None):
    endpoints = np.array(endpoints, float).reshape(-1, 2, 3)
    if descriptors is None:
        descriptors = np.eye(max(len(endpoints), 1), 32)[: len(endpoints)]
    if scores is None:
        scores = np.ones(len(endpoints))
    return LineSet(
        endpoints,
        np.asarray(descriptors, np.float32),
        np.full(len(endpoints), 9),
        scores=np.asarray(scores, np.float32),
    )


def room(radius_m=30.0, azimuths_deg=(0.0, 360.0), elevations_deg=(-20.0, 10.0)):
    """Returns on a far round wall, dense enough for every bin of the view."""
    azimuth = np.radians(np.arange(azimuths_deg[0], azimuths_deg[1], 0.2))
    elevation = np.radians(np.arange(elevations_deg[0], elevations_deg[1], 0.4))
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation))
    return radius_m * np.column_stack([np.cos(a), np.sin(a), np.tan(e)])


def seen_scan(points, **found):
    """A scan in which each method found the lines given, all of them compared."""
    return SeenScan(sight_of(points), np.zeros((0, 3), np.float32), found, found)


def test_distance_is_taken_where_both_lines_are():
    first = np.array([upright(0.0, 0.0, 0.0, 4.0)])
    second = np.array(
        [
            upright(0.2, 0.0, 3.0, 5.0),  # shares the stretch from 3 to 4 m
            upright(0.0, 0.1, 4.8, 6.0),  # 0.8 m above the end of the first
            upright(0.0, 0.1, 5.2, 6.0),  # 1.2 m above: may be anything
            upright(0.0, 0.0, 1.0, 3.0, lean_deg=6.0),
            upright(-0.5 * 3 * math.tan(math.radians(4.0)), 0.0, 0.0, 3.0, lean_deg=4.0),
        ]
    )
    measured = gaps_m(first, second)[0]
    assert measured[:2] == pytest.approx([0.2, 0.1], abs=1e-9)
    assert np.isinf(measured[2:4]).all()
    assert measured[4] == pytest.approx(
        0.0, abs=1e-9
    )  # they cross in the middle of what they share


def test_order_of_end_points_and_the_frame_do_not_matter(rng):
    first = np.array(
        [upright(*rng.uniform(-9, 9, 2), lean_deg=rng.uniform(0, 4)) for _ in range(9)]
    )
    second = first + rng.normal(0.0, 0.05, (9, 1, 3))
    there = gaps_m(first, second)
    T = from_yaw(1.1, np.array([3.0, -7.0, 2.0]))
    moved = (line_set(part).transformed(T).endpoints for part in (first, second))
    np.testing.assert_allclose(gaps_m(*moved), there, atol=1e-9)
    np.testing.assert_allclose(gaps_m(first[:, ::-1], second[:, ::-1]), there, atol=1e-9)


def test_a_line_has_one_partner_at_most():
    first = np.array([upright(0.0, 0.0)])
    second = np.array([upright(0.25, 0.0), upright(0.1, 0.0), upright(0.35, 5.0)])
    assert agreeing_pairs(gaps_m(first, second)).tolist() == [[0, 1]]
    assert agreeing_pairs(gaps_m(second, first)).tolist() == [[1, 0]]
    assert agreeing_pairs(gaps_m(first, second[:0])).shape == (0, 2)


def test_ranks_count_those_that_are_as_near():
    first = np.array([[1.0, 0.0]], np.float32)
    second = np.array([[0.9, 0.1], [0.8, 0.2], [0.95, 0.0]], np.float32)
    pairs = np.array([[0, 0]])
    assert partner_ranks(first, second, pairs).tolist() == [2]
    saying_nothing = np.ones((3, 2), np.float32)
    assert partner_ranks(first, saying_nothing, pairs).tolist() == [3]


def test_lines_behind_a_wall_out_of_range_or_out_of_view_are_not_seen():
    wall = room(10.0, (-5.0, 5.0))
    sight = sight_of(np.concatenate([room(60.0), wall]))
    at = math.radians(20.0)
    lines = np.array(
        [
            upright(9.8, 0.0),  # before the wall
            upright(10.4, 0.0),  # in it
            upright(15.0, 0.0),  # behind it
            upright(15.0 * math.cos(at), 15.0 * math.sin(at)),  # beside it
            upright(0.0, 39.0),
            upright(0.0, 41.0),
            upright(0.0, 10.0, 2.5, 6.0),  # above the field of view of 10 degrees
            upright(0.0, 10.0, -1.0, 6.0),  # the lower half of it is within
        ]
    )
    expected = [True, True, False, True, True, False, False, True]
    assert is_seen(sight, lines).tolist() == expected


def test_a_line_that_looks_over_a_hedge_is_seen_once_a_metre_shows():
    hedge = room(8.0, (-5.0, 5.0), (-20.0, 0.0))
    sight = sight_of(np.concatenate([room(60.0), hedge]))
    lines = np.array([upright(20.0, 0.0, -2.0, high) for high in (0.8, 1.4)])
    assert is_seen(sight, lines).tolist() == [False, True]


def test_two_scans_with_known_lines_give_exactly_these_counts():
    """Six true lines; the target misses one, moves one by 0.5 m, adds one, hides one."""
    places = [(8.0, 0.0), (0.0, 9.0), (-7.0, 3.0), (-5.0, -8.0), (6.0, -6.0), (12.0, 8.0)]
    in_target = line_set([upright(*place) for place in places])
    source_lines = in_target.transformed(invert(T_TARGET_SOURCE))
    kept = in_target.endpoints[:4].copy()
    kept[3] += [0.5, 0.0, 0.0]
    added = np.array([upright(20.0, 20.0)])
    target_lines = line_set(
        np.concatenate([kept, added]),
        np.eye(32)[[0, 2, 1, 3, 9]],  # 1 and 2 are taken for each other
    )
    hiding = math.degrees(math.atan2(8.0, 12.0))
    screen = room(5.0, (hiding - 6.0, hiding + 6.0))
    source = seen_scan(room(60.0), a=source_lines)
    target = seen_scan(np.concatenate([room(60.0), screen]), a=target_lines)
    counts = count_pair(source, target, "a", T_TARGET_SOURCE)
    assert (counts.found, counts.used) == (11, 11)
    assert counts.seen == 5 + 5  # all but the screened one; all of the target's from the source
    assert counts.again == 3 + 3
    assert counts.matches == 6
    assert counts.first == 2  # line 0, both ways
    assert counts.chance_first == pytest.approx(3 / 6 + 3 / 5)
    assert counts.chance_top == pytest.approx(3 * 5 / 6 + 3)
    row = pair_figures([counts])
    assert row["repeat_percent"] == pytest.approx(60.0)
    assert row["first_percent"] == pytest.approx(100 / 3)
    assert row["found_per_scan"] == 5.5


def test_wrong_direction_of_the_transform_finds_nothing_again():
    lines = line_set([upright(8.0, 0.0), upright(0.0, 9.0), upright(-7.0, 3.0)])
    source = seen_scan(room(60.0), a=lines.transformed(invert(T_TARGET_SOURCE)))
    target = seen_scan(room(60.0), a=lines)
    assert count_pair(source, target, "a", T_TARGET_SOURCE).again == 6
    assert count_pair(source, target, "a", invert(T_TARGET_SOURCE)).again == 0


def test_scans_without_lines_count_as_nothing():
    empty = seen_scan(room(60.0), a=line_set([], np.zeros((0, 32))))
    full = seen_scan(room(60.0), a=line_set([upright(8.0, 0.0)]))
    counts = count_pair(empty, full, "a", np.eye(4))
    assert (counts.seen, counts.again, counts.matches) == (1, 0, 0)
    row = pair_figures([counts])
    assert row["repeat_percent"] == 0.0
    assert row["top"] is None


def pair_counts(seen, again, **more):
    numbers = dict.fromkeys(PairCounts._fields, 0.0) | {"seen": seen, "again": again} | more
    return PairCounts(**numbers)


def test_spread_of_a_share_is_that_of_its_pairs(rng):
    """With pairs of 10 lines each and share p the spread is sqrt(p (1 - p) / lines)."""
    again = rng.binomial(10, 0.3, 400)
    row = pair_figures([pair_counts(10, k) for k in again])
    assert row["repeat_percent"] == pytest.approx(again.mean() * 10)
    # the spread itself is known to 1 / sqrt(2 * 400) = 3.5 %; 4 sigma
    assert row["repeat_spread"] == pytest.approx(100 * math.sqrt(0.21 / 4000), rel=0.15)


def test_gain_on_the_same_pairs_has_no_spread_where_every_pair_gains_alike(rng):
    again = rng.integers(1, 6, 50)
    first = [pair_counts(10, k) for k in again]
    better = [pair_counts(10, k + 2) for k in again]
    row = pair_figures(better, first)
    assert row["repeat_gain_percent"] == pytest.approx(20.0)
    assert row["repeat_gain_spread"] == pytest.approx(0.0, abs=1e-9)
    assert row["repeat_spread"] > 1.0


def test_ten_of_ten_registrations_still_leave_a_doubt():
    row = pair_figures([pair_counts(1, 1, tried=1.0, dense=1.0)] * 10 + [pair_counts(1, 1)] * 5)
    assert row["num_registered"] == 10
    assert row["registered_percent"] == 100.0
    assert row["registered_alone_percent"] == 0.0
    # standard deviation of Beta(11, 1)
    assert row["registered_spread"] == pytest.approx(100 * math.sqrt(11 / (144 * 13)))


def test_equally_many_lines_are_the_best_by_score():
    lines = line_set([upright(k, 0.0) for k in range(4)], scores=[0.2, 0.9, 0.9, 0.5])
    assert best(lines, 2).endpoints[:, 0, 0].tolist() == [1.0, 2.0]
    assert len(best(lines, 9)) == 4


def test_true_lines_count_as_visible_by_returns_range_and_extent():
    lines = np.array([upright(k, 5.0, 0.0, 4.0) for k in (0.0, 1.0, 2.0)] + [upright(41.0, 0.0)])
    heights = np.linspace(0.0, 0.9, 5)
    columns = [(0.0, 5.0, heights), (1.0, 5.0, heights[:4]), (2.0, 5.0, heights * 0.8)]
    columns.append((41.0, 0.0, heights))
    points = np.concatenate([[[x, y, z] for z in zs] for x, y, zs in columns])
    ids = np.repeat(np.arange(4), [5, 4, 5, 5])
    noise = np.array([[3.0, 3.0, 0.0]])
    seen = visible_lines(lines, np.concatenate([points, noise]), np.append(ids, -1))
    assert seen.tolist() == [True, False, False, False]


def test_precision_and_recall_against_true_lines():
    lying = [[10.0, 0.0, 3.0], [14.0, 0.0, 3.0]]
    truth = TrueScan(
        np.array([upright(5.0, 0.0), upright(0.0, 5.0), lying, upright(-5.0, 0.0)]),
        np.array([True, True, True, False]),
        np.array([[20.0, 0.0, 0.0], [20.1, 0.0, 0.5], [20.0, 0.1, 0.9]]),
        np.array([Semantic.VEGETATION, Semantic.VEGETATION, Semantic.CAR]),
    )
    found = line_set([upright(5.1, 0.0), upright(20.0, 0.0), upright(-5.0, 0.1), upright(9.0, 9.0)])
    counts = count_scan(truth, found.take(np.arange(2)), found)
    assert (counts.used, counts.right) == (2, 1)
    assert (counts.visible, counts.hit) == (3, 1)
    assert (counts.visible_standing, counts.hit_standing) == (2, 1)
    assert (counts.found, counts.found_right, counts.hit_by_all) == (4, 2, 1)
    assert false_ones_on(truth, found) == Counter(vegetation=1, nothing=1)
    row = scan_figures([counts])
    assert row["precision_percent"] == 50.0
    assert row["recall_percent"] == pytest.approx(100 / 3)


@pytest.fixture
def town_folder(tmp_path):
    """Two sequences in one root: 07 with one true line and one scan on it, 01 without truth."""
    folder = tmp_path / "sequences" / "07"
    (folder / "labels").mkdir(parents=True)
    (folder / "velodyne").mkdir()
    (tmp_path / "sequences" / "01").mkdir()
    T_world_lidar = from_yaw(0.5, np.array([100.0, 50.0, 2.0]))
    np.savetxt(folder / "T_world_lidar.txt", T_world_lidar[None, :3].reshape(1, 12))
    line = line_set([upright(10.0, 0.0, -1.5, 1.5)])
    np.savez(folder / "lines.npz", endpoints=line.transformed(T_world_lidar).endpoints)
    points = np.array([[10.0, 0.0, z] for z in np.linspace(-1.0, 1.0, 9)] + [[3.0, 3.0, 0.0]])
    np.c_[points, np.zeros(10)].astype("<f4").tofile(folder / "velodyne" / "000000.bin")
    on = np.array([Semantic.POLE] * 9 + [Semantic.CAR], np.uint8)
    np.savez(
        folder / "labels" / "000000.npz", semantic=on, line_id=np.array([0] * 9 + [-1], np.int32)
    )
    return tmp_path


def test_true_lines_of_a_town_come_in_the_frame_of_the_scan(town_folder):
    for drive in (Drive(str(town_folder), "07"), Drive(str(town_folder / "sequences" / "07"))):
        town = open_truth(drive)
        assert town is not None
        scan = town.at(0)
        np.testing.assert_allclose(
            scan.endpoints, [upright(10.0, 0.0, -1.5, 1.5)], rtol=0, atol=1e-9
        )
        assert scan.visible.tolist() == [True]
    assert open_truth(Drive(str(town_folder), "01")) is None


def test_labels_that_do_not_fit_are_refused_by_name(town_folder):
    path = town_folder / "sequences" / "07" / "labels" / "000000.npz"
    np.savez(path, semantic=np.zeros(4, np.uint8), line_id=np.zeros(4, np.int32))
    town = open_truth(Drive(str(town_folder), "07"))
    assert town is not None
    with pytest.raises(InputError, match=r"000000\.npz: its labels do not fit"):
        town.at(0)
    path.write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"000000\.npz: expected"):
        town.at(0)


def test_weights_files_are_rows_of_their_own():
    methods = make_methods(["geometric", "learned"], ["a=x/one.safetensors", "x/two.safetensors"])
    assert [method.name for method in methods] == ["geometric", "a", "two"]
    assert [method.kind for method in methods] == ["geometric", "learned", "learned"]
    assert make_methods(["learned"], [])[0].weights is None
    with pytest.raises(InputError, match="guess: expected some of geometric, learned"):
        make_methods(["guess"], [])
    with pytest.raises(InputError, match="once"):
        make_methods(["geometric"], ["geometric=w"])


def test_stages_are_timed_without_what_they_call():
    ticks = iter(range(100))
    watch = Stopwatch(lambda: float(next(ticks)))
    inner = watch.timed("inner", lambda: None)
    outer = watch.timed("outer", lambda: (inner(), inner()))
    outer()
    assert watch.taken_s == {"inner": 2.0, "outer": 3.0}


def test_every_stage_is_there_and_put_back(rng):
    from sl3d_slam.lines import geometric
    from sl3d_slam.lines.extract import LineExtractor

    settings = LineSettings(method="geometric")
    before, watch = geometric.find_poles, Stopwatch()
    points = room(20.0, elevations_deg=(-20.0, 2.0))[::3]
    with watch.watching(STAGES["learned"]):
        assert geometric.find_poles is not before
    with watch.watching(STAGES["geometric"]):
        start_s = time.process_time()
        LineExtractor(settings).extract(points + rng.normal(0.0, 0.01, points.shape))
        taken_s = time.process_time() - start_s
    assert geometric.find_poles is before
    assert {"scene", "poles", "edges", "describing"} <= set(watch.taken_s)
    assert 0.0 < sum(watch.taken_s.values()) <= taken_s


def test_the_ratio_to_kiss_icp_needs_kiss_icp():
    rows = [{"method": "geometric", "processor_ms": 90.0}, {"method": "kiss-icp"}]
    assert compared(rows) == rows
    rows[1]["processor_ms"] = 60.0
    assert [row["times_kiss_icp"] for row in compared(rows)] == [1.5, 1.0]


def test_a_missing_network_has_a_row_that_says_so(tmp_path):
    """Needs no data: an extractor without its weights is told before any drive is opened."""
    methods = [LineMethod("mine", "learned", tmp_path / "none.safetensors")]
    tables = run(LinesBench([], methods), tmp_path / "out")
    (row,) = tables[0].rows
    assert row["method"] == "mine"
    assert "none.safetensors" in row["status"]
    assert (tmp_path / "out" / "lines.png").stat().st_size > 1000
    assert "none.safetensors" in (tmp_path / "out" / "lines.md").read_text()
