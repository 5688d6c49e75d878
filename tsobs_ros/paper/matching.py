# Copyright 2026 The tsobs_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""When the published gradient law can adapt at all: its matching condition.

The law Θ̂' = Γ e_y x̂ᵀ cancels the uncertainty in V = eᵀPe + tr(Θ̃ᵀΓ⁻¹Θ̃) only if P G = C̄ᵀF for some
P ≻ 0 and F, where ΔA x = G Θ x enters the error through G. Then FᵀC̄G = GᵀP G, whose rank is that
of G; so C̄G has the rank of G: every direction that is uncertain reaches the output's first
derivative (relative degree one). Where that fails no P exists, whatever the gain.
"""

from typing import NamedTuple

import numpy as np

from tsobs_ros.checks import Array
from tsobs_ros.errors import ModelError


class MatchingVerdict(NamedTuple):
    """Whether the matching condition can hold.

    Attributes:
        rank_directions: Rank of G.
        rank_seen: Rank of C G.
        relative_degree: Smallest k with C A^{k−1} G of the rank of G; None if no k ≤ n has it.
    """

    rank_directions: int
    rank_seen: int
    relative_degree: int | None

    @property
    def possible(self) -> bool:
        """Whether C G has the rank of G, without which no P matches."""
        return self.rank_seen == self.rank_directions

    def __str__(self) -> str:
        degree = self.relative_degree
        shown = "above the number of states" if degree is None else str(degree)
        verdict = "can hold" if self.possible else "cannot hold"
        return (
            f"the matching condition PG = CᵀF {verdict}: rank(CG) = {self.rank_seen}, "
            f"rank(G) = {self.rank_directions}, relative degree {shown}"
        )


def matching(A: Array, C: Array, G: Array) -> MatchingVerdict:
    """Judge the gradient law's matching condition.

    Args:
        A: State matrix, shape (n, n).
        C: Output matrix, shape (p, n).
        G: Directions in which the uncertainty enters the state's derivative, shape (n, g).

    Raises:
        ModelError: The shapes do not fit.
    """
    n = A.shape[0]
    if A.shape != (n, n) or C.ndim != 2 or C.shape[1] != n or G.ndim != 2 or G.shape[0] != n:
        raise ModelError(
            f"A, C, G: expected shapes (n, n), (p, n), (n, g), got {A.shape}, {C.shape}, {G.shape}"
        )
    directions = int(np.linalg.matrix_rank(G))
    seen, reached = [], G
    for _ in range(n):
        seen.append(int(np.linalg.matrix_rank(C @ reached)))
        reached = A @ reached
    degree = next((k for k, rank in enumerate(seen, 1) if rank == directions), None)
    return MatchingVerdict(directions, seen[0], degree)
