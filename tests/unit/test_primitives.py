"""The shapes of the synthetic stage: what is labelled a line must lie on one, by geometry."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl3d_slam.geometry.se3 import make_transform
from sl3d_slam.learning.primitives import (
    BACKGROUND,
    Primitive,
    distances_to_segments_m,
    make_corner,
    make_pole,
    sample_surface,
)
from sl3d_slam.types import LineKind

TURN = make_transform(
    Rotation.from_euler("zyx", [0.7, 0.1, -0.2]).as_matrix(), np.array([3.0, -5, 2])
)


@pytest.mark.parametrize("seed", range(5))
def test_corner_labels_are_what_lies_near_an_edge(seed):
    rng = np.random.default_rng(seed)
    corner = make_corner(rng).moved(TURN)
    points, line_id = sample_surface(corner, 3000, 0.3, rng)
    distance = distances_to_segments_m(points, corner.edges)
    on_edge = distance.min(axis=1) <= 0.3
    np.testing.assert_array_equal(line_id >= 0, on_edge)
    np.testing.assert_array_equal(line_id[on_edge], distance[on_edge].argmin(axis=1))
    assert set(np.unique(line_id)) == {BACKGROUND, 0, 1, 2}


def test_edges_of_a_corner_are_where_two_of_its_planes_meet(rng):
    corner = make_corner(rng).moved(TURN)
    normals = np.cross(corner.faces[:, 1], corner.faces[:, 2])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for edge in corner.edges:
        off = np.abs(np.einsum("efd,fd->ef", edge[:, None] - corner.faces[:, 0], normals))
        assert (off.max(axis=0) < 1e-9).sum() == 2  # rounding: both ends on exactly two planes


def test_pole_points_lie_on_the_cylinder_and_the_base_belongs_to_no_line(rng):
    pole = make_pole(rng).moved(TURN)
    points, line_id = sample_surface(pole, 20_000, 0.3, rng)
    foot, axis, (radius_m, _, _) = pole.cylinders[0]
    offset = points[line_id == 0] - foot
    along = offset @ axis / np.linalg.norm(axis)
    across = np.linalg.norm(offset - np.outer(along, axis / np.linalg.norm(axis)), axis=1)
    np.testing.assert_allclose(across, radius_m, atol=1e-9)
    assert along.min() >= 0
    assert along.max() <= np.linalg.norm(axis)
    normal = np.cross(pole.faces[0, 1], pole.faces[0, 2])
    off_base = (points[line_id < 0] - pole.faces[0, 0]) @ normal / np.linalg.norm(normal)
    np.testing.assert_allclose(off_base, 0.0, atol=1e-9)
    # even by area: the share on the cylinder within five standard deviations of a coin's
    share = pole.areas_m2[1] / pole.areas_m2.sum()
    tolerance = 5.0 * np.sqrt(share * (1 - share) / 20_000)
    assert abs((line_id == 0).mean() - share) < tolerance


def test_kinds_follow_from_the_direction():
    edges = np.array([[[0, 0, 0], [0, 0, 3.0]], [[0, 0, 0], [3.0, 0, 0]]])
    cylinder = np.array([[[0, 0, 0], [0, 0, 2.0], [0.1, 0, 0]]])
    shape = Primitive(np.zeros((0, 3, 3)), cylinder, edges)
    expected = [LineKind.VERTICAL_EDGE, LineKind.OTHER_EDGE, LineKind.POLE]
    assert shape.kinds.tolist() == expected


def test_moving_a_shape_moves_its_lines_and_keeps_its_areas(rng):
    corner = make_corner(rng)
    moved = corner.moved(TURN)
    expected = corner.lines @ TURN[:3, :3].T + TURN[:3, 3]
    np.testing.assert_allclose(moved.lines, expected, atol=1e-9)
    np.testing.assert_allclose(moved.areas_m2, corner.areas_m2, rtol=1e-9)


def test_distance_to_a_segment_by_hand():
    segment = np.array([[[0.0, 0, 0], [2.0, 0, 0]]])
    points = np.array([[1.0, 3, 0], [5.0, 4, 0], [-3.0, 0, 4]])
    np.testing.assert_allclose(distances_to_segments_m(points, segment)[:, 0], [3.0, 5.0, 5.0])
