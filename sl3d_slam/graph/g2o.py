"""Pose graphs as g2o text files, in and out.

The conventions are those of gtsam's reader and of most published files:
``VERTEX_SE3:QUAT key x y z qx qy qz qw`` is ``T_world_key``;
``EDGE_SE3:QUAT first second x y z qx qy qz qw`` is ``T_first_second``, followed by the upper
triangle of its information, translation first, then the rotation *vector* in radians. (g2o's own
error is the quaternion's vector part, half the rotation vector; like gtsam, this module does not
scale by that factor, so g2o itself weighs rotations four times less than was meant.)
Priors are ``EDGE_SE3_PRIOR key 0 ...`` with an identity ``PARAMS_SE3OFFSET 0``, and ``FIX key``
marks a held vertex; gtsam's reader skips both. Keys are written as the whole 64-bit integer, so
two symbols with one index stay two keys; g2o's own reader holds keys in 32 bits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from sl3d_slam.errors import InputError
from sl3d_slam.geometry.se3 import Transform, make_transform
from sl3d_slam.graph.noise import Matrix6
from sl3d_slam.graph.solve import Edge, Prior

MAX_G2O_BYTES = 1_000_000_000
MAX_KEY = (1 << 64) - 1
MAX_QUATERNION_ERROR = 1e-3
OFFSET = "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"

UPPER = np.triu_indices(6)
TO_G2O = np.array([3, 4, 5, 0, 1, 2])  # its own inverse: swaps rotation and translation blocks


@dataclass(frozen=True, slots=True, eq=False)
class G2oGraph:
    """What a g2o file holds; ``fixed`` are keys of vertices that stay where they are."""

    poses: dict[int, Transform] = field(default_factory=dict)
    edges: list[Edge] = field(default_factory=list)
    priors: list[Prior] = field(default_factory=list)
    fixed: list[int] = field(default_factory=list)


def format_g2o(graph: G2oGraph) -> str:
    """Return the file's text: vertices in their order, held keys, priors, edges.

    Numbers have the 17 digits that give every float64 back exactly.
    """
    vertices = _pose_texts(list(graph.poses.values()))
    lines = [
        f"VERTEX_SE3:QUAT {key} {pose}" for key, pose in zip(graph.poses, vertices, strict=True)
    ]
    lines += [f"FIX {key}" for key in graph.fixed]
    if graph.priors:
        lines.append(OFFSET)
    for prior, pose in zip(
        graph.priors, _pose_texts([prior.T_world_key for prior in graph.priors]), strict=True
    ):
        information = _information_text(prior.information)
        lines.append(f"EDGE_SE3_PRIOR {prior.key} 0 {pose} {information}")
    for edge, pose in zip(
        graph.edges, _pose_texts([edge.T_first_second for edge in graph.edges]), strict=True
    ):
        information = _information_text(edge.information)
        lines.append(f"EDGE_SE3:QUAT {edge.first} {edge.second} {pose} {information}")
    return "".join(line + "\n" for line in lines)


def read_g2o(path: Path) -> G2oGraph:
    """Read a file of 3D poses, edges, priors and held keys; empty lines and # comments pass.

    Raises
    ------
    InputError
        naming file and line for anything else: another tag, a wrong count of fields, a number that
        is not finite, a quaternion that is not of unit length, a key that is not a vertex or is
        given twice.
    """
    graph = G2oGraph()
    references: list[tuple[int, int]] = []
    for number, line in enumerate(_lines(path), start=1):
        fields = line.split("#", 1)[0].split()
        if not fields:
            continue
        try:
            keys = _read_record(graph, fields)
        except ValueError as error:
            raise InputError(f"{path}: line {number}: {error}") from None
        references += [(number, key) for key in keys]
    for number, key in references:
        if key not in graph.poses:
            raise InputError(f"{path}: line {number}: key {key} has no VERTEX_SE3:QUAT")
    if not graph.poses:
        raise InputError(f"{path}: no VERTEX_SE3:QUAT, expected a 3D pose graph in g2o form")
    return graph


def _lines(path: Path) -> list[str]:
    try:
        size = path.stat().st_size
        if size > MAX_G2O_BYTES:
            raise InputError(f"{path}: {size} bytes, expected at most {MAX_G2O_BYTES}")
        return path.read_text(encoding="ascii").split("\n")
    except OSError as error:
        raise InputError(f"{path}: cannot be read as a g2o file ({error.strerror})") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: not text, expected a pose graph in g2o form") from None


def _read_record(graph: G2oGraph, fields: Sequence[str]) -> list[int]:
    """Add one line to the graph; return the keys it refers to."""
    tag, *rest = fields
    match tag:
        case "VERTEX_SE3:QUAT":
            (key,), pose, _ = _parse(rest, num_keys=1, has_information=False)
            if key in graph.poses:
                raise ValueError(f"vertex {key} is given twice")
            graph.poses[key] = pose
            return []
        case "EDGE_SE3:QUAT":
            (first, second), pose, information = _parse(rest, num_keys=2, has_information=True)
            graph.edges.append(Edge(first, second, pose, information))
            return [first, second]
        case "EDGE_SE3_PRIOR":
            (key, offset), pose, information = _parse(rest, num_keys=2, has_information=True)
            if offset != 0:
                raise ValueError(f"prior with sensor offset {offset}, expected offset 0 (none)")
            graph.priors.append(Prior(key, pose, information))
            return [key]
        case "FIX":
            graph.fixed.extend(_key(text) for text in rest)
            return graph.fixed[-len(rest) :] if rest else []
        case "PARAMS_SE3OFFSET":
            _require_no_offset(rest)
            return []
        case _:
            raise ValueError(
                f"unknown tag {tag[:40]!r}, expected VERTEX_SE3:QUAT, EDGE_SE3:QUAT, "
                "EDGE_SE3_PRIOR, FIX or PARAMS_SE3OFFSET"
            )


def _parse(
    fields: Sequence[str], num_keys: int, has_information: bool
) -> tuple[list[int], Transform, Matrix6]:
    """Return keys, pose and information (zero where the record has none)."""
    expected = num_keys + 7 + 21 * has_information
    if len(fields) != expected:
        raise ValueError(f"{len(fields)} fields after the tag, expected {expected}")
    keys = [_key(text) for text in fields[:num_keys]]
    numbers = _numbers(fields[num_keys:])
    information = np.zeros((6, 6))
    if has_information:
        triangle = np.zeros((6, 6))
        triangle[UPPER] = numbers[7:]
        in_g2o_order = triangle + np.triu(triangle, 1).T
        information = in_g2o_order[np.ix_(TO_G2O, TO_G2O)]
    return keys, _pose(numbers[:7]), information


def _numbers(fields: Sequence[str]) -> Float64[np.ndarray, "N"]:
    numbers = np.array([float(text) for text in fields])
    if not np.isfinite(numbers).all():
        raise ValueError("a number is not finite")
    return numbers


def _key(text: str) -> int:
    if not (text.isascii() and text.isdecimal()) or len(text) > 20 or int(text) > MAX_KEY:
        raise ValueError(f"key {text[:40]!r}, expected a whole number of at most 64 bits")
    return int(text)


def _pose(numbers: Float64[np.ndarray, "7"]) -> Transform:
    quat_xyzw = numbers[3:]
    if abs(float(np.linalg.norm(quat_xyzw)) - 1.0) > MAX_QUATERNION_ERROR:
        raise ValueError("the quaternion qx qy qz qw is not of unit length")
    return make_transform(Rotation.from_quat(quat_xyzw).as_matrix(), numbers[:3])


def _require_no_offset(fields: Sequence[str]) -> None:
    if fields[:1] != ["0"] or not np.array_equal(_numbers(fields[1:]), [0, 0, 0, 0, 0, 0, 1]):
        raise ValueError("a sensor offset, expected only 'PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1'")


def _pose_texts(poses: Sequence[Transform]) -> list[str]:
    if not poses:
        return []
    T_a_b = np.array(poses)
    quat_xyzw = Rotation.from_matrix(T_a_b[:, :3, :3]).as_quat(canonical=True)
    return [_text(row) for row in np.hstack([T_a_b[:, :3, 3], quat_xyzw])]


def _information_text(information: Matrix6) -> str:
    return _text(information[np.ix_(TO_G2O, TO_G2O)][UPPER])


def _text(numbers: Float64[np.ndarray, "N"]) -> str:
    return " ".join([format(number, ".17g") for number in numbers.tolist()])
