"""Linear assignment: one-to-one assignment of rows to columns of least total cost, exact and of static shape.

Dual prices on the columns certify optimality. Rounds of the auction algorithm (all rows at once) assign most rows; each
of the rest by a shortest augmenting path. All paths run in one flat loop, so that the members of a batch do not wait
for one another at each row.

References:
    Jonker and Volgenant, "A shortest augmenting path algorithm for dense and sparse linear assignment problems", 1987.
    Crouse, "On implementing 2D rectangular assignment algorithms", IEEE T-AES 2016. [T-58]
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _tree as tree

_ROUNDS = 3  # of the auction: beyond these, augmenting paths are faster


class Assignment(eqx.Module):
    """An assignment of rows to columns.

    Attributes:
        columns: column of each row; -1 for unassigned rows.
        cost: sum over the pairs, plus the cost of unassigned rows.
    """

    columns: Int[Array, " n"]
    cost: Float[Array, ""]


class _Search(eqx.Module):
    """State of the loop: the matching, and the tree of shortest paths from the current row.

    Rows still to assign are `pending`. `handed` is the column to pass back along the path, -1 while the tree grows.
    """

    column_of: Int[Array, " n"]
    row_of: Int[Array, " m"]
    prices: Float[Array, " m"]
    pending: Bool[Array, " n"]
    row: Int[Array, ""]
    base: Float[Array, ""]
    lengths: Float[Array, " m"]
    parents: Int[Array, " m"]
    visited: Bool[Array, " m"]
    leaving: Int[Array, ""]
    leaving_length: Float[Array, ""]
    handed: Int[Array, ""]


@jax.jit  # called often and short: the overhead of Equinox's jit would be as long as the work
def assign(
    costs: Float[Array, "n m"], valid: Bool[Array, "n m"], *, unassigned: Float[Array, " n"] | None = None
) -> Assignment:
    """The best one-to-one assignment: of as many rows as possible, then of least total cost.

    The gradient of the cost is that of the pairs chosen.

    Args:
        costs: of each pair; pairs of cost NaN or infinity are forbidden.
        valid: mask of the allowed pairs.
        unassigned: cost of leaving a row unassigned (infinite: assign it if possible). With it, the total cost is
            minimized instead of the number of unassigned rows. Set it to zero for padding rows.

    Returns:
        The assignment. In float32 it is optimal up to rounding of the largest cost times the number of rows.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> costs = jnp.array([[1.0, 2.0], [1.5, 9.0], [0.0, 0.0]])
        >>> valid = jnp.array([[True, True], [True, True], [False, False]])
        >>> found = jl.solvers.assign(costs, valid)
        >>> found.columns.tolist(), float(found.cost)
        ([1, 0, -1], 3.5)
    """
    allowed = valid & jnp.isfinite(costs)
    safe = jnp.where(allowed, costs, 0.0)
    fixed = lax.stop_gradient(safe)
    columns = _columns(fixed, allowed, None if unassigned is None else lax.stop_gradient(unassigned))
    taken = columns >= 0
    picked = jnp.take_along_axis(safe, jnp.where(taken, columns, 0)[:, None], axis=1)[:, 0]
    left = jnp.zeros_like(picked) if unassigned is None else jnp.where(jnp.isfinite(unassigned), unassigned, 0.0)
    return Assignment(columns, jnp.sum(jnp.where(taken, picked, left)))


def _columns(costs: Array, allowed: Array, unassigned: Array | None) -> Int[Array, " n"]:
    """Columns of an assignment, solved with the shorter side as rows, which rarely stay unassigned."""
    n, m = costs.shape
    if n == 0 or m == 0:
        return jnp.full((n,), -1, jnp.int32)
    low = jnp.min(costs, initial=jnp.inf, where=allowed)
    low = jnp.where(jnp.isfinite(low), low, 0.0)
    costs = jnp.where(allowed, costs - low, 0.0)
    # More than any exchange of columns can save: no row stays unassigned to reduce the cost of others.
    reach = jnp.max(costs)
    penalty = (min(n, m) + 1.0) * jnp.where(reach > 0, reach, 1.0)
    if unassigned is None:
        stay = jnp.full((n,), penalty, costs.dtype)
    else:
        bounded = jnp.isfinite(unassigned)
        stay = jnp.where(bounded, jnp.where(bounded, unassigned, 0.0) - low, penalty)
    if n <= m:
        return _solve(jnp.where(allowed, costs, jnp.inf), stay).column_of
    if unassigned is not None:
        flipped, stay = costs - stay[:, None], jnp.zeros((m,), costs.dtype)
    else:
        flipped, stay = costs, jnp.full((m,), penalty, costs.dtype)
    return _solve(jnp.where(allowed, flipped, jnp.inf).T, stay).row_of


def _solve(costs: Float[Array, "n m"], stay: Float[Array, " n"]) -> _Search:
    """Least total cost, where a row may stay unassigned at a finite cost; forbidden pairs cost infinity."""
    n, m = costs.shape
    none, zero = jnp.array(-1, jnp.int32), jnp.zeros((), costs.dtype)
    empty = _Search(
        column_of=jnp.full((n,), -1, jnp.int32),
        row_of=jnp.full((m,), -1, jnp.int32),
        prices=jnp.zeros((m,), costs.dtype),
        pending=jnp.any(jnp.isfinite(costs), axis=1),
        row=none,
        base=zero,
        lengths=jnp.full((m,), jnp.inf, costs.dtype),
        parents=jnp.full((m,), -1, jnp.int32),
        visited=jnp.zeros((m,), bool),
        leaving=none,
        leaving_length=jnp.array(jnp.inf, costs.dtype),
        handed=none,
    )
    first = _next_row(lax.fori_loop(0, _ROUNDS, lambda _, s: _bid(costs, stay, s), empty))
    return lax.while_loop(lambda s: s.row >= 0, lambda s: _step(costs, stay, s), first)


def _bid(costs: Array, stay: Array, search: _Search) -> _Search:
    """Every pending row bids for its best column the difference to its second best."""
    n, m = costs.shape
    rows, columns = _range(n), _range(m)
    net = costs - search.prices[None]
    best = jnp.argmin(net, axis=1).astype(jnp.int32)
    first = jnp.min(net, axis=1)
    favorite = best[:, None] == columns[None]
    second = jnp.minimum(jnp.min(jnp.where(favorite, jnp.inf, net), axis=1), stay)
    alone = search.pending & (stay <= first)
    bidding = search.pending & ~alone
    raised = jnp.where(bidding, second - first, 0.0)
    offers = jnp.where(favorite & bidding[:, None], raised[:, None], -1.0)
    highest = jnp.max(offers, axis=0)
    sold = highest >= 0.0
    winner = jnp.argmax(offers, axis=0).astype(jnp.int32)
    row_of = jnp.where(sold, winner, search.row_of)
    has = row_of[None] == rows[:, None]
    holds = jnp.any(has, axis=1)
    return eqx.tree_at(
        lambda s: (s.column_of, s.row_of, s.prices, s.pending),
        search,
        (
            jnp.where(holds, jnp.argmax(has, axis=1).astype(jnp.int32), -1),
            row_of,
            jnp.where(sold, search.prices - highest, search.prices),
            ~holds & (search.pending & ~alone | (search.column_of >= 0)),
        ),
    )


def _step(costs: Array, stay: Array, search: _Search) -> _Search:
    """Grows the tree by a column, or passes a column one step back along the path."""
    return lax.cond(search.handed < 0, lambda s: _grow(costs, stay, s), _hand_back, search)


def _grow(costs: Array, stay: Array, search: _Search) -> _Search:
    """Visits the row that was reached last and the nearest column; ends at a free column."""
    row = search.row
    lengths = costs[row] - search.prices + search.base
    better = (lengths < search.lengths) & ~search.visited
    lengths = jnp.where(better, lengths, search.lengths)
    parents = jnp.where(better, row, search.parents)
    leaves = search.base + stay[row] < search.leaving_length
    leaving = jnp.where(leaves, row, search.leaving)
    leaving_length = jnp.where(leaves, search.base + stay[row], search.leaving_length)

    ahead = jnp.where(search.visited, jnp.inf, lengths)
    free = jnp.where(search.row_of < 0, ahead, jnp.inf)
    nearest, nearest_free = jnp.min(ahead), jnp.min(free)
    length = jnp.minimum(nearest_free, leaving_length)
    done = length <= nearest
    drop = leaving_length <= nearest_free
    column = jnp.where(done, jnp.argmin(free), jnp.argmin(ahead)).astype(jnp.int32)
    following = jnp.where(done, row, search.row_of[column])
    base = nearest - (costs[following, column] - search.prices[column])

    prices = jnp.where(search.visited & done, search.prices - (length - search.lengths), search.prices)
    # A row that becomes unassigned passes its own column back.
    handed = jnp.where(done, jnp.where(drop, search.column_of[leaving], column), -1)
    grown = _Search(
        column_of=jnp.where(done & drop & (_range(costs.shape[0]) == leaving), -1, search.column_of),
        row_of=search.row_of,
        prices=prices,
        pending=search.pending,
        row=following,
        base=jnp.where(done, search.base, base),
        lengths=lengths,
        parents=parents,
        visited=search.visited | (_range(costs.shape[1]) == column),
        leaving=leaving,
        leaving_length=leaving_length,
        handed=handed,
    )
    finished = done & (handed < 0)
    return tree.where(finished, _next_row(grown), grown)


def _hand_back(search: _Search) -> _Search:
    """The parent row of the column takes it and releases its own, up to the row that had none."""
    column = search.handed
    row = search.parents[column]
    before = search.column_of[row]
    handed = eqx.tree_at(
        lambda s: (s.column_of, s.row_of, s.handed),
        search,
        (
            jnp.where(_range(search.column_of.shape[0]) == row, column, search.column_of),
            jnp.where(_range(search.row_of.shape[0]) == column, row, search.row_of),
            before,
        ),
    )
    return tree.where(before < 0, _next_row(handed), handed)


def _next_row(search: _Search) -> _Search:
    """Starts the tree of the next pending row; row -1 when there is none."""
    row = jnp.where(jnp.any(search.pending), jnp.argmax(search.pending), -1).astype(jnp.int32)
    none = jnp.array(-1, jnp.int32)
    return eqx.tree_at(
        lambda s: (s.pending, s.row, s.base, s.lengths, s.visited, s.leaving, s.leaving_length, s.handed),
        search,
        (
            search.pending & (_range(search.pending.shape[0]) != row),
            row,
            jnp.zeros_like(search.base),
            jnp.full_like(search.lengths, jnp.inf),
            jnp.zeros_like(search.visited),
            none,
            jnp.full_like(search.leaving_length, jnp.inf),
            none,
        ),
    )


def _range(count: int) -> Int[Array, " count"]:
    return jnp.arange(count, dtype=jnp.int32)
