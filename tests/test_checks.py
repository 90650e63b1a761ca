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


@pytest.mark.parametrize("check", CHECKS)
def test_check_finds_nothing(check, repository):
    command = [sys.executable, *CHECKS[check]]
    answer = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=False)
    assert answer.returncode == 0, f"{answer.stdout}\n{answer.stderr}"
