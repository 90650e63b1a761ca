"""How much memory a process holds is its own, whatever its parent held."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sl3d_slam.memory import children_peak_mb

PEAK = "from sl3d_slam.memory import own_peak_mb; {}; print(own_peak_mb())"


def peak_of(statement):
    command = [sys.executable, "-c", PEAK.format(statement)]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux's /proc")
def test_a_process_that_a_large_one_starts_is_not_large():
    large = np.ones(40_000_000)
    assert peak_of("pass") < 150
    assert large.nbytes == 320_000_000


def test_the_peak_stays_after_memory_was_given_back():
    assert peak_of("x = bytearray(300_000_000); del x") > 300


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux's /proc")
def test_a_child_counts_with_what_is_its_own_and_at_its_most():
    before = children_peak_mb()
    script = "x = bytearray(200_000_000); del x; print('done', flush=True); input()"
    command = [sys.executable, "-c", script]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout.readline() == b"done\n"
        held = children_peak_mb() - before
        child.communicate(b"\n")
    assert 195 < held < 230
    assert children_peak_mb() == pytest.approx(before, abs=5)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs Linux's /proc")
def test_a_child_that_has_ended_holds_nothing():
    before_mb = children_peak_mb()
    child = subprocess.Popen([sys.executable, "-c", ""])
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)  # ended, not yet collected
    ended_mb = children_peak_mb()
    child.wait()
    assert ended_mb == before_mb


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc keeps what is free")
def test_arrays_of_the_size_of_a_scan_are_given_back_from_between_what_stays():
    script = (
        "import numpy as np\n"
        "from sl3d_slam.memory import keep_large_arrays_apart, rss_mb\n"
        "keep_large_arrays_apart()\n"
        "np.ones(4_000_000)  # once freed, glibc by itself takes what is smaller from its heap\n"
        "pairs = [(np.ones(375_000), np.ones(5_000)) for _ in range(50)]\n"
        "held, kept = rss_mb(), [small for _, small in pairs]\n"
        "del pairs; print(held - rss_mb())"
    )
    command = [sys.executable, "-c", script]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert float(printed) > 140  # of 150 MB; by itself none
