"""Lateral offset by correlation of a profile with templates, with a measure of ambiguity."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit
from jaxloc.lanes.ralph.profile import Profile
from jaxloc.lanes.ralph.template import Template

_LEAST_OVERLAP = 0.5  # share of the template that must meet known parts of the profile


class Match(eqx.Module):
    """Best match of a profile among several templates.

    Attributes:
        offset: how far the vehicle is left of the lane's center, m.
        correlation: zero-mean normalized correlation there, -1 to 1.
        sidelobe: the greatest correlation of another peak, or of another place of another template.
        which: index of the best template.
        correlations: by template and offset.
        offsets: the offsets that were tried, m.
    """

    offset: Float[Array, ""]
    correlation: Float[Array, ""]
    sidelobe: Float[Array, ""]
    which: Int[Array, ""]
    correlations: Float[Array, "b s"]
    offsets: Float[Array, " s"]

    def confidence(self) -> Float[Array, ""]:
        """Peak height relative to the second peak, 0 to 1: ``max(c, 0) (1 - max(s, 0) / c)``."""
        peak = jnp.maximum(self.correlation, 0.0)
        return peak - jnp.clip(self.sidelobe, 0.0, peak)


@filter_jit
def match_profile(profile: Profile, bank: Template, *, reach: Any = 1.5, around: Any = 0.0) -> Match:
    """Slides a profile along templates [K-39], [K-41].

    Args:
        profile: of a view straightened at offset zero, at the positions of the templates.
        bank: templates "b columns", all at the same positions "b columns": ``jax.tree.map`` of ``jnp.stack``.
        reach: greatest offset to either side, m.
        around: offset about which the peak is looked for, m.

    Returns:
        The best match: the offset lies on the grid of columns, refined by a parabola through the peak.

    References:
        D. Pomerleau, "RALPH: rapidly adapting lateral position handler", Intelligent Vehicles 1995 [K-39], [K-40].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> ralph, left = jl.lanes.ralph, jnp.linspace(4.0, -4.0, 161)
        >>> bumps = jnp.exp(-8.0 * (left - 1.7) ** 2) + 0.5 * jnp.exp(-8.0 * (left + 1.9) ** 2)
        >>> known = jnp.ones(161, bool)
        >>> bank = jax.tree.map(lambda leaf: leaf[None], ralph.Template(bumps, known, left))
        >>> moved = ralph.Profile(jnp.roll(bumps, 6), known)  # 0.3 m to the right
        >>> round(float(ralph.match_profile(moved, bank).offset), 2)
        0.3
    """
    spacing = (bank.left[0, 0] - bank.left[0, -1]) / (bank.left.shape[1] - 1)
    # The number of places depends on the spacing, which is not known while tracing: as many as half a template.
    span = bank.left.shape[1] // 2
    shifts = jnp.arange(-span, span + 1)
    correlations = jax.vmap(lambda template: _slide(profile, template, span))(bank)
    offsets = shifts.astype(spacing.dtype) * spacing
    allowed = jnp.abs(offsets - around) <= reach
    correlations = jnp.where(allowed[None, :], correlations, -1.0)
    best = jnp.argmax(correlations)
    which, place = jnp.unravel_index(best, correlations.shape)
    offset = offsets[place] + spacing * _vertex(correlations[which], place)
    apart = jnp.abs(offsets - offsets[place]) > _main_lobe(correlations[which], place, offsets)
    rival = jnp.max(jnp.where(apart[None, :], correlations, -1.0))
    return Match(offset, correlations[which, place], rival, which, correlations, offsets)


def _slide(profile: Profile, template: Template, span: int) -> Float[Array, " s"]:
    """Correlation at each shift of the template: the profile shows at column j what the template has at j - shift."""
    columns = profile.values.shape[0]
    values, known = jnp.pad(template.values, span), jnp.pad(template.known, span)

    def at(start: Array) -> Array:
        piece, seen = (lax.dynamic_slice(leaf, (start,), (columns,)) for leaf in (values, known))
        return _correlation(profile.values, piece, (seen & profile.known).astype(values.dtype))

    return jax.vmap(at)(jnp.arange(2 * span, -1, -1))


def _correlation(a: Float[Array, " c"], b: Float[Array, " c"], share: Float[Array, " c"]) -> Float[Array, ""]:
    count = jnp.maximum(jnp.sum(share), 1.0)
    a = share * (a - jnp.sum(share * a) / count)
    b = share * (b - jnp.sum(share * b) / count)
    energy = jnp.sum(a * a) * jnp.sum(b * b)
    enough = (count >= _LEAST_OVERLAP * a.shape[0]) & (energy > 1e-8)
    return jnp.where(enough, jnp.sum(a * b) * lax.rsqrt(jnp.where(enough, energy, 1.0)), 0.0)


def _vertex(row: Float[Array, " s"], place: Int[Array, ""]) -> Float[Array, ""]:
    """Of the parabola through a peak and its neighbors, in steps: at most half of one."""
    inner = jnp.clip(place, 1, row.shape[0] - 2)
    before, peak, after = row[inner - 1], row[inner], row[inner + 1]
    bend = before - 2.0 * peak + after
    peaked = (bend < -1e-6) & (place == inner)
    return jnp.where(peaked, jnp.clip(0.5 * (before - after) / jnp.where(peaked, bend, 1.0), -0.5, 0.5), 0.0)


def _main_lobe(row: Float[Array, " s"], place: Int[Array, ""], offsets: Float[Array, " s"]) -> Float[Array, ""]:
    """Half width of the peak: where the correlation first falls below half of it, to the side where that is farther."""
    low = row < 0.5 * row[place]
    distance = jnp.abs(offsets - offsets[place])
    beyond = jnp.max(distance) + 1.0

    def first(side: Bool[Array, " s"]) -> Array:
        return jnp.min(jnp.where(low & side, distance, beyond))

    left, right = first(offsets > offsets[place]), first(offsets < offsets[place])
    return jnp.where(jnp.maximum(left, right) < beyond, jnp.maximum(left, right), jnp.minimum(left, right))
