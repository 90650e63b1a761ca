"""What became of a loop, and the sentences that say why."""

from dataclasses import dataclass
from typing import Literal

from sl3d_slam.graph.consistency import OdometryCheck
from sl3d_slam.types import LoopConstraint

Status = Literal["accepted", "rejected", "revoked"]


@dataclass(frozen=True, slots=True, eq=False)
class Verdict:
    """What became of a loop; ``index`` counts the loops in the order they were offered."""

    index: int
    loop: LoopConstraint
    status: Status
    reason: str


def contradicts_odometry(check: OdometryCheck, allowed: float) -> str:
    """Say that the odometry rules a loop out."""
    return (
        f"contradicts the odometry: off by {check.offset_m:.1f} m and {check.offset_deg:.1f} deg, "
        f"{check.squared_inflated**0.5:.1f} inflated sigmas where {allowed**0.5:.1f} are allowed"
    )


def stands_alone(check: OdometryCheck, num_confirming: int, max_sigma_m: float) -> str:
    """Say why a loop that too few others confirm must wait."""
    if check.sigma_m > max_sigma_m:
        because = f"the odometry is uncertain by {check.sigma_m:.0f} m there"
    else:
        because = f"it is {check.squared**0.5:.1f} sigmas off the odometry"
    return f"waits for loops that confirm it (now {num_confirming}): {because}"


def contradicts_loops(num_against: int, num_set: int) -> str:
    """Say that a larger set of loops rules a loop out."""
    return f"contradicts {num_against} of {num_set} loops that agree with one another"


def does_not_fit(squared: float, threshold: float) -> str:
    """Say that the optimisation over all loops leaves a loop unsatisfied."""
    return (
        f"does not fit the other loops: {squared**0.5:.1f} sigmas off after optimising, "
        f"{threshold**0.5:.1f} are allowed"
    )


def agrees(check: OdometryCheck, num_confirming: int) -> str:
    """Say what speaks for a loop."""
    loops = f"{num_confirming} other loop{'' if num_confirming == 1 else 's'}"
    return f"{check.squared**0.5:.1f} sigmas off the odometry, confirmed by {loops}"
