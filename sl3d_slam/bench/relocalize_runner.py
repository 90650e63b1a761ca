"""Scans against one large map, in a process of its own, so that memory is its own too.

A runner as :mod:`sl3d_slam.bench.process` describes it; a step is a scan.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sl3d_slam.bench.process import serve
from sl3d_slam.bench.relocalize_world import read_query
from sl3d_slam.config import SlamConfig
from sl3d_slam.geometry.se3 import distance_m, invert, rotation_angle_rad
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.mapping.line_map import LineMap
from sl3d_slam.matching.prepared import PreparedView
from sl3d_slam.matching.views import make_view
from sl3d_slam.memory import rss_mb
from sl3d_slam.relocalization.map_finder import MapFinder
from sl3d_slam.types import View


def run_task(tree: dict[str, Any], folder: Path, step: Callable[[], None]) -> dict[str, Any]:
    """Load the map, ask for every scan once; the first is asked twice, since it compiles."""
    config = SlamConfig.model_validate(tree["config"])
    extractor = LineExtractor(config.lines)
    start_mb, start_s = rss_mb(), time.perf_counter()
    line_map = LineMap.load(tree["map"])
    loaded_s, loaded_mb = time.perf_counter(), rss_mb()
    finder = MapFinder(line_map, config)
    indexed_s = time.perf_counter()
    answers = []
    for number, query in enumerate([tree["queries"][0], *tree["queries"]]):
        points, T_town_lidar = read_query(Path(query["path"]))
        view = make_view(points, extractor.extract(points), config.matching.cloud_voxel_m)
        T_map_town = None if query["T_map_town"] is None else np.array(query["T_map_town"])
        T_map_lidar = None if T_map_town is None else T_map_town @ T_town_lidar
        answer = _ask(finder, view, T_map_lidar, config)
        if number:
            answers.append(answer)
            step()
    return {
        "load_s": loaded_s - start_s,
        "index_s": indexed_s - loaded_s,
        "load_mb": loaded_mb - start_mb,
        "resident_mb": rss_mb(),
        "triangles": len(finder.retrieval.index),
        "answers": answers,
    }


def _ask(
    finder: MapFinder, view: View, T_map_lidar: np.ndarray | None, config: SlamConfig
) -> dict[str, Any]:
    """Time retrieval alone, on the process's clock, then the whole answer, places not yet seen."""
    query = PreparedView(view, config.matching)
    start_s = time.process_time()
    finder.guesses(query)
    retrieved_s = time.process_time()
    answer = finder.find(view).relocalization
    end_s = time.process_time()
    error_m = error_deg = None
    if answer.T_map_lidar is not None and T_map_lidar is not None:
        T_error = invert(T_map_lidar) @ answer.T_map_lidar
        error_m, error_deg = distance_m(T_error), np.degrees(rotation_angle_rad(T_error))
    return {
        "inside": T_map_lidar is not None,
        "found": answer.success,
        "confidence": answer.confidence,
        "reason": answer.reason,
        "error_m": error_m,
        "error_deg": error_deg,
        "retrieval_ms": 1e3 * (retrieved_s - start_s),
        "latency_ms": 1e3 * (end_s - retrieved_s),
    }


if __name__ == "__main__":
    serve(Path(sys.argv[1]), run_task)
