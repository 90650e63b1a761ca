"""The two sides of a pair, each in a thread: the one place where two scans are made ready at once.

Threads help where compiled code lets go of Python's lock (``nogil=True``); what holds it takes
turns. Neither side sees the other, so the results are those of one after the other, to the bit.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Given = TypeVar("Given")
Made = TypeVar("Made")


def side_by_side(make: Callable[[Given], Made], source: Given, target: Given) -> tuple[Made, Made]:
    """Return ``make(source), make(target)``; what either raises is raised, the target's first."""
    with ThreadPoolExecutor(1) as beside:
        of_source = beside.submit(make, source)
        of_target = make(target)
        return of_source.result(), of_target
