"""RALPH in one call: curvature search, offset match, and joint fit."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc._jit import filter_jit
from jaxloc.lanes.ground_view import GroundView
from jaxloc.lanes.lane import Lane
from jaxloc.lanes.ralph.match import Match, match_profile
from jaxloc.lanes.ralph.profile import AbsoluteSteps, LaneFit, Sharpness, straighten
from jaxloc.lanes.ralph.refine import refine
from jaxloc.lanes.ralph.search import Hypotheses, find_straightest
from jaxloc.lanes.ralph.template import Template
from jaxloc.solvers import Estimate
from jaxloc.solvers.robust_kernels import Loss


class LaneState(eqx.Module):
    """Estimate of the vehicle's position in its lane from one image.

    Attributes:
        estimate: a `LaneFit` with its covariance, in the order offset, heading, curvature, pitch.
        confidence: 0 to 1: how well the road matches its template, less how well it does elsewhere.
        ambiguous: another offset matches nearly as well; the direction of the road may be right all the same.
        template: index of the template that matched best.
        match: correlations by template and offset.
    """

    estimate: Estimate
    confidence: Float[Array, ""]
    ambiguous: Bool[Array, ""]
    template: Int[Array, ""]
    match: Match

    @property
    def lane(self) -> Lane:
        """The lane."""
        return self.estimate.value.lane()

    @property
    def offset(self) -> Array:
        """Distance of the vehicle to the left of the lane's center, m."""
        return self.estimate.value.offset

    @property
    def heading(self) -> Array:
        """Direction of the vehicle against that of the lane, counter-clockwise, rad."""
        return self.estimate.value.heading

    @property
    def curvature(self) -> Array:
        """Of the lane, positive to the left, 1/m."""
        return self.estimate.value.curvature

    @property
    def ok(self) -> Array:
        """Whether the estimate is valid."""
        return self.estimate.ok


class LaneThresholds(eqx.Module):
    """Thresholds for a lane estimate to be valid.

    Args:
        correlation: least correlation of profile and template.
        rival: greatest correlation of another place, as a share of the best.
        noise: largest standard deviation of the residuals of normalized rows.
        move: greatest way of the fit's offset from where the profile matched, m.
    """

    correlation: float = 0.5
    rival: float = 0.85
    noise: float = 1.2
    move: float = 0.8


@filter_jit
def estimate(
    view: GroundView,
    template: Template,
    *,
    hypotheses: Hypotheses | None = None,
    pitch_sigma: Any = 0.01,
    sharpness: Sharpness = AbsoluteSteps(),
    kernel: Loss | None = None,
    thresholds: LaneThresholds = LaneThresholds(),
) -> LaneState:
    """Finds the lane in a view of the road [K-33].

    The straightest hypothesis gives heading, curvature and pitch; the place of its scanline profile in a template gives
    the offset; a joint fit of every row to the template, each with its own gain and bias, gives all four with their
    covariance.

    Args:
        view: the road from above.
        template: one, or a bank of them "b columns".
        hypotheses: search grid; `Hypotheses.around(None)` by default.
        pitch_sigma: how well the pitch of the view is known, rad.
        sharpness: measure of straightness.
        kernel: robust kernel of the fit; ``Tukey(10)`` by default.
        thresholds: thresholds for a valid lane.

    Returns:
        The lane; ``ok`` is False for a road without features, one that matches none of the templates, or one
        whose profile repeats itself within reach.

    References:
        D. Pomerleau, "RALPH: rapidly adapting lateral position handler", Intelligent Vehicles 1995 [K-33...K-41].
    """
    bank = template if template.values.ndim == 2 else jax.tree.map(lambda leaf: leaf[None], template)
    tried = Hypotheses.around() if hypotheses is None else hypotheses
    found = find_straightest(view, tried, sharpness=sharpness)
    rough = jax.lax.stop_gradient(found.fit)
    profile = straighten(view, rough, bank.left[0]).profile()
    match = match_profile(profile, bank, around=tried.offset, reach=tried.reach)
    chosen = jax.tree.map(lambda leaf: leaf[match.which], bank)
    initial = LaneFit(match.offset, rough.heading, rough.curvature, rough.pitch)
    sigma = jnp.asarray(pitch_sigma, view.image.dtype)
    fit = refine(view, chosen, initial, pitch_sigma=sigma, kernel=kernel)
    ambiguous = match.sidelobe > thresholds.rival * match.correlation
    stayed = jnp.abs(fit.estimate.value.offset - match.offset) < thresholds.move
    ok = (
        fit.estimate.ok
        & stayed
        & (match.correlation > thresholds.correlation)
        & (fit.noise < thresholds.noise)
        & ~ambiguous
    )
    result = eqx.tree_at(lambda e: e.ok, fit.estimate, ok)
    return LaneState(result, match.confidence(), ambiguous, match.which, match)
