"""Templates of the road's cross profile: fixed, blended slowly, or captured from far rows."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc.lanes.ground_view import GroundView, halve_columns
from jaxloc.lanes.ralph.profile import LaneFit, straighten
from jaxloc.poses.lie_group import as_floats


class Template(eqx.Module):
    """Normalized gray levels across a lane, by lateral position.

    Attributes:
        values: zero mean and unit variance where known, zero elsewhere.
        known: where the road was seen.
        left: lateral positions in the lane, m to the left of its center, evenly decreasing.
    """

    values: Float[Array, " columns"]
    known: Bool[Array, " columns"]
    left: Float[Array, " columns"]

    def coarser(self) -> "Template":
        """Half as many positions, smoothed as `GroundView.coarser` smooths a view."""
        values, known = halve_columns(self.values, self.known)
        left = self.left[: 2 * (self.left.size // 2)].reshape(-1, 2)
        return Template(values, known, jnp.mean(left, axis=1))


@filter_jit
def capture(
    view: GroundView, fit: LaneFit, *, near: Any = 0.0, far: Any = 1e6, left: Float[Array, " columns"] | None = None
) -> Template:
    """Captures a template from a view with known lane: on demand [K-42], or from far rows [K-44].

    Args:
        view: the road from above.
        fit: its lane and pitch.
        near: range of the first row that counts, m.
        far: range of the last one, m.
        left: lateral positions of the template; those of the view by default.

    References:
        D. Pomerleau, "RALPH: rapidly adapting lateral position handler", Intelligent Vehicles 1995 [K-39], [K-42].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> ralph, grid = jl.lanes.ralph, jl.lanes.ground_view.GroundGrid.between(5.0, 50.0, 8.0)
        >>> y = jnp.broadcast_to(grid.left, (64, 128))
        >>> view = jl.lanes.ground_view.GroundView(jnp.exp(-4.0 * y**2), y < 9.0, grid, jnp.array(1.3))
        >>> template = ralph.capture(view, ralph.LaneFit(offset=0.5))
        >>> round(float(template.left[jnp.argmax(template.values)]), 1)  # what is straight ahead is left of the center
        0.5
    """
    positions = view.grid.left if left is None else left
    ahead, _ = view.true_range(fit.pitch)
    rows = ((ahead >= near) & (ahead <= far)).astype(view.image.dtype)
    profile = straighten(view, fit, positions).profile(rows)
    return _standard(Template(profile.values, profile.known, positions))


def _standard(template: Template) -> Template:
    """The same with zero mean and unit variance: the gain of a mean of rows only reflects how well they agree."""
    share = template.known.astype(template.values.dtype)
    count = jnp.maximum(jnp.sum(share), 1.0)
    centered = jnp.where(template.known, template.values - jnp.sum(share * template.values) / count, 0.0)
    variance = jnp.sum(centered**2) / count
    gain = jax.lax.rsqrt(jnp.where(variance > 1e-8, variance, 1.0))
    return Template(centered * gain, template.known, template.left)


@filter_jit
def blend(template: Template, fresh: Template, rate: Float[Array, ""]) -> Template:
    """Exponential blend of a template with the current profile, ``(1 - rate) T + rate F`` [K-43].

    Args:
        template: so far.
        fresh: captured now, at the same positions.
        rate: share of the fresh one, 0 to 1.
    """
    both = template.known & fresh.known
    mixed = (1.0 - rate) * template.values + rate * fresh.values
    values = jnp.where(both, mixed, jnp.where(fresh.known, fresh.values, template.values))
    return _standard(Template(values, template.known | fresh.known, template.left))


class Adaptation(eqx.Module):
    """Template adaptation (strategy)."""

    @abstractmethod
    def adapt(self, template: Template, view: GroundView, fit: LaneFit, ok: Bool[Array, ""]) -> Template:
        """The template for the next image.

        Args:
            template: that of this image.
            view: the road from above.
            fit: lane in it: the one that was found, or for a while the predicted one where none was, as on a road
                whose appearance changes abruptly.
            ok: whether to thresholds that; a template stays as it is otherwise.
        """


class Fixed(Adaptation):
    """No adaptation: keeps the captured template [K-42]."""

    def adapt(self, template: Template, view: GroundView, fit: LaneFit, ok: Bool[Array, ""]) -> Template:
        """The same template."""
        return template


class Blended(Adaptation):
    """Exponential blending with the current profile [K-43].

    Args:
        rate: share by image, 0 to 1.
    """

    rate: Float[Array, ""]

    def __init__(self, rate: Any = 0.05):
        (self.rate,) = as_floats(rate)

    def adapt(self, template: Template, view: GroundView, fit: LaneFit, ok: Bool[Array, ""]) -> Template:
        """The template with a share of the image."""
        fresh = capture(view, fit, left=template.left)
        return _keep_unless(ok, blend(template, fresh, self.rate.astype(template.values.dtype)), template)


class Predictive(Adaptation):
    """Captures the template from far rows, which the vehicle reaches later if the curvature persists [K-44].

    Args:
        near: range from which on rows count, m.
        rate: share by image, 0 to 1: 1 forgets all that went before.
    """

    near: Float[Array, ""]
    rate: Float[Array, ""]

    def __init__(self, near: Any = 12.0, rate: Any = 0.1):
        self.near, self.rate = as_floats(near, rate)

    def adapt(self, template: Template, view: GroundView, fit: LaneFit, ok: Bool[Array, ""]) -> Template:
        """The template with a share of the far rows."""
        fresh = capture(view, fit, near=self.near.astype(template.values.dtype), left=template.left)
        return _keep_unless(ok, blend(template, fresh, self.rate.astype(template.values.dtype)), template)


def _keep_unless(ok: Bool[Array, ""], new: Template, old: Template) -> Template:
    return tree.where(ok, new, old)
