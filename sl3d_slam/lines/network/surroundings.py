"""The last layer of descriptors: what stands around a line, told by the other lines of its scan.

A point's features reach some ten metres, and trunks in a row look alike. What stands near and far
around them does not.

Products are einsum's: on some processors BLAS adds up in an order that its number of threads
decides, and a drive would be another one with each.
"""

import numpy as np
from jaxtyping import Float, Float32

from sl3d_slam.lines.network.shapes import RINGS
from sl3d_slam.lines.network.weights_format import Tensors

RINGS_M = ((3.0, 2.0), (8.0, 3.0), (15.0, 4.0), (23.0, 4.0), (32.0, 5.0))  # radius, width
PRIOR = 0.3  # of a line's score; little that is heard counts little

assert len(RINGS_M) == RINGS


def heard_around(
    descriptors: Float32[np.ndarray, "L D"],
    places_m: Float[np.ndarray, "L 2"],
    scores: Float[np.ndarray, "L"],
) -> Float32[np.ndarray, "L E"]:
    """Return each line's descriptor and, ring after ring, the mean one of the lines around it.

    ``places_m`` are the lines seen from above, in any frame that stands level: distances alone
    count. Ring r of radius a and width c holds ``sum_j w_ij d_j / (PRIOR + sum_j w_ij)`` over the
    other lines j, where ``w_ij = score_j exp(-(|x_i - x_j| - a)^2 / 2 c^2)``. A lone line hears
    nothing: zeros.
    """
    offset = places_m[:, None] - places_m[None]
    apart_m = np.sqrt(np.einsum("ijk,ijk->ij", offset, offset))
    parts = [descriptors]
    for radius_m, width_m in RINGS_M:
        weight = scores[None] * np.exp(-0.5 * ((apart_m - radius_m) / width_m) ** 2)
        np.fill_diagonal(weight, 0.0)
        heard = np.einsum("ij,jd->id", weight, descriptors)
        parts.append(heard / (PRIOR + weight.sum(axis=1, keepdims=True)))
    return np.concatenate(parts, axis=1).astype(np.float32)


def in_surroundings(
    descriptors: Float32[np.ndarray, "L D"],
    places_m: Float[np.ndarray, "L 2"],
    scores: Float[np.ndarray, "L"],
    tensors: Tensors,
) -> Float32[np.ndarray, "L D"]:
    """Return the unit descriptors that the layer of these weights makes of mean ones."""
    heard = heard_around(descriptors, places_m, scores)
    values = np.einsum("le,de->ld", heard, tensors["surroundings.weight"])
    values += tensors["surroundings.bias"]
    lengths = np.linalg.norm(values, axis=1, keepdims=True)
    return np.asarray(values / np.maximum(lengths, 1e-12), np.float32)
