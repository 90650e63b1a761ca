"""Where in a saved line map is a scan, or a short run of them? No first guess, a reasoned no."""

from collections.abc import Sequence

import numpy as np

from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.mapping.line_map import LineMap
from sl3d_slam.relocalization.map_finder import MapFinder
from sl3d_slam.relocalization.window import join_scans
from sl3d_slam.types import Relocalization, View


class Relocalizer:
    """Finds scans in a line map.

    The map needs its verification cloud (``map.clouds``): lines alone cannot tell one row of lamps
    from the next.
    """

    def __init__(
        self,
        line_map: LineMap,
        config: SlamConfig | None = None,
        extractor: LineExtractor | None = None,
    ) -> None:
        """Index a map.

        Raises
        ------
        InputError
            where it holds nothing to be found by, or lines of another model than the extractor's.
        """
        self._config = config or SlamConfig()
        self._extractor = extractor or LineExtractor(self._config.lines)
        if line_map.model != self._extractor.model:
            raise InputError(
                f"the map's lines are of the model {line_map.model}, the scans' would be of "
                f"{self._extractor.model}; expected one model for both (lines.method)"
            )
        self._finder = MapFinder(line_map, self._config)

    def relocalize(self, points_lidar: np.ndarray) -> Relocalization:
        """Find the pose of a scan (N, 3), metres in the lidar frame, in the map.

        Returns
        -------
        Relocalization; ``success=False`` carries a reason and no pose.

        Raises
        ------
        InputError
            where the points are no (N, 3) of finite floats, or fewer than 50.
        """
        return self.relocalize_window([points_lidar])

    def relocalize_window(self, scans: Sequence[np.ndarray]) -> Relocalization:
        """Find the pose of the last of a few consecutive scans, which odometry joins to one view.

        Several scans show more lines and more sides of them than one: the way out where a single
        scan is a no. Raises as :meth:`relocalize`, and where there is no scan.
        """
        return self.relocalize_view(join_scans(scans, self._extractor, self._config))

    def relocalize_view(self, view: View) -> Relocalization:
        """Find the pose of a view, its lines by the map's model, in the map."""
        return self._finder.find(view).relocalization
