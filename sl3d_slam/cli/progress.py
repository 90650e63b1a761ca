"""The progress of a long command, on stderr: a bar on a terminal, now and then a line elsewhere."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

COMPILING = "sl3d: getting ready; the first run on a machine compiles for a minute or two"
SHOW_AFTER_S = 2.0
NOTICE_AFTER_S = 4.0
LINE_EVERY_S = 10.0


@contextmanager
def notice(sentence: str, concerns: Callable[[], bool], quiet: bool = False) -> Iterator[None]:
    """Say a sentence on stderr where it still concerns the user after a few seconds."""

    def say() -> None:
        if concerns():
            Console(stderr=True).print(sentence, highlight=False, soft_wrap=True)

    timer = threading.Timer(NOTICE_AFTER_S, say)
    timer.daemon = True
    if not quiet:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


class Meter:
    """Counts what is done and shows it once two seconds have passed, unless quiet.

    Where stderr is no terminal (a log file, a pipe) a plain line every ten seconds stands in for
    the bar.

    Use it as a context::

        with Meter(len(scans), quiet=quiet) as meter:
            for scan in scans:
                ...
                meter.advance(f"loops {num_loops}")
    """

    def __init__(
        self,
        total: int | None,
        unit: str = "scans",
        quiet: bool = False,
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Expect ``total`` steps (None: not known) of one ``unit`` each."""
        self._total, self._unit, self._quiet = total, unit, quiet
        self._console = console or Console(stderr=True)
        self._clock = clock
        self._done, self._note = 0, ""
        self._start_s = self._last_line_s = clock()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
            console=self._console,
        )
        self._task = self._bar.add_task(unit, total=total, rate="", note="")
        self._shown = False

    def __enter__(self) -> "Meter":
        """Start counting."""
        self._start_s = self._last_line_s = self._clock()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Leave the bar as it stands, also after an error."""
        if self._shown:
            self._update_bar()
            self._bar.stop()

    def advance(self, note: str = "", steps: int = 1) -> None:
        """Count steps; ``note`` is any short text to show beside them."""
        self._done += steps
        self._note = note
        now_s = self._clock()
        if self._quiet or now_s - self._start_s < SHOW_AFTER_S:
            return
        if self._console.is_terminal:
            self._show_bar()
        elif now_s - self._last_line_s >= LINE_EVERY_S:
            self._last_line_s = now_s
            self._console.print(self._line(), highlight=False, soft_wrap=True)

    def _show_bar(self) -> None:
        if not self._shown:
            self._bar.start()
            self._shown = True
        self._update_bar()

    def _update_bar(self) -> None:
        rate = f"{self._rate():.1f} {self._unit}/s"
        self._bar.update(self._task, completed=self._done, rate=rate, note=self._note)

    def _line(self) -> str:
        of = "" if self._total is None else f"/{self._total}"
        text = f"{self._done}{of} {self._unit}, {self._rate():.1f} {self._unit}/s"
        return f"{text}, {self._note}" if self._note else text

    def _rate(self) -> float:
        return self._done / max(self._clock() - self._start_s, 1e-9)
