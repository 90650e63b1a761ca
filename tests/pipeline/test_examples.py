"""Every example runs from a checkout, with no data, and shows what it promises."""

import re
import subprocess
import sys

import pytest

PROMISES = {
    "01_map_a_folder.py": r"trajectory off by 0\.[0-2]\d* m .*\n.*graph\.g2o.*map\.sl3d.*poses_tum",
    "02_lines_of_one_scan.py": r"[1-9]\d* lines in \d+ points",
    "03_close_a_loop.py": r"off by 0\.0\d+ m and 0\.[0-2]\d deg",
    "04_own_factor_graph.py": r"ATE of the odometry: [1-9].*\nATE of your graph: +0\.[0-2]",
    "05_relocalize.py": r"(scan \d+: found with confidence [01]\.\d\d, off by 0\.[01]\d m\n){3}",
}


def test_every_example_is_tested(repository):
    names = {path.name for path in (repository / "examples").glob("*.py")}
    assert names == set(PROMISES)


@pytest.mark.slow
@pytest.mark.parametrize("name", PROMISES)
def test_an_example_shows_what_it_promises(name, repository, tmp_path):
    answer = subprocess.run(
        [sys.executable, str(repository / "examples" / name)],
        cwd=tmp_path,
        env={"PATH": "", "HOME": str(tmp_path), "TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert answer.returncode == 0, answer.stderr
    assert re.search(PROMISES[name], answer.stdout), answer.stdout
