"""Where a map lies on the Earth, as its header and ``run.json`` hold it."""

from typing import Any

import numpy as np

from sl3d_slam.geometry.geodesy import GeoOrigin, GeoReference

MAX_ERROR = 1e-6  # of R^T R from the identity


def georeference_tree(georeference: GeoReference | None) -> dict[str, Any] | None:
    """Return ``T_enu_map`` (4 x 4) and the origin's degrees and metres (None: metric GPS)."""
    if georeference is None:
        return None
    origin = georeference.origin
    return {
        "T_enu_map": georeference.T_enu_map.tolist(),
        "origin": None
        if origin is None
        else {
            "latitude_deg": origin.latitude_deg,
            "longitude_deg": origin.longitude_deg,
            "altitude_m": origin.altitude_m,
        },
    }


def georeference_of(tree: object) -> GeoReference | None:
    """Read what :func:`georeference_tree` gives. Raises ValueError, for a file to be named."""
    if tree is None:
        return None
    try:
        T_enu_map = np.array(tree["T_enu_map"], np.float64)  # type: ignore[index]
        origin = tree["origin"]  # type: ignore[index]
        numbers = [] if origin is None else [float(origin[name]) for name in GeoOrigin.__slots__]
    except (TypeError, KeyError, ValueError, AttributeError):
        raise ValueError("expected georeference with T_enu_map and origin") from None
    finite = T_enu_map.shape == (4, 4) and np.isfinite(T_enu_map).all()
    if not finite or not np.isfinite(numbers).all():
        raise ValueError("expected georeference with a finite 4 x 4 T_enu_map and origin")
    R = T_enu_map[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > MAX_ERROR or np.linalg.det(R) < 0:
        raise ValueError("expected a rigid T_enu_map")
    return GeoReference(T_enu_map, GeoOrigin(*numbers) if numbers else None)
