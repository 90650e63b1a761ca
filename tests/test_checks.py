"""Style, types and import rules, checked by their own tools from this one test command."""

import subprocess
import sys

import pytest

CHECKS = {
    "layout": ("-m", "ruff", "format", "--check", "."),
    "lint": ("-m", "ruff", "check", "."),
    "types": ("-m", "mypy", "--strict", "sl3d_slam"),
    "imports": ("-c", "from importlinter.cli import lint_imports_command as run; run()"),
}
TOP_LEVEL = {"LICENSE", "README.md", "configs", "examples", "pyproject.toml", "sl3d_slam", "tests"}


@pytest.mark.parametrize("check", CHECKS)
def test_check_finds_nothing(check, repository):
    command = [sys.executable, *CHECKS[check]]
    answer = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, f"{answer.stdout}\n{answer.stderr}"


def test_top_level_shows_nothing_else(repository):
    command = ["git", "-C", repository, "ls-files", "-z"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    if answer.returncode != 0:
        pytest.skip("needs a git checkout")
    names = {name.split("/")[0] for name in answer.stdout.split("\0") if name}
    assert {name for name in names if not name.startswith(".")} == TOP_LEVEL
