"""The progress meter on a terminal, in a log file and when told to be quiet."""

import io
import time

import pytest
from rich.console import Console

from sl3d_slam.cli import progress
from sl3d_slam.cli.progress import Meter, notice


class Clock:
    """Seconds that pass only when told to."""

    def __init__(self):
        self.now_s = 100.0

    def __call__(self):
        return self.now_s


def watch(steps, terminal, quiet=False, seconds_per_step=1.0):
    clock, out = Clock(), io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=120)
    with Meter(steps, quiet=quiet, console=console, clock=clock) as meter:
        for i in range(steps):
            clock.now_s += seconds_per_step
            meter.advance(f"loops {i}")
    return out.getvalue()


def test_log_file_gets_a_line_every_ten_seconds():
    lines = watch(35, terminal=False).splitlines()
    assert lines == [
        "10/35 scans, 1.0 scans/s, loops 9",
        "20/35 scans, 1.0 scans/s, loops 19",
        "30/35 scans, 1.0 scans/s, loops 29",
    ]


def test_terminal_shows_the_final_count_rate_and_note():
    shown = watch(30, terminal=True)
    assert "30/30" in shown
    assert "1.0 scans/s" in shown
    assert "loops 29" in shown


@pytest.mark.parametrize("terminal", [True, False])
def test_quiet_and_quick_commands_show_nothing(terminal):
    assert watch(30, terminal, quiet=True) == ""
    assert watch(30, terminal, seconds_per_step=0.05) == ""


def test_unknown_total_counts_upwards():
    clock, out = Clock(), io.StringIO()
    with Meter(None, unit="poses", console=Console(file=out), clock=clock) as meter:
        clock.now_s += 10.0
        meter.advance(steps=40)
    assert out.getvalue() == "40 poses, 4.0 poses/s\n"


def test_error_passes_through_and_the_bar_is_put_away():
    clock, out = Clock(), io.StringIO()
    console = Console(file=out, force_terminal=True)
    meter = Meter(10, console=console, clock=clock)

    def fail():
        with meter:
            clock.now_s += 5.0
            meter.advance()
            raise ValueError("the scan is bad")

    with pytest.raises(ValueError, match="the scan is bad"):
        fail()
    assert out.getvalue().endswith("\x1b[?25h")  # the cursor is shown again


@pytest.mark.parametrize(
    ("concerns", "quiet", "said"), [(True, False, "wait\n"), (False, False, ""), (True, True, "")]
)
def test_a_notice_is_said_only_where_it_concerns_a_user_who_listens(
    monkeypatch, capsys, concerns, quiet, said
):
    monkeypatch.setattr(progress, "NOTICE_AFTER_S", 0.02)
    with notice("wait", lambda: concerns, quiet):
        time.sleep(0.3)
    assert capsys.readouterr().err == said


def test_a_notice_is_not_said_once_the_work_is_over(monkeypatch, capsys):
    monkeypatch.setattr(progress, "NOTICE_AFTER_S", 0.1)
    with notice("wait", lambda: True):
        pass
    time.sleep(0.3)
    assert capsys.readouterr().err == ""
