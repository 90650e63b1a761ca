"""What the network says of the points of a scan."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64


@dataclass(frozen=True, slots=True, eq=False)
class Inference:
    """Line probability per point; ``describe`` gives unit descriptors of some, by their rows."""

    probability: Float32[np.ndarray, "M"]
    describe: Callable[[Int64[np.ndarray, "P"]], Float32[np.ndarray, "P D"]]
