"""Two scans, from their points to a pose: by geometric lines where those are sure, else by learned.

Learned lines take more than twice as long to find, and most pairs do without them.
"""

import time
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from sl3d_slam.config import MatchingSettings, SlamConfig
from sl3d_slam.geometry.se3 import Points
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.registration import prepare_views, register_lines, register_views
from sl3d_slam.side_by_side import side_by_side
from sl3d_slam.types import LineSet, Registration

OtherPoints = Float64[np.ndarray, "M 3"]

# of a pose by geometric lines, else the network is asked; their descriptors stand out less, so
# right poses have lower odds: of 1,200 wrong ones none has more than -3.3
LACKING_LOG_ODDS, SURE_OVERLAP = 2.0, 0.1


class PairAnswer(NamedTuple):
    """The lines of source and target that decided, and the seconds that finding lines took."""

    registration: Registration
    lines: tuple[LineSet, LineSet]
    extract_s: float


class PairRegistrar:
    """Registers pairs of scans (N, 3) in metres, each in its lidar frame, with no first guess."""

    def __init__(self, config: SlamConfig) -> None:
        """Load what the settings' line method needs."""
        self._extractors = [(LineExtractor(config.lines), config.matching)]
        if config.lines.method == "learned":
            geometric = config.lines.model_copy(update={"method": "geometric"})
            self._extractors.insert(0, (LineExtractor(geometric), _sure(config.matching)))

    def register(self, source: Points, target: OtherPoints) -> PairAnswer:
        """Find ``T_target_source`` by lines and clouds."""
        extractor, settings = self._extractors[0]
        start_s = time.perf_counter()
        proposals = side_by_side(extractor.propose, source, target)
        lines = side_by_side(extractor.extract_from, *proposals)
        extract_s = time.perf_counter() - start_s
        views = prepare_views(lines, (source, target), settings)
        registration = register_views(*views, settings, thorough=len(self._extractors) == 1)
        for extractor, settings in self._extractors[1:]:
            if registration.success:
                break
            start_s = time.perf_counter()
            lines = side_by_side(extractor.extract_from, *proposals)
            extract_s += time.perf_counter() - start_s
            views = views[0].with_lines(lines[0]), views[1].with_lines(lines[1])
            registration = register_views(*views, settings)
        return PairAnswer(registration, lines, extract_s)

    def register_by_lines(self, source: Points, target: OtherPoints) -> PairAnswer:
        """Find ``T_target_source`` by the lines of the settings' method alone."""
        extractor, settings = self._extractors[-1]
        start_s = time.perf_counter()
        lines = side_by_side(extractor.extract, source, target)
        extract_s = time.perf_counter() - start_s
        return PairAnswer(register_lines(*lines, settings=settings), lines, extract_s)


def _sure(matching: MatchingSettings) -> MatchingSettings:
    """Return settings for geometric lines that need no network to be sure."""
    return matching.model_copy(
        update={
            "min_log_odds": matching.min_log_odds - LACKING_LOG_ODDS,
            "min_overlap": max(matching.min_overlap, SURE_OVERLAP),
        }
    )
