"""Iterations of Lucas-Kanade at one scale."""

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


class SearchResult(eqx.Module):
    """Result of the iterations.

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
    level: Level,
    initial: Warp,
    brightness: Float[Array, " k"],
    matching: Matching,
    descent: Descent,
    *,
    limits: "Limits",
) -> SearchResult:
    """Iterates until steps are shorter than the tolerance.

    The search ends at a step that would fold the template or is not finite, without taking it.
    """
    dtype = level.template.dtype
    prepared = Prepared.of(level, initial, matching)

    def compare(warp: Warp, brightness: Float[Array, " k"]) -> Equations:
        return equations(level, prepared, warp, brightness, matching, second=descent.newton)

    nothing = jax.tree.map(
        lambda leaf: jnp.full(leaf.shape, jnp.inf if leaf.ndim == 0 else 0.0, leaf.dtype),
        jax.eval_shape(lambda: compare(initial, brightness)),
    )
    nothing = eqx.tree_at(lambda known: known.brightness, nothing, brightness)
    first = _Search(
        initial, initial, nothing, jnp.ones((), dtype), jnp.full((), jnp.inf, dtype), jnp.zeros((), jnp.int32)
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
            # A gain near zero would give a huge step.
            step = step / jnp.maximum(known.gain, 0.25)
        trial = matching.formulation.update(best, jnp.where(jnp.isfinite(step), step, 0.0))
        moved = displacement(level, best, trial)
        possible = jnp.isfinite(moved)
        trial = _choose(possible, trial, best)
        return _Search(trial, best, known, damping, jnp.where(possible, moved, 0.0), search.count + 1)

    end = lax.while_loop(unfinished, advance, first)
    if not descent.guarded:
        return SearchResult(end.trial, end.known.brightness, end.moved, end.count)
    # The last step has not been accepted or rejected yet.
    now = compare(end.trial, end.known.brightness)
    warp, known = _choose(descent.accepts(now, end.known), (end.trial, now), (end.best, end.known))
    return SearchResult(warp, known.brightness, end.moved, end.count)


class Limits(eqx.Module):
    """Stopping criteria at one scale.

    Attributes:
        max_steps: bound on the number of steps.
        tolerance: step length at convergence, px of the full size.
    """

    max_steps: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)


def displacement(level: Level, before: Warp, after: Warp) -> Float[Array, ""]:
    """Greatest displacement of a template corner between two warps, px of the full size; infinite if not finite."""
    u = jnp.stack([level.u[0], level.u[-1], level.u[0], level.u[-1]])
    v = jnp.stack([level.v[0], level.v[0], level.v[-1], level.v[-1]])
    old, new = before.map_components(u, v), after.map_components(u, v)
    far = jnp.max(jnp.hypot(new[0] - old[0], new[1] - old[1])) * level.frame.radius
    return jnp.where(far < 1e5, far, jnp.inf)


def _choose(accept: Bool[Array, ""], new: Any, old: Any) -> Any:
    return tree.where(accept, new, old)
