"""Line segments as end-point pairs, shape (L, 2, 3), metres; end points carry no order."""

import numpy as np
from jaxtyping import Float64

from sl3d_slam.geometry.se3 import Transform

Segments = Float64[np.ndarray, "L 2 3"]


def directions(endpoints: Segments) -> Float64[np.ndarray, "L 3"]:
    """Return unit vectors from the first end point to the second; zero where they coincide."""
    delta = endpoints[:, 1] - endpoints[:, 0]
    return delta / np.maximum(np.linalg.norm(delta, axis=1, keepdims=True), 1e-12)


def midpoints(endpoints: Segments) -> Float64[np.ndarray, "L 3"]:
    """Return the middle of each segment."""
    return endpoints.mean(axis=1)


def lengths_m(endpoints: Segments) -> Float64[np.ndarray, "L"]:
    """Return the length of each segment."""
    return np.linalg.norm(endpoints[:, 1] - endpoints[:, 0], axis=1)


def transform_segments(T_a_b: Transform, endpoints_b: Segments) -> Segments:
    """Express segments given in frame b in frame a."""
    return endpoints_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def angles_rad(
    first: Float64[np.ndarray, "A 3"], second: Float64[np.ndarray, "B 3"]
) -> Float64[np.ndarray, "A B"]:
    """Return the angle between each pair of undirected unit vectors, in [0, pi/2]."""
    return np.arccos(np.clip(np.abs(first @ second.T), 0.0, 1.0))


def distance_to_line_m(
    points: Float64[np.ndarray, "N 3"],
    origin: Float64[np.ndarray, "3"],
    direction: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "N"]:
    """Return the distance of points from the infinite line ``origin + s * direction``."""
    return np.linalg.norm(np.cross(points - origin, direction), axis=1)
