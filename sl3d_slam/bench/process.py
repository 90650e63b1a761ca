"""Starting a benchmark's process, watching it, and taking what it leaves.

A runner is a module that is run with a folder as its argument. It reads ``task.json`` there,
leaves ``answer.json``, and adds a byte to ``progress`` for each step done.
"""

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sl3d_slam.errors import Sl3dError
from sl3d_slam.files import write_whole
from sl3d_slam.io.json_files import write_json

TASK, ANSWER, PROGRESS = "task.json", "answer.json", "progress"
POLL_S = 0.2
_ERROR = re.compile(r"[\w.]*(Error|Exception)\b")

Steps = Callable[[int], None]


@dataclass(frozen=True, slots=True)
class Ending:
    """How a process ended: ``problem`` is empty, or says in a sentence what went wrong."""

    problem: str
    wall_s: float
    answer: Any = None


def run_runner(module: str, folder: Path, task: Any, progress: Steps) -> Ending:
    """Run ``python -m module folder`` and wait; ``progress`` is told of every few steps done."""
    write_json(folder / TASK, task)
    start_s = time.perf_counter()
    status, log = _run([sys.executable, "-m", module, str(folder)], folder, progress)
    return ending(folder, status, log, time.perf_counter() - start_s)


def ending(folder: Path, exit_status: int, log: str, wall_s: float) -> Ending:
    """Read what a process left; one that died is named with its last words."""
    path = folder / ANSWER
    if exit_status != 0 or not path.is_file():
        how = f"killed by signal {-exit_status}" if exit_status < 0 else f"status {exit_status}"
        return Ending(f"failed ({how}): {_last_words(log)}", wall_s)
    tree = json.loads(path.read_text(encoding="utf-8"))
    if "error" in tree:
        return Ending(str(tree["error"]), wall_s)
    return Ending("", wall_s, tree)


def _last_words(log: str) -> str:
    """Return the last line that names an error, else the last line."""
    lines = [line.rstrip() for line in log.splitlines() if line.strip()]
    errors = [line for line in lines if _ERROR.match(line)]
    return (errors or lines or ["it said nothing"])[-1].strip()[:200]


def serve(folder: Path, work: Callable[[Any, Path, Callable[[], None]], Any]) -> None:
    """Be the process: ``work(task, folder, step)`` returns the answer, calling ``step`` as it goes.

    An error that a user can act on becomes the answer; any other ends the process.
    """
    task = json.loads((folder / TASK).read_text(encoding="utf-8"))
    try:
        with (folder / PROGRESS).open("ab", buffering=0) as progress:

            def step() -> None:
                progress.write(b".")

            answer = work(task, folder, step)
        write_json(folder / ANSWER, answer)
    except Sl3dError as error:
        write_whole(folder / ANSWER, json.dumps({"error": str(error)}))


def _run(command: list[str], folder: Path, progress: Steps) -> tuple[int, str]:
    """Return exit status and log."""
    done = 0
    with (folder / "log").open("w+", encoding="utf-8", errors="replace") as log:
        with subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT) as process:
            try:
                while process.poll() is None:
                    time.sleep(POLL_S)
                    done = _report(folder / PROGRESS, done, progress)
            except BaseException:
                process.kill()
                raise
        _report(folder / PROGRESS, done, progress)
        log.seek(0)
        return process.returncode, log.read()


def _report(path: Path, done: int, progress: Steps) -> int:
    now = path.stat().st_size if path.exists() else 0
    if now > done:
        progress(now - done)
    return now
