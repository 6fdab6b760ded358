"""Exhaustive search over curvature, heading and pitch hypotheses for the straightest road."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxloc._jit import filter_jit
from jaxloc.lanes.ground_view import GroundView
from jaxloc.lanes.ralph.profile import AbsoluteSteps, LaneFit, Profile, Sharpness, straighten

_LEVEL = 2  # how often the view is halved first: the answer is refined


class Hypotheses(eqx.Module):
    """Search grid: all combinations of curvatures, headings and pitches.

    Args:
        curvatures: 1/m.
        headings: rad.
        pitches: corrections of the camera's pitch, rad.
        offset: about which the profile is looked for in a template, m.
        reach: how far to either side of that, m.
    """

    curvatures: Float[Array, " c"]
    headings: Float[Array, " h"]
    pitches: Float[Array, " p"]
    offset: Float[Array, ""]
    reach: Float[Array, ""]

    @staticmethod
    def around(
        fit: LaneFit | None = None,
        *,
        curvature: Any = 4e-3,
        heading: Any = 0.06,
        pitch: Any = 0.012,
        offset: Any = 1.5,
        counts: tuple[int, int, int] = (41, 25, 5),
    ) -> "Hypotheses":
        """Evenly spaced hypotheses around a prediction; the defaults suit a search without one on a fast road.

        Args:
            fit: prediction; straight on by default.
            curvature: reach to either side, 1/m.
            heading: reach, rad.
            pitch: reach, rad.
            offset: reach, m.
            counts: of curvatures, headings and pitches; odd numbers try the prediction itself; static.
        """
        fit = LaneFit() if fit is None else fit
        dtype = fit.curvature.dtype
        unit = [jnp.linspace(-1.0, 1.0, n, dtype=dtype) if n > 1 else jnp.zeros(1, dtype) for n in counts]
        return Hypotheses(
            fit.curvature + curvature * unit[0],
            fit.heading + heading * unit[1],
            fit.pitch + pitch * unit[2],
            fit.offset,
            jnp.asarray(offset, dtype),
        )


class Straightest(eqx.Module):
    """Result of the search.

    Attributes:
        fit: best hypothesis, with offset zero.
        score: its sharpness.
        scores: of all hypotheses, pitches by headings by curvatures.
    """

    fit: LaneFit
    score: Float[Array, ""]
    scores: Float[Array, "p h c"]


@filter_jit
def find_straightest(
    view: GroundView, hypotheses: Hypotheses, *, sharpness: Sharpness = AbsoluteSteps()
) -> Straightest:
    """Evaluates all hypotheses and keeps the one with the sharpest summed profile [K-33], [K-36].

    Each pitch makes one view with its own ranges. In it a hypothesis is a slice of every row at its own place, so that
    a thousand of them cost some milliseconds.

    Args:
        view: the road from above.
        hypotheses: what to try.
        sharpness: measure of a profile.

    References:
        D. Pomerleau, "RALPH: rapidly adapting lateral position handler", Intelligent Vehicles 1995.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> ralph, grid = jl.lanes.ralph, jl.lanes.ground_view.GroundGrid.between(5.0, 50.0, 8.0)
        >>> y = grid.left[None, :] - 0.5 * 0.002 * grid.ahead[:, None] ** 2
        >>> bent = jl.lanes.ground_view.GroundView(100.0 * jnp.exp(-4.0 * y**2), y < 9.0, grid, jnp.array(1.3))
        >>> found = ralph.find_straightest(bent, ralph.Hypotheses.around(pitch=0.0, counts=(41, 25, 1)))
        >>> bool(abs(found.fit.curvature - 0.002) < 0.0005), bool(abs(found.fit.heading) < 0.015)
        (True, True)
    """
    small = view
    for _ in range(_LEVEL):
        small = small.coarser()
    # In turn: the slices of all hypotheses at once would not fit the cache, of a batch of roads not the memory.
    scores = lax.map(lambda pitch: _scores_at(small, hypotheses, pitch, sharpness), hypotheses.pitches)
    best = jnp.argmax(scores)
    p, h, c = jnp.unravel_index(best, scores.shape)
    fit = LaneFit(
        jnp.zeros_like(hypotheses.headings[0]), hypotheses.headings[h], hypotheses.curvatures[c], hypotheses.pitches[p]
    )
    return Straightest(fit, scores.ravel()[best], scores)


def _scores_at(view: GroundView, hypotheses: Hypotheses, pitch: Array, sharpness: Sharpness) -> Float[Array, "h c"]:
    """Scores of all lanes under one pitch."""
    zero = jnp.zeros_like(pitch)
    level = straighten(view, LaneFit(zero, zero, zero, pitch), view.grid.left).values
    ahead, _ = view.true_range(pitch)
    spacing = view.grid.spacing

    def score(heading: Array, curvature: Array) -> Array:
        center = LaneFit(zero, heading, curvature, pitch).lane().center(ahead)
        return sharpness.score(_sum_slices(level, -center / spacing))

    by_curvature = jax.vmap(score, in_axes=(None, 0))
    return lax.map(lambda heading: by_curvature(heading, hypotheses.curvatures), hypotheses.headings)


def _sum_slices(level: Float[Array, "rows columns"], shift: Float[Array, " rows"]) -> Profile:
    """Mean of the rows, each read from its own shift on: one slice and one fraction per row; zero beyond the view."""
    rows, columns = level.shape
    padded = jnp.pad(level, ((0, 0), (columns, columns + 1)))
    # Samples beyond the width of a row are masked.
    place = jnp.clip(jnp.where(jnp.isfinite(shift), shift, 0.0), -columns, columns)
    first = jnp.floor(place)
    fraction = (place - first)[:, None]
    start = first.astype(jnp.int32) + columns
    pieces = jax.vmap(lambda row, at: lax.dynamic_slice(row, (at,), (columns + 1,)))(padded, start)
    values = jnp.sum((1.0 - fraction) * pieces[:, :-1] + fraction * pieces[:, 1:], axis=0) / rows
    return Profile(values, jnp.ones(columns, bool))
