"""Figures and tables of benchmarks from invented results whose right values are known."""

import csv
import io
import math

import numpy as np
import pytest
from rich.console import Console

from sl3d_slam.bench.loop_detectors import Detection
from sl3d_slam.bench.loop_figures import false_ones, is_right, judge
from sl3d_slam.bench.loop_revisits import find_revisits, that_overlap
from sl3d_slam.bench.registration_figures import COLUMNS as PAIR_COLUMNS
from sl3d_slam.bench.registration_figures import figures, measure, recall_curve
from sl3d_slam.bench.registration_methods import Attempt
from sl3d_slam.bench.slam_figures import COLUMNS, accuracy, growth
from sl3d_slam.bench.tables import Column, Table, draw_table, to_csv, to_markdown, to_rich
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import from_yaw, invert, transform_points
from sl3d_slam.types import LoopRecord, Scan

T_TRUE = from_yaw(0.7, np.array([10.0, -3.0, 0.5]))


def off_by(metres, degrees):
    """An answer that is off by so much in its own frame."""
    return T_TRUE @ from_yaw(math.radians(degrees), np.array([0.0, metres, 0.0]))


def street_and_back(lane_m=1.0):
    """60 m out and back in the next lane, a metre a scan."""
    out = [from_yaw(0.1, np.array([k, 0.1 * k, 0.0])) for k in range(60)]
    back = [from_yaw(0.1 + np.pi, np.array([k, 0.1 * k + lane_m, 0.0])) for k in range(59, -1, -1)]
    return np.array(out + back)


def twice_round():
    """Two rounds of a ring of 100 m, a metre a scan."""
    angles = 2 * np.pi * np.arange(200) / 100
    radius = 100 / (2 * np.pi)
    return np.array(
        [
            from_yaw(angle + np.pi / 2, radius * np.array([np.cos(angle), np.sin(angle), 0.0]))
            for angle in angles
        ]
    )


def loop(truth, query, target, metres=0.0, score=10.0, accepted=True):
    T_target_query = invert(truth[target]) @ truth[query]
    T_target_query = T_target_query @ from_yaw(0.0, np.array([metres, 0.0, 0.0]))
    return Detection(
        (query, query + 1), (target, target + 1), query, target, T_target_query, score, accepted
    )


def test_registration_row_counts_successes_wrong_answers_and_refusals():
    answers = [off_by(0.1, 1.0), off_by(0.3, 2.0), off_by(3.0, 1.0), off_by(0.1, 6.0), None]
    attempts = [Attempt(answer, 0.2, 0.1) for answer in answers]
    row = figures(attempts, [T_TRUE] * 5)
    assert row["recall_percent"] == pytest.approx(40.0)
    assert row["wrong"] == 2
    assert row["refused"] == 1
    assert row["rte_mean_m"] == pytest.approx(0.2)
    assert row["rte_std_m"] == pytest.approx(0.1)
    assert row["rre_median_deg"] == pytest.approx(1.5)
    assert row["total_ms"] == pytest.approx(300.0)
    assert row["extract_ms"] == pytest.approx(200.0)


def test_pairs_of_different_places_have_no_recall_and_every_answer_is_wrong():
    attempts = [Attempt(T_TRUE, 0.0, 0.0), Attempt(None, 0.0, 0.0), Attempt(None, 0.0, 0.0)]
    row = figures(attempts, [None] * 3)
    assert (row["wrong"], row["refused"]) == (1, 2)
    assert "recall_percent" not in row


def test_a_method_that_never_says_no_has_no_count_of_refusals():
    row = figures([Attempt(T_TRUE, 0.0, 0.0, can_refuse=False)], [T_TRUE])
    assert row["refused"] is None


def test_recall_curve_rises_at_each_error_and_ignores_what_is_not_allowed():
    answers = [off_by(metres, degrees) for metres, degrees in ((0.5, 1), (1.5, 1), (0.2, 50))]
    errors = measure([Attempt(answer, 0.0, 0.0) for answer in answers], [T_TRUE] * 3)
    curve = recall_curve(errors.rte_m, errors.rre_deg <= 5.0, np.array([0.3, 1.0, 2.0]))
    np.testing.assert_allclose(curve, [0.0, 100 / 3, 200 / 3])


def test_slam_row_of_a_known_trajectory():
    truth = np.array([from_yaw(0.0, np.array([k, 0.0, 0.0])) for k in range(301)])
    long = truth.copy()
    long[:, 0, 3] *= 1.02  # 2 % too long: ATE is 2 % of the spread of positions about their mean
    T_wrong = invert(truth[0]) @ truth[250] @ from_yaw(0.0, np.array([3.0, 0.0, 0.0]))
    loops = [
        LoopRecord(250, 0, invert(truth[0]) @ truth[250], 9, "accepted", ""),
        LoopRecord(250, 0, T_wrong, 9, "accepted", ""),
        LoopRecord(250, 0, T_wrong, 9, "rejected", "no"),
    ]
    row = accuracy(long, loops, truth)
    assert row["translation_percent"] == pytest.approx(2.0, rel=0.02)  # a stretch ends on a scan
    assert row["ate_m"] == pytest.approx(0.02 * np.std(truth[:, 0, 3]), rel=1e-6)
    assert (row["loops_accepted"], row["loops_false"]) == (2, 1)
    assert set(accuracy(long, loops, None)) == {"loops_accepted"}


def test_slam_row_tells_rotation_in_degrees_a_hundred_metres():
    truth = np.array([from_yaw(0.0, np.array([k, 0.0, 0.0])) for k in range(301)])
    turning = np.array([from_yaw(np.radians(0.02 * k), truth[k, :3, 3]) for k in range(301)])
    row = accuracy(turning, [], truth)
    assert row["rotation_deg_per_100m"] == pytest.approx(2.0, rel=0.02)  # a stretch ends on a scan


def test_a_trajectory_of_another_length_or_not_finite_is_an_error():
    truth = np.array([from_yaw(0.0, np.array([k, 0.0, 0.0])) for k in range(10)])
    with pytest.raises(InputError, match="9"):
        accuracy(truth[:9], [], truth)
    broken = truth.copy()
    broken[4, 0, 3] = np.nan
    with pytest.raises(InputError, match="finite"):
        accuracy(broken, [], truth)


def test_growth_tells_slope_and_slowing():
    taken_ms = np.concatenate([np.full(1000, 50.0), np.full(1000, 75.0)])
    resident_mb = 300.0 + 0.02 * np.arange(2000)
    row = growth(taken_ms, resident_mb)
    assert row["rss_kb_per_scan"] == pytest.approx(20.0)
    assert row["rss_500_mb"] == pytest.approx(310.0)
    assert row["ms_growth"] == pytest.approx(1.5)
    assert row["ms_mean"] == pytest.approx(62.5)
    short = growth(taken_ms[:50], resident_mb[:50])
    assert short["rss_kb_per_scan"] is None
    assert short["ms_growth"] is None


def test_revisits_of_a_street_driven_back_are_all_in_reverse():
    truth = street_and_back()
    revisits = find_revisits(truth)
    queries = set(revisits.pairs[:, 0].tolist())
    assert revisits.is_reverse.all()
    assert queries <= set(range(60, 120))
    assert min(queries) == pytest.approx(60 + 18, abs=3)  # at least 40 m of travel ago
    assert max(queries) == 119


def test_right_loops_raise_recall_wrong_ones_lower_precision():
    truth = twice_round()
    found = [loop(truth, 100 + k, k) for k in range(0, 50, 5)]
    found.append(loop(truth, 170, 20, metres=0.0))  # far apart, and honest about it
    found.append(loop(truth, 180, 80, metres=9.0, score=3.0))
    rows, curves = judge(found, truth, find_revisits(truth))
    everything = rows[0]
    assert everything["num_revisits"] == pytest.approx(104, abs=2)  # the second round, 4 m early
    assert (everything["detections"], everything["false"]) == (12, 1)
    assert everything["precision_percent"] == pytest.approx(100 * 11 / 12)
    (wrong,) = false_ones(found, truth)
    assert (wrong["query_scan"], wrong["target_scan"]) == (180, 80)
    assert wrong["off_m"] == pytest.approx(9.0)
    # Loops at 100, 105, ... 145 speak for 95 to 150: 54 scans, of which 96 and later revisit.
    assert everything["recall_percent"] == pytest.approx(100 * 54 / 104, abs=3)
    assert everything["recall_sure_percent"] == everything["recall_percent"]
    assert curves["same direction"].num_revisits == everything["num_revisits"]
    assert rows[2]["num_revisits"] == 0
    assert "recall_percent" not in rows[2]


def test_rejected_candidates_lengthen_the_curve_but_not_the_result():
    truth = twice_round()
    found = [
        loop(truth, 110, 10, score=1010.0),
        loop(truth, 150, 50, score=7.0, accepted=False),
    ]
    rows, curves = judge(found, truth, find_revisits(truth))
    assert rows[0]["detections"] == 1
    assert curves["all"].recall[-1] == pytest.approx(2 * curves["all"].own[1], rel=0.01)


def test_local_maps_are_judged_where_they_meet():
    truth = twice_round()
    T_target_query = invert(truth[0]) @ truth[95]
    right = Detection((95, 150), (0, 50), 95, 0, T_target_query, 9.0, True)
    swapped = Detection((95, 150), (0, 50), 95, 0, invert(T_target_query), 9.0, True)
    assert is_right(right, truth)
    assert not is_right(swapped, truth)


def test_a_closure_of_local_maps_speaks_for_all_of_them_and_nearby_for_a_few_scans():
    truth = twice_round()
    T_target_query = invert(truth[0]) @ truth[100]
    closure = Detection((100, 150), (0, 50), 100, 0, T_target_query, 9.0, True)
    row = judge([closure], truth, find_revisits(truth))[0][0]
    # All of 96 to 154; nearby only what is within 5 m of where they meet.
    assert row["recall_sure_percent"] == pytest.approx(100 * 59 / 104, abs=3)
    assert row["recall_near_percent"] == pytest.approx(100 * 11 / 104, abs=5)
    single = judge([loop(truth, 120, 20)], truth, find_revisits(truth))[0][0]
    assert single["recall_near_percent"] == single["recall_sure_percent"]


def test_scans_that_share_little_are_no_revisit():
    truth = twice_round()
    rng = np.random.default_rng(5)
    world = rng.uniform(-40.0, 40.0, (2000, 3))
    upstairs = world + np.array([0.0, 0.0, 90.0])  # seen from 130 to 159 in place of what is below

    def scan(k):
        seen = upstairs if 130 <= k < 160 else world
        return Scan(k, 0.1 * k, transform_points(invert(truth[k]), seen))

    near = find_revisits(truth)
    kept = that_overlap(near, (scan(k) for k in range(200)), truth)
    lost = set(near.pairs[:, 0].tolist()) - set(kept.pairs[:, 0].tolist())
    assert lost == set(range(130, 160))
    assert len(kept.pairs) == len(kept.is_reverse)


def test_no_detection_at_all_has_no_precision():
    rows, _ = judge([], street_and_back(), find_revisits(street_and_back()))
    assert rows[0]["precision_percent"] is None
    assert rows[0]["recall_percent"] == 0.0


def test_tables_show_absent_values_and_keep_every_key_in_csv():
    rows = [
        {"system": "a", "ate_m": 0.1234, "status": "ok"},
        {"system": "b", "status": "b: not installed; pip install 'x[bench]' | y"},
    ]
    table = Table(
        "T",
        [Column("system", "system"), Column("ate_m", "ATE", "{:.2f}"), Column("status", "status")],
        rows,
        ["a note"],
    )
    text = to_markdown(table)
    assert "| a | 0.12 | ok |" in text
    assert "| b | - | b: not installed; pip install 'x[bench]' \\| y |" in text
    assert "- a note" in text
    read = list(csv.DictReader(io.StringIO(to_csv(table))))
    assert read[0]["ate_m"] == "0.1234"
    assert read[1]["ate_m"] == ""
    with io.StringIO() as stream:
        Console(file=stream, width=120).print(to_rich(table, 120))
        assert "x[bench]" in stream.getvalue()  # not eaten as rich markup
    assert draw_table(table).startswith(b"\x89PNG")


@pytest.mark.parametrize("columns", [COLUMNS, PAIR_COLUMNS])
def test_a_narrow_terminal_gets_the_main_columns(columns):
    row = {
        column.key: (1 if "d" in column.form else 1.0) if column.form != "{}" else "x"
        for column in columns
    }
    wide = to_rich(Table("T", columns, [row]), 1000)
    narrow = to_rich(Table("T", columns, [row]), 80)
    assert len(wide.columns) == len(columns)
    assert len(narrow.columns) < len(columns)
    assert "status" in [column.header for column in narrow.columns]
