"""``sl3d demo``: a simulated drive as a dataset, and the whole demonstration."""

import json

import numpy as np
import pytest

from sl3d_slam.cli.demo import NUM_QUERIES, as_dataset


def test_a_simulated_drive_reads_like_its_written_form(ring_drive, ring_dataset):
    """Written scans are float32; otherwise points and truth are the same."""
    direct = as_dataset(ring_drive, "ring")
    assert len(direct) == len(ring_dataset) == 59
    assert direct.simulated
    (scan,) = direct.iterate(7, 8)
    (written,) = ring_dataset.iterate(7, 8)
    assert scan.index == 7
    assert scan.stamp_s == pytest.approx(0.7)
    ranges = np.linalg.norm(scan.points_lidar, axis=1)
    kept = scan.points_lidar[(ranges >= 2.0) & (ranges <= 100.0)]
    np.testing.assert_allclose(kept, written.points_lidar, atol=1e-4)
    np.testing.assert_allclose(direct.truth, ring_dataset.truth, atol=1e-6)


@pytest.mark.slow
def test_the_demonstration_finds_scans_of_another_day(sl3d, tmp_path):
    result = sl3d("demo", "--out", tmp_path / "demo")
    assert result.returncode == 0, result.stderr
    figures = json.loads((tmp_path / "demo" / "metrics.json").read_text())
    assert figures["loops_accepted"] >= 5
    assert figures["loops_false"] == 0
    (verdict,) = [line for line in result.stdout.splitlines() if "found where they are" in line]
    assert int(verdict.split()[0]) >= NUM_QUERIES - 1
    assert (tmp_path / "demo" / "relocalization.png").is_file()


def test_nowhere_to_write_the_demonstration_is_said_before_the_work(sl3d, tmp_path):
    taken = tmp_path / "taken"
    taken.write_text("a file")
    result = sl3d("demo", "--out", taken)
    assert result.returncode == 2
    assert str(taken) in result.stderr
    assert taken.read_text() == "a file"
