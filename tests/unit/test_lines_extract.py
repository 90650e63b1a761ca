"""The geometric extractor against scans ray-cast from a world of known poles and walls."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl3d_slam.config import LineSettings
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.ground import heights_above_ground, up_direction
from sl3d_slam.geometry.se3 import from_yaw, make_transform, transform_points
from sl3d_slam.lines.extract import LineExtractor
from sl3d_slam.types import LineKind

SENSOR_HEIGHT_M = 1.7
POLE = (9.0, 4.0, 0.08)
CORNER = np.array([8.0, -6.0])
WALL_END = np.array([-6.0, 12.0])
WALLS = (
    ((8.0, -6.0), (20.0, -6.0)),
    ((8.0, -6.0), (8.0, -16.0)),
    ((-20.0, 12.0), (-6.0, 12.0)),
)


class World:
    """Upright cylinders and walls on flat ground, seen from the origin at a height."""

    def __init__(self, poles=(), walls=(), pole_top_m=4.0, wall_top_m=6.0):
        self.poles, self.walls = poles, walls
        self.pole_top_m, self.wall_top_m = pole_top_m, wall_top_m

    def scan(self, origin=(0.0, 0.0), beams=64, columns=1800):
        """Return the noiseless returns of a sweep, in the frame of a level sensor at ``origin``."""
        elevation, azimuth = np.meshgrid(
            np.radians(np.linspace(-24.0, 8.0, beams)),
            np.linspace(-np.pi, np.pi, columns, endpoint=False) + 1e-4,
            indexing="ij",
        )
        heading = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1).reshape(-1, 2)
        rise = np.tan(elevation).ravel()
        reach = np.full(len(rise), np.inf)
        down = rise < 0
        reach[down] = -SENSOR_HEIGHT_M / rise[down]
        for x, y, radius in self.poles:
            hit = _cylinder(heading, np.array([x, y]) - origin, radius)
            reach = self._nearer(reach, hit, rise, self.pole_top_m)
        for begin, stop in self.walls:
            hit = _segment(heading, np.array(begin) - origin, np.array(stop) - origin)
            reach = self._nearer(reach, hit, rise, self.wall_top_m)
        seen = reach < 70.0
        return np.c_[heading[seen] * reach[seen, None], rise[seen] * reach[seen]]

    def _nearer(self, reach, hit, rise, top_m):
        height = SENSOR_HEIGHT_M + np.where(np.isfinite(hit), hit, 0.0) * rise
        return np.where((height > 0) & (height < top_m), np.minimum(reach, hit), reach)


def _cylinder(heading, centre, radius):
    along = heading @ centre
    squared = radius**2 - (centre @ centre - along**2)
    hits = (squared >= 0) & (along > 0)
    return np.where(hits, along - np.sqrt(np.maximum(squared, 0)), np.inf)


def _segment(heading, begin, stop):
    edge = stop - begin
    cross = heading[:, 0] * edge[1] - heading[:, 1] * edge[0]
    safe = np.where(np.abs(cross) < 1e-12, 1e-12, cross)
    reach = (begin[0] * edge[1] - begin[1] * edge[0]) / safe
    share = (begin[0] * heading[:, 1] - begin[1] * heading[:, 0]) / safe
    return np.where((reach > 0) & (share >= 0) & (share <= 1), reach, np.inf)


def places(lines):
    """Return where lines stand, seen from above."""
    return lines.endpoints.mean(axis=1)[:, :2]


def miss_m(lines, truth):
    """Return the distance from a true place to the nearest line."""
    return np.linalg.norm(places(lines) - truth, axis=1).min(initial=np.inf)


def tilt_deg(lines):
    delta = lines.endpoints[:, 1] - lines.endpoints[:, 0]
    return np.degrees(np.arccos(np.abs(delta[:, 2]) / np.linalg.norm(delta, axis=1)))


def nearest_m(first, second):
    """Return for each line of ``first`` the distance of its ends to the nearest of ``second``."""
    ends = np.sort(first.endpoints[:, :, 2], axis=1), np.sort(second.endpoints[:, :, 2], axis=1)
    plan = np.linalg.norm(places(first)[:, None] - places(second)[None], axis=2)
    height = np.abs(ends[0][:, None] - ends[1][None]).max(axis=2)
    return np.maximum(plan, 0.2 * height).min(axis=1, initial=np.inf)


@pytest.fixture(scope="module")
def extractor():
    return LineExtractor(LineSettings(method="geometric"))


@pytest.fixture(scope="module")
def street():
    rng = np.random.default_rng(5)
    poles = [
        (*xy, radius)
        for xy, radius in zip(
            rng.uniform(-25, 25, (14, 2)), rng.uniform(0.05, 0.2, 14), strict=True
        )
        if np.hypot(*xy) > 5 and np.linalg.norm(xy - CORNER) > 3
    ]
    points = World(poles, WALLS).scan()
    return points + rng.normal(0.0, 0.01, points.shape)


def test_pole_axis_of_noiseless_points(extractor):
    lines = extractor.extract(World([POLE]).scan())
    assert lines.kinds.tolist() == [LineKind.POLE]
    # 0.17 deg between columns at 10 m is 3 cm: the width, hence the axis, is known to 1-2 cm
    assert miss_m(lines, POLE[:2]) < 0.02
    assert tilt_deg(lines)[0] < 0.3
    low, high = np.sort(lines.endpoints[0, :, 2])
    assert low < -SENSOR_HEIGHT_M + 0.45  # ground clearance 0.25 plus one ring and one voxel
    assert high > 8.0 / 57.3 * 9.8 - 0.25  # the top beam is at 8 deg


@pytest.mark.parametrize("radius", [0.05, 0.12, 0.25])
def test_axis_is_the_same_from_opposite_sides(extractor, radius):
    world = World([(0.0, 0.0, radius)])
    seen = []
    for origin in ((9.0, 3.0), (-9.0, -3.0)):
        lines = extractor.extract(world.scan(origin))
        assert len(lines) == 1
        seen.append(places(lines)[0] + origin)
    # the visible fronts lie two radii apart; the axes must agree to a few centimetres
    assert np.linalg.norm(seen[0] - seen[1]) < 0.05


@pytest.mark.parametrize("sigma_m", [0.01, 0.03])
def test_axis_error_grows_no_faster_than_the_noise(extractor, rng_seed_count, sigma_m):
    points = World([POLE]).scan()
    errors = []
    for seed in range(rng_seed_count):
        noise = np.random.default_rng(seed).normal(0.0, sigma_m, points.shape)
        lines = extractor.extract(points + noise)
        errors.append(miss_m(lines, POLE[:2]))
    # a few hundred returns average the noise away; what stays is the bias of the radius
    assert np.median(errors) < 0.02 + sigma_m


@pytest.fixture(scope="module")
def rng_seed_count():
    return 5


def test_corner_is_where_the_wall_planes_meet(extractor):
    lines = extractor.extract(World(walls=WALLS[:2]).scan())
    assert miss_m(lines, CORNER) < 0.02
    corner = lines.take(np.argsort(np.linalg.norm(places(lines) - CORNER, axis=1))[:1])
    assert corner.kinds[0] == LineKind.VERTICAL_EDGE
    assert np.ptp(corner.endpoints[0, :, 2]) > 2.0
    assert tilt_deg(corner)[0] < 0.5


def test_recess_corner_is_found_too(extractor):
    walls = (((14.0, -8.0), (14.0, 6.0)), ((14.0, 6.0), (5.0, 6.0)))
    lines = extractor.extract(World(walls=walls).scan())
    assert miss_m(lines, np.array([14.0, 6.0])) < 0.02


def test_true_end_of_a_wall_is_an_edge(extractor):
    lines = extractor.extract(World(walls=WALLS[2:]).scan())
    # columns are 0.2 deg apart, 6 cm on this wall, and the end lies between two of them
    assert miss_m(lines, WALL_END) < 0.08


def test_end_made_by_an_occluder_is_not_an_edge(extractor):
    """A nearer wall hides the rest of a farther one: the edge of its shadow is no line."""
    nearer = ((-12.0, 6.0), (-3.0, 6.0))
    world = World(walls=(((-30.0, 12.0), (30.0, 12.0)), nearer))
    lines = extractor.extract(world.scan())
    for end in nearer:
        shadow = np.array(end) * 2.0
        assert miss_m(lines, shadow) > 0.5
        assert miss_m(lines, np.array(end)) < 0.08


def test_rings_on_the_ground_are_not_lines(extractor):
    assert len(extractor.extract(World().scan())) == 0


def test_slit_between_two_occluders_is_not_a_pole(extractor):
    walls = (((-30.0, 15.0), (30.0, 15.0)), ((-9.0, 7.0), (-0.1, 7.0)), ((0.1, 7.0), (9.0, 7.0)))
    lines = extractor.extract(World(walls=walls).scan())
    assert miss_m(lines, np.array([0.0, 15.0])) > 0.5


def test_something_is_found_in_the_street(extractor, street):
    lines = extractor.extract(street)
    assert (lines.kinds == LineKind.POLE).sum() >= 6
    assert miss_m(lines, CORNER) < 0.05
    np.testing.assert_allclose(np.linalg.norm(lines.descriptors, axis=1), 1.0, atol=1e-5)
    assert lines.scores.min() >= 0
    assert lines.scores.max() <= 1
    assert (np.diff(lines.scores) <= 0).all()


def test_order_of_points_does_not_matter(extractor, street):
    lines = extractor.extract(street)
    shuffled = extractor.extract(street[np.random.default_rng(1).permutation(len(street))])
    # only the rounding of sums depends on the order
    np.testing.assert_allclose(shuffled.endpoints, lines.endpoints, atol=1e-6)
    np.testing.assert_allclose(shuffled.descriptors, lines.descriptors, atol=1e-5)
    assert shuffled.num_points.tolist() == lines.num_points.tolist()


def test_same_scan_same_lines_whatever_the_float_type(extractor, street):
    single = extractor.extract(street.astype(np.float32))
    double = extractor.extract(street.astype(np.float32).astype(np.float64))
    np.testing.assert_array_equal(single.endpoints, double.endpoints)


@pytest.mark.parametrize("yaw_deg", [33.0, 140.0, -101.0])
def test_heading_of_the_sensor_does_not_matter(extractor, street, yaw_deg):
    T_turned_lidar = from_yaw(np.radians(yaw_deg), np.zeros(3))
    lines = extractor.extract(street)
    turned = extractor.extract(transform_points(T_turned_lidar, street))
    moved = lines.transformed(T_turned_lidar)
    # voxels are cut differently: all but one in ten again, within 5 cm (ends within 25 cm)
    for first, second in ((moved, turned), (turned, moved)):
        assert np.mean(nearest_m(first, second) < 0.05) >= 0.9


@pytest.mark.parametrize("axis_deg", [20.0, 115.0, 260.0])
def test_tilt_of_the_sensor_does_not_matter(extractor, street, axis_deg):
    a = np.radians(axis_deg)
    tilt = Rotation.from_rotvec(np.radians(10.0) * np.array([np.cos(a), np.sin(a), 0.0]))
    T_tilted_lidar = make_transform(tilt.as_matrix(), np.zeros(3))
    lines = extractor.extract(street)
    tilted = extractor.extract(transform_points(T_tilted_lidar, street))
    level = tilted.transformed(np.linalg.inv(T_tilted_lidar))
    for first, second in ((lines, level), (level, lines)):
        assert np.mean(nearest_m(first, second) < 0.06) >= 0.9


def test_descriptor_of_a_line_survives_a_change_of_heading(extractor, street):
    T_turned_lidar = from_yaw(2.0, np.zeros(3))
    lines = extractor.extract(street)
    turned = extractor.extract(transform_points(T_turned_lidar, street))
    plan = np.linalg.norm(
        places(lines.transformed(T_turned_lidar))[:, None] - places(turned)[None], axis=2
    )
    pairs = [(i, int(j)) for i, j in enumerate(plan.argmin(axis=1)) if plan[i, j] < 0.05]
    similarity = [float(lines.descriptors[i] @ turned.descriptors[j]) for i, j in pairs]
    assert len(pairs) >= 8
    # voxels and the context's cells are cut differently, which moves a few counts
    assert np.median(similarity) > 0.99
    assert min(similarity) > 0.85


def test_at_most_the_best_lines_are_kept(street):
    everything = LineExtractor(LineSettings(method="geometric")).extract(street)
    few = LineExtractor(LineSettings(method="geometric", max_lines=4)).extract(street)
    np.testing.assert_array_equal(few.endpoints, everything.endpoints[:4])


def test_lines_shorter_than_asked_are_dropped(street):
    lines = LineExtractor(LineSettings(method="geometric", min_length_m=2.0)).extract(street)
    lengths = np.linalg.norm(lines.endpoints[:, 1] - lines.endpoints[:, 0], axis=1)
    assert len(lines) > 0
    assert lengths.min() >= 2.0


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.zeros((0, 3)), "0 points"),
        (np.zeros((49, 3)), "49 points"),
        (np.zeros((100, 4)), r"\(100, 4\)"),
        (np.zeros(300), r"\(300,\)"),
        (np.zeros((100, 3), int), "int64"),
        (np.full((100, 3), np.nan), "NaN"),
        (np.full((100, 3), np.inf), "NaN or infinite"),
    ],
)
def test_malformed_points_are_refused(extractor, points, words):
    with pytest.raises(InputError, match=words):
        extractor.extract(points)


def test_scan_without_any_structure_gives_no_lines(extractor):
    assert len(extractor.extract(np.full((100, 3), 5.0))) == 0
    far = np.random.default_rng(0).uniform(200.0, 300.0, (100, 3))
    assert extractor.extract(far).descriptors.shape == (0, 28)


def test_up_direction_of_a_tilted_sensor(street):
    tilt = Rotation.from_euler("xy", [8.0, -5.0], degrees=True).as_matrix()
    up = up_direction(street @ tilt.T)
    error_deg = np.degrees(np.arccos(np.clip(up @ tilt[:, 2], -1, 1)))
    assert error_deg < 0.2  # ground noise of 1 cm over 30 m


def test_up_direction_where_there_is_no_ground():
    points = np.random.default_rng(0).normal(0.0, 0.3, (200, 3))
    np.testing.assert_array_equal(up_direction(points), [0.0, 0.0, 1.0])


def test_up_direction_where_all_ground_lies_on_one_line():
    """Nothing says how the ground lies across the line, and rounding may say that it is NaN."""
    along = np.repeat(np.linspace(3.0, 30.0, 60), 3_333)
    points = np.c_[along * np.cos(0.3), along * np.sin(0.3), np.full(len(along), -1.7)]
    up = up_direction(points)
    assert abs(np.linalg.norm(up) - 1.0) < 1e-9
    assert up[2] > np.cos(np.radians(25.0))


def test_ground_is_found_on_a_slope_and_under_walls():
    rng = np.random.default_rng(2)
    ground = rng.uniform(-30, 30, (40_000, 3))
    ground[:, 2] = 0.1 * ground[:, 0] - 1.7
    wall = np.c_[np.full(4000, 12.0), rng.uniform(-10, 10, 4000), rng.uniform(0.0, 4.0, 4000)]
    wall[:, 2] += 0.1 * 12.0 - 1.7 + 0.6
    up = np.array([0.0, 0.0, 1.0])
    heights = heights_above_ground(np.vstack([ground, wall]), up)
    assert np.abs(heights[: len(ground)]).max() < 0.15  # a slope of 10 % over 1 m cells
    np.testing.assert_allclose(heights[len(ground) :], wall[:, 2] - (0.1 * 12.0 - 1.7), atol=0.15)


def test_mirror_images_below_the_street_do_not_lower_it():
    rng = np.random.default_rng(3)
    ground = np.c_[rng.uniform(-20, 20, (20_000, 2)), np.full(20_000, -1.7)]
    ghosts = np.c_[rng.uniform(5, 7, (60, 2)), np.full(60, -4.5)]
    up = np.array([0.0, 0.0, 1.0])
    heights = heights_above_ground(np.vstack([ground, ghosts]), up)
    assert np.abs(heights[: len(ground)]).max() < 0.05
