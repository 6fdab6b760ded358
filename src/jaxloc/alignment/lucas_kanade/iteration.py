"""The iterations at one scale."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc import _tree as tree
from jaxloc.alignment.lucas_kanade.normal_equations import Equations, Matching, Prepared, equations
from jaxloc.alignment.lucas_kanade.pyramid_level import Level
from jaxloc.alignment.lucas_kanade.steps import Descent
from jaxloc.images.warps import Warp


class Descended(eqx.Module):
    """Where the iterations ended.

    Attributes:
        warp: in normalized coordinates.
        brightness: coefficients of its columns.
        moved: the last step, px of the full size.
        num_steps: steps taken.
    """

    warp: Warp
    brightness: Float[Array, " k"]
    moved: Float[Array, ""]
    num_steps: Int[Array, ""]


class _Search(eqx.Module):
    trial: Warp
    best: Warp
    known: Equations
    damping: Float[Array, ""]
    moved: Float[Array, ""]
    count: Int[Array, ""]


def descend(
    level: Level, start: Warp, brightness: Float[Array, " k"], matching: Matching, descent: Descent, *, limits: "Limits"
) -> Descended:
    """Steps until they are shorter than the tolerance.

    A step that would fold the template or that is not finite is not taken, which ends the search there.
    """
    dtype = level.template.dtype
    prepared = Prepared.of(level, start, matching)

    def compare(warp: Warp, brightness: Float[Array, " k"]) -> Equations:
        return equations(level, prepared, warp, brightness, matching, second=descent.newton)

    nothing = jax.tree.map(
        lambda leaf: jnp.full(leaf.shape, jnp.inf if leaf.ndim == 0 else 0.0, leaf.dtype),
        jax.eval_shape(lambda: compare(start, brightness)),
    )
    nothing = eqx.tree_at(lambda known: known.brightness, nothing, brightness)
    initial = _Search(
        start, start, nothing, jnp.ones((), dtype), jnp.full((), jnp.inf, dtype), jnp.zeros((), jnp.int32)
    )

    def unfinished(search: _Search) -> Bool[Array, ""]:
        return (search.count < limits.max_steps) & (search.moved > limits.tolerance)

    def advance(search: _Search) -> _Search:
        now = compare(search.trial, search.known.brightness)
        accepted = descent.accepts(now, search.known) & jnp.isfinite(now.mean_cost)
        best, known = _choose(accepted, (search.trial, now), (search.best, search.known))
        damping = descent.damp(search.damping, accepted)
        step = -descent.solve(known, damping)
        if matching.formulation.inverse:
            # A step divided by a gain near zero would be thrown far away.
            step = step / jnp.maximum(known.gain, 0.25)
        trial = matching.formulation.update(best, jnp.where(jnp.isfinite(step), step, 0.0))
        moved = travelled(level, best, trial)
        possible = jnp.isfinite(moved)
        trial = _choose(possible, trial, best)
        return _Search(trial, best, known, damping, jnp.where(possible, moved, 0.0), search.count + 1)

    end = lax.while_loop(unfinished, advance, initial)
    if not descent.guarded:
        return Descended(end.trial, end.known.brightness, end.moved, end.count)
    # The last step has not been judged yet.
    now = compare(end.trial, end.known.brightness)
    warp, known = _choose(descent.accepts(now, end.known), (end.trial, now), (end.best, end.known))
    return Descended(warp, known.brightness, end.moved, end.count)


class Limits(eqx.Module):
    """When to stop at one scale.

    Attributes:
        max_steps: bound on the number of steps.
        tolerance: length of a step that counts as none, px of the full size.
    """

    max_steps: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)


def travelled(level: Level, before: Warp, after: Warp) -> Float[Array, ""]:
    """Greatest way of a corner of the template between two warps, px of the full size; infinite if one is lost."""
    u = jnp.stack([level.u[0], level.u[-1], level.u[0], level.u[-1]])
    v = jnp.stack([level.v[0], level.v[0], level.v[-1], level.v[-1]])
    old, new = before.map_components(u, v), after.map_components(u, v)
    far = jnp.max(jnp.hypot(new[0] - old[0], new[1] - old[1])) * level.frame.radius
    return jnp.where(far < 1e5, far, jnp.inf)


def _choose(accept: Bool[Array, ""], new: Any, old: Any) -> Any:
    return tree.where(accept, new, old)
