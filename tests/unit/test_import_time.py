"""What must stay light: importing the package and asking for help load nothing heavy."""

import subprocess
import sys

import pytest

HEAVY = ("torch", "gtsam", "open3d", "numba", "matplotlib", "kiss_icp", "small_gicp", "rerun")
LIGHT_HELP = (*HEAVY, "scipy", "numpy", "yaml", "rich")


def modules_after(statements):
    code = f"import sys\n{statements}\nprint(*sys.modules)"
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return set(answer.stdout.split())


def test_import_of_the_package_loads_nothing_heavy():
    loaded = modules_after("import sl3d_slam")
    assert "sl3d_slam" in loaded
    assert loaded.isdisjoint(HEAVY)


def test_names_of_the_package_are_found_without_loading_them():
    loaded = modules_after("import sl3d_slam; dir(sl3d_slam)")
    assert loaded.isdisjoint(HEAVY)


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["config", "--help"]])
def test_help_loads_nothing_heavy(arguments):
    loaded = modules_after(
        f"from sl3d_slam.cli.main import app\ntry: app({arguments!r})\nexcept SystemExit: pass"
    )
    assert "sl3d_slam.cli.main" in loaded
    assert loaded.isdisjoint(LIGHT_HELP)
