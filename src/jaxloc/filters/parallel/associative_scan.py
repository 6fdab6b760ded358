"""Associative scan over blocks of linear-Gaussian steps, for filters and smoothers parallel in time.

A block of steps is summarized as a `Block`: its last state as a function of the state before it, and a likelihood of
that state. Blocks combine associatively, so that their initial states follow in a logarithmic number of steps; the
steps inside the blocks run in parallel. All covariances are in square-root form.

References:
    Särkkä and García-Fernández, "Temporal parallelization of Bayesian smoothers", IEEE TAC 2021; Yaghoobi, Corenflos,
    Hassan and Särkkä, "Parallel square-root statistical linear regression for inference in nonlinear state space
    models", 2022.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc import _tree as tree
from jaxloc.beliefs.square_root import product, triangularize, whiten
from jaxloc.filters.kalman import Innovation, JointCovariance, innovation_info, without_zero_pivots


class Linearized(eqx.Module):
    """A step in the tangents of a nominal path: ``x' = gain x + offset + noise w``, ``r = matrix x' + sensed v``."""

    gain: Float[Array, "*t d d"]
    offset: Float[Array, "*t d"]
    noise: Float[Array, "*t d d"]
    matrix: Float[Array, "*t m d"]
    residual: Float[Array, "*t m"]
    sensed: Float[Array, "*t m m"]
    mask: Bool[Array, "*t m"]


class Block(eqx.Module):
    """Consecutive steps: ``x_j = gain x_i + offset + root w``, with log likelihood ``s x_i - |Z^T x_i|^2 / 2``.

    Attributes:
        gain, offset, root: of the last state, given the state before the first step.
        score: s.
        information_root: Z.
    """

    gain: Float[Array, "*t d d"]
    offset: Float[Array, "*t d"]
    root: Float[Array, "*t d d"]
    score: Float[Array, "*t d"]
    information_root: Float[Array, "*t d d"]


class Line(eqx.Module):
    """Backward conditional of consecutive steps: ``x_i = gain x_j + offset + root w``."""

    gain: Float[Array, "*t d d"]
    offset: Float[Array, "*t d"]
    root: Float[Array, "*t d d"]


def filter_blocks(steps: Linearized, prior: tuple[Array, Array], num_blocks: int) -> tuple[tuple[Array, Array], Any]:
    """Filtered tangents and roots, and infos, of linearized steps."""
    count = steps.offset.shape[0]
    blocks = _cut(steps, num_blocks, _idle(steps))
    summaries = jax.vmap(_summarize)(blocks)
    joined = scan_associative(_join, _after_prior(summaries, prior))
    starts = (
        jnp.concatenate([prior[0][None], joined.offset[:-1]]),
        jnp.concatenate([prior[1][None], joined.root[:-1]]),
    )
    _, (filtered, infos) = jax.vmap(lambda start, block: lax.scan(_advance, start, block))(starts, blocks)
    return _uncut((filtered, infos), count)


def smooth_blocks(lines: Line, end: tuple[Array, Array], num_blocks: int) -> tuple[Array, Array]:
    """Smoothed tangents and roots along a chain of backward conditionals, from the last one."""
    count = lines.offset.shape[0]
    if count == 0:
        return jax.tree.map(lambda leaf: leaf[None], end)
    size = end[0].shape[0]
    eye, zero = jnp.eye(size, dtype=end[1].dtype), jnp.zeros(size, end[1].dtype)
    still = Line(eye, zero, jnp.zeros_like(eye))
    blocks = _cut(lines, min(num_blocks, count), still)

    def compose(later, line):
        return _chain(later, line), None

    whole = jax.vmap(lambda block: lax.scan(compose, still, block, reverse=True)[0])(blocks)
    joined = scan_associative(_chain, whole, reverse=True)
    # The last state of each block: the end, transported back through the blocks after it.
    carried = jax.vmap(lambda line: _apply(line, end))(jax.tree.map(lambda leaf: leaf[1:], joined))
    starts = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), carried, end)

    def back(later, line):
        earlier = _apply(line, later)
        return earlier, earlier

    _, found = jax.vmap(lambda start, block: lax.scan(back, start, block, reverse=True))(starts, blocks)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), _uncut(found, count), end)


def _advance(before: tuple[Array, Array], step: Linearized) -> tuple[tuple[Array, Array], Any]:
    """One step of the ordinary filter."""
    delta, root = before
    delta, root = _moved(delta, root, step)
    joint = _joint(root, step)
    size = step.residual.shape[0]
    covariance = JointCovariance(None, joint[:size], joint[size:])
    info = innovation_info(joint, Innovation(covariance, step.residual - product(step.matrix, delta), step.mask))
    used = info.ok & (info.dof > 0)
    change = product(joint[size:, :size], whiten(without_zero_pivots(joint[:size, :size]), info.innovation))
    after = tree.where(used, (delta + change, joint[size:, size:]), (delta, root))
    return after, (after, info)


def _summarize(steps: Linearized) -> Block:
    """Summary of a block: the filter from a known initial state, and how its innovations depend on that state."""
    size = steps.offset.shape[-1]
    eye, zero = jnp.eye(size, dtype=steps.gain.dtype), jnp.zeros(size, steps.gain.dtype)

    def advance(before, step):
        gain, (delta, root) = before
        gain, (delta, root) = product(step.gain, gain), _moved(delta, root, step)
        joint, seen = _joint(root, step), step.residual.shape[0]
        measured = without_zero_pivots(joint[:seen, :seen])
        white = whiten(measured, step.residual - product(step.matrix, delta))
        rows = whiten(measured, product(step.matrix, gain))
        change = joint[seen:, :seen]
        after = (delta + product(change, white), joint[seen:, seen:])
        return (gain - product(change, rows), after), (rows, white)

    (gain, (delta, root)), (rows, residuals) = lax.scan(advance, (eye, (zero, jnp.zeros_like(eye))), steps)
    rows = rows.reshape(-1, size)
    return Block(gain, delta, root, product(rows.T, residuals.reshape(-1)), triangularize(rows.T))


def _join(first: Block, second: Block) -> Block:
    """Two consecutive blocks combined."""
    root, known = first.root, second.information_root
    size = root.shape[0]
    eye = jnp.eye(size, dtype=root.dtype)
    both = triangularize(jnp.block([[product(root.T, known), eye], [known, jnp.zeros_like(eye)]]))
    scale, across, left = both[:size, :size], both[size:, :size], both[size:, size:]
    # Root of the state between the blocks given the measurements of the second, and its remaining part.
    between = whiten(scale, root.T).T
    keep = eye - product(between, across.T)
    score = product(keep.T, second.score - product(known, product(known.T, first.offset)))
    middle = product(keep, first.offset + product(root, product(root.T, second.score)))
    carried = product(second.gain, between)
    return Block(
        product(second.gain, product(keep, first.gain)),
        product(second.gain, middle) + second.offset,
        triangularize(jnp.concatenate([carried, second.root], axis=1)),
        product(first.gain.T, score) + first.score,
        triangularize(jnp.concatenate([product(first.gain.T, left), first.information_root], axis=1)),
    )


def _after_prior(blocks: Block, prior: tuple[Array, Array]) -> Block:
    """The blocks with the prior included in the first, whose last state then depends on nothing before it."""
    zero = jnp.zeros_like(prior[1])
    start = Block(zero, prior[0], prior[1], jnp.zeros_like(prior[0]), zero)
    first = _join(start, jax.tree.map(lambda leaf: leaf[0], blocks))
    return jax.tree.map(lambda a, b: b.at[0].set(a), first, blocks)


def _chain(later: Line, earlier: Line) -> Line:
    root = triangularize(jnp.concatenate([product(earlier.gain, later.root), earlier.root], axis=1))
    return Line(product(earlier.gain, later.gain), product(earlier.gain, later.offset) + earlier.offset, root)


def _apply(line: Line, later: tuple[Array, Array]) -> tuple[Array, Array]:
    root = triangularize(jnp.concatenate([product(line.gain, later[1]), line.root], axis=1))
    return product(line.gain, later[0]) + line.offset, root


def _moved(delta: Array, root: Array, step: Linearized) -> tuple[Array, Array]:
    deviations = jnp.concatenate([product(step.gain, root), step.noise], axis=1)
    return product(step.gain, delta) + step.offset, triangularize(deviations)


def _joint(root: Array, step: Linearized) -> Array:
    zero = jnp.zeros((root.shape[0], step.sensed.shape[0]), root.dtype)
    rows = ([step.sensed, product(step.matrix, root)], [zero, root])
    return triangularize(jnp.concatenate([jnp.concatenate(row, axis=1) for row in rows]))


def hold(line: Line, active: Bool[Array, ""]) -> Line:
    """The line where active, else the identity."""
    eye = jnp.eye(line.offset.shape[0], dtype=line.offset.dtype)
    return tree.where(active, line, Line(eye, jnp.zeros_like(line.offset), jnp.zeros_like(eye)))


def _idle(steps: Linearized) -> Linearized:
    """A step without motion and measurement."""
    size, seen = steps.offset.shape[-1], steps.residual.shape[-1]
    dtype = steps.gain.dtype
    eye, zero = jnp.eye(size, dtype=dtype), jnp.zeros(size, dtype)
    nothing = (jnp.zeros((seen, size), dtype), jnp.zeros(seen, dtype), jnp.eye(seen, dtype=dtype))
    return Linearized(eye, zero, jnp.zeros_like(eye), *nothing, jnp.zeros(seen, bool))


def _cut(steps: Any, num_blocks: int, filler: Any) -> Any:
    """Steps as blocks of equal length, the last one padded."""

    def cut(leaf, fill):
        length = -(-leaf.shape[0] // num_blocks)
        missing = num_blocks * length - leaf.shape[0]
        filled = jnp.concatenate([leaf, jnp.broadcast_to(fill[None], (missing, *fill.shape))])
        return filled.reshape(num_blocks, length, *leaf.shape[1:])

    return jax.tree.map(cut, steps, filler)


def _uncut(blocks: Any, count: int) -> Any:
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:count], blocks)


def scan_associative(combine: Callable[[Any, Any], Any], items: Any, *, reverse: bool = False) -> Any:
    """Running combinations of stacked items by an associative operation, in a logarithmic number of steps.

    Unlike `jax.lax.associative_scan` it combines all items in each step (Hillis and Steele), so that one copy of the
    operation is compiled instead of one for each level.

    Args:
        combine: of two items, the one that comes first in the running order first.
        items: stacked along a leading axis.
        reverse: run from the last item to the first.

    References:
        Hillis and Steele, "Data parallel algorithms", 1986.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.filters.parallel.associative_scan.scan_associative(jnp.add, jnp.arange(5)).tolist()
        [0, 1, 3, 6, 10]
    """
    count = jax.tree.leaves(items)[0].shape[0]
    index = jnp.arange(count)[::-1] if reverse else jnp.arange(count)

    def double(level, running):
        distance = 2**level
        shift = -distance if reverse else distance
        before = jax.tree.map(lambda leaf: jnp.roll(leaf, shift, axis=0), running)
        return jax.vmap(tree.where)(index >= distance, jax.vmap(combine)(before, running), running)

    return lax.fori_loop(0, max(count - 1, 0).bit_length(), double, items)
