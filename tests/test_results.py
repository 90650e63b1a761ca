"""The README says what benchmarks wrote: the tables in ``examples/results/`` are theirs."""

import csv
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TOWNS = ("07", "05", "00")
SYSTEMS = {"sl3d_slam": "sl3d-slam", "kiss-slam": "kiss-slam"}


def readme_cells(town, system):
    """Return the cells of the table row on a system in a town, without emphasis."""
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    rows = [line for line in lines if re.match(rf"\|\s*KITTI {town}", line)]
    split = [[cell.strip(" *") for cell in row.strip("| ").split("|")] for row in rows]
    (cells,) = [cells for cells in split if cells[1] == system]
    return cells


def measured(name, **wanted):
    """Return the one row of a table with these values."""
    with (ROOT / "examples" / "results" / name).open(encoding="utf-8", newline="") as file:
        (row,) = [row for row in csv.DictReader(file) if wanted.items() <= row.items()]
    return row


@pytest.mark.parametrize("town", TOWNS)
@pytest.mark.parametrize("system", SYSTEMS)
def test_readme_tells_how_systems_did_in_a_town(town, system):
    row = measured("slam_towns.csv", sequence=town, system=SYSTEMS[system])
    assert readme_cells(town, system)[2:] == [
        f"{float(row['ate_m']):.2f}",
        f"{float(row['translation_percent']):.2f}",
        f"{row['loops_accepted']} ({row['loops_false']})",
        f"{float(row['ms_all']):.0f}",
        f"{float(row['ms_max']):.0f}",
        f"{float(row['peak_rss_mb']):.0f}",
        f"{float(row['map_mb']):.2f}",
    ]


@pytest.mark.parametrize("town", TOWNS)
@pytest.mark.parametrize("detector", ["sl3d-slam", "map-closures"])
def test_readme_tells_which_revisits_were_recognised(town, detector):
    row = measured("loops_towns.csv", sequence=town, detector=detector, direction="all")
    assert readme_cells(town, detector)[2:6] == [
        row["num_revisits"],
        f"{row['detections']} ({row['false']})",
        f"{float(row['recall_sure_percent']):.1f}",
        f"{float(row['recall_near_percent']):.1f}",
    ]
