"""Ways to register two scans that ``bench registration`` compares; each says what it took.

A method is given points of two scans, (N, 3) metres each, and no first guess.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sl3d_slam.bench.peers import importing
from sl3d_slam.config import SlamConfig
from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Points, Transform, make_transform

KISS_VOXEL_M = 0.3  # what its authors use outdoors
KISS_MIN_INLIERS = 5  # below this its authors call an answer unreliable
VOXEL_M = 0.5
FEATURE_RADIUS_M = 5.0 * VOXEL_M
MATCH_DISTANCE_M = 1.5 * VOXEL_M
ICP_DISTANCE_M = 2.0
RANSAC_ITERATIONS = 50_000


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """What a method answered.

    Attributes
    ----------
    T_target_source : None where the method said no.
    extract_s : for lines or features of both scans.
    match_s : from there to the answer.
    can_refuse : whether the method ever says no by itself.
    """

    T_target_source: Transform | None
    extract_s: float
    match_s: float
    can_refuse: bool = True


Method = Callable[[Points, Points], Attempt]
Pairwise = Callable[[Points, Points], list[Attempt]]  # one attempt a method


def ours(config: SlamConfig) -> Pairwise:
    """Return this package's registration, verified on the clouds and by lines alone."""
    from sl3d_slam.scan_pair import PairRegistrar

    registrar = PairRegistrar(config)

    def register(source: Points, target: Points) -> list[Attempt]:
        attempts = []
        for way in (registrar.register, registrar.register_by_lines):
            start_s = time.perf_counter()
            answer = way(source, target)
            total_s = time.perf_counter() - start_s
            pose = answer.registration.T_target_source if answer.registration.success else None
            attempts.append(Attempt(pose, answer.extract_s, total_s - answer.extract_s))
        return attempts

    return register


def kiss_matcher() -> Method:
    """Return KISS-Matcher (Lim et al., ICRA 2025) with its authors' outdoor voxels."""
    with importing("kiss-matcher"):
        import kiss_matcher as peer

    def register(source: Points, target: Points) -> Attempt:
        start_s = time.perf_counter()
        matcher = peer.KISSMatcher(peer.KISSMatcherConfig(voxel_size=KISS_VOXEL_M))
        matched = matcher.match(np.asfortranarray(source.T), np.asfortranarray(target.T))
        solution = matcher.prune_and_solve(*matched)
        total_s = time.perf_counter() - start_s
        extract_s = float(matcher.get_processing_time() + matcher.get_extraction_time())
        sure = solution.valid and matcher.get_num_final_inliers() >= KISS_MIN_INLIERS
        translation = np.asarray(solution.translation, np.float64).ravel()
        pose = make_transform(np.asarray(solution.rotation, np.float64), translation)
        return Attempt(pose if sure else None, extract_s, total_s - extract_s)

    return register


def fpfh_ransac(iterations: int = RANSAC_ITERATIONS) -> Method:
    """Return RANSAC on FPFH features (Open3D)."""
    o3d = _open3d()
    registration = o3d.pipelines.registration

    def match(clouds: list[Any], features: list[Any]) -> Any:
        return registration.registration_ransac_based_on_feature_matching(
            *clouds,
            *features,
            True,
            MATCH_DISTANCE_M,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(MATCH_DISTANCE_M),
            ],
            registration.RANSACConvergenceCriteria(iterations, 0.999),
        )

    return _feature_method(o3d, match)


def fgr() -> Method:
    """Return Fast Global Registration (Zhou et al., ECCV 2016) on FPFH features (Open3D)."""
    o3d = _open3d()
    registration = o3d.pipelines.registration

    def match(clouds: list[Any], features: list[Any]) -> Any:
        option = registration.FastGlobalRegistrationOption(
            maximum_correspondence_distance=MATCH_DISTANCE_M
        )
        return registration.registration_fgr_based_on_feature_matching(*clouds, *features, option)

    return _feature_method(o3d, match)


def icp() -> Method:
    """Return point-to-plane ICP from the identity (Open3D)."""
    o3d = _open3d()
    registration = o3d.pipelines.registration

    def register(source: Points, target: Points) -> Attempt:
        start_s = time.perf_counter()
        clouds = [_with_normals(o3d, points) for points in (source, target)]
        middle_s = time.perf_counter()
        answer = registration.registration_icp(
            *clouds,
            ICP_DISTANCE_M,
            np.eye(4),
            registration.TransformationEstimationPointToPlane(),
            registration.ICPConvergenceCriteria(max_iteration=100),
        )
        pose = np.array(answer.transformation)
        return Attempt(pose, middle_s - start_s, time.perf_counter() - middle_s, can_refuse=False)

    return register


def make_methods(names: Sequence[str], config: SlamConfig, seed: int) -> Pairwise:
    """Return what runs in one process: both of ours, or one peer by its name in the tables.

    ``fpfh-ransac@N`` runs N iterations.

    Raises
    ------
    MissingExtraError
        where a peer is not installed, saying how to install it.
    InputError
        where there is no such method.
    """
    if tuple(names) == OURS:
        return ours(config)
    peer = _make_peer(names[0], seed)
    return lambda source, target: [peer(source, target)]


def _make_peer(name: str, seed: int) -> Method:
    base, _, iterations = name.partition("@")
    match base:
        case "kiss-matcher":
            return kiss_matcher()
        case "fpfh-ransac":
            _open3d().utility.random.seed(seed)
            return fpfh_ransac(int(iterations or RANSAC_ITERATIONS))
        case "fgr":
            return fgr()
        case "icp":
            return icp()
    raise InputError(f"{name}: unknown method; expected some of {', '.join(PEERS)}")


OURS = ("sl3d-slam", "sl3d-slam, lines alone")
PEERS = ("kiss-matcher", "fpfh-ransac", "fgr", "icp")


def _open3d() -> Any:
    with importing("open3d"):
        import open3d
    return open3d


def _with_normals(o3d: Any, points: Points) -> Any:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud = cloud.voxel_down_sample(VOXEL_M)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2.0 * VOXEL_M, 30))
    cloud.orient_normals_towards_camera_location(np.zeros(3))  # or FPFH finds a third less
    return cloud


def _feature_method(o3d: Any, match: Callable[[list[Any], list[Any]], Any]) -> Method:
    search = o3d.geometry.KDTreeSearchParamHybrid(FEATURE_RADIUS_M, 100)

    def register(source: Points, target: Points) -> Attempt:
        start_s = time.perf_counter()
        clouds = [_with_normals(o3d, points) for points in (source, target)]
        features = [
            o3d.pipelines.registration.compute_fpfh_feature(cloud, search) for cloud in clouds
        ]
        middle_s = time.perf_counter()
        answer = match(clouds, features)
        pose = np.array(answer.transformation)
        return Attempt(pose, middle_s - start_s, time.perf_counter() - middle_s, can_refuse=False)

    return register
