"""The largest set of loops that all agree with one another: maximum clique, branch and bound."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

MAX_WORK = 400_000  # vertex visits; then the best clique so far is the answer


def maximum_clique(adjacency: Bool[np.ndarray, "N N"], incumbent: Sequence[int] = ()) -> list[int]:
    """Return the vertices of a largest clique, ascending.

    Parameters
    ----------
    adjacency : symmetric; the diagonal is ignored.
    incumbent : a clique to beat: another answer must be strictly larger.

    Notes
    -----
    Exact (greedy colouring bound, Tomita & Seki 2003) unless ``MAX_WORK`` runs out, then the best
    clique found by then. No clock and no chance: same input, same answer.
    """
    count = len(adjacency)
    rows = adjacency | np.eye(count, dtype=bool)
    agrees_with_all = rows.all(axis=1)
    contested = np.flatnonzero(~agrees_with_all)
    degrees = rows[np.ix_(contested, contested)].sum(axis=1)
    order = contested[np.argsort(-degrees, kind="stable")]
    neighbours = _bitsets(rows[np.ix_(order, order)])
    rank = {int(vertex): position for position, vertex in enumerate(order)}
    search = _Search(neighbours, [rank[vertex] for vertex in incumbent if vertex in rank])
    greedy = _greedy(neighbours)
    if len(greedy) > len(search.best):
        search.best = greedy
    search.run()
    chosen = [int(order[position]) for position in search.best]
    return sorted(chosen + [int(vertex) for vertex in np.flatnonzero(agrees_with_all)])


def _bitsets(adjacency: Bool[np.ndarray, "N N"]) -> list[int]:
    """Return each row as one integer, bit k for column k, without the diagonal."""
    rows = adjacency & ~np.eye(len(adjacency), dtype=bool)
    packed = np.packbits(rows, axis=1, bitorder="little")
    return [int.from_bytes(row.tobytes(), "little") for row in packed]


def _bits(mask: int) -> list[int]:
    """Return the set bits, ascending."""
    positions = []
    while mask:
        lowest = mask & -mask
        positions.append(lowest.bit_length() - 1)
        mask ^= lowest
    return positions


def _greedy(neighbours: list[int]) -> list[int]:
    """Return a clique: always add the vertex that leaves most to choose from (ties: the first)."""
    clique: list[int] = []
    candidates = (1 << len(neighbours)) - 1
    while candidates:
        scores = [((neighbours[v] & candidates).bit_count(), -v) for v in _bits(candidates)]
        chosen = -max(scores)[1]
        clique.append(chosen)
        candidates &= neighbours[chosen]
    return clique


class _Search:
    """Branch and bound on bitsets; ``best`` only ever grows."""

    def __init__(self, neighbours: list[int], incumbent: list[int]) -> None:
        self.neighbours = neighbours
        self.best = incumbent
        self.work = 0

    def run(self) -> None:
        """Search every clique that could still be larger than the best."""
        stack: list[tuple[list[int], int]] = [([], (1 << len(self.neighbours)) - 1)]
        while stack and self.work < MAX_WORK:
            clique, candidates = stack.pop()
            if not candidates:
                if len(clique) > len(self.best):
                    self.best = clique
                continue
            stack.extend(self._branches(clique, candidates))

    def _branches(self, clique: list[int], candidates: int) -> list[tuple[list[int], int]]:
        branches = []
        remaining = candidates
        for vertex, colour in reversed(self._colour(candidates)):
            if len(clique) + colour <= len(self.best):
                break
            remaining &= ~(1 << vertex)
            branches.append(([*clique, vertex], self.neighbours[vertex] & remaining))
        return branches[::-1]

    def _colour(self, candidates: int) -> list[tuple[int, int]]:
        """Colour the candidates; no clique among the first k of them exceeds k's colour."""
        coloured = []
        colour = 0
        while candidates:
            colour += 1
            free = candidates
            while free:
                vertex = (free & -free).bit_length() - 1
                coloured.append((vertex, colour))
                candidates &= ~(1 << vertex)
                free &= ~(1 << vertex) & ~self.neighbours[vertex]
        self.work += len(coloured)
        return coloured
