"""Detection and tracking of a lane in single images: the jitted steps of lane following.

RALPH detects a lane without a prediction, and tracks it by a template of the road's appearance where there is no paint.
Dickmanns' windows measure painted borders, which update an extended Kalman filter with a clothoid model of the road.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._jit import filter_jit
from jaxloc.beliefs import Gaussian, Sensor
from jaxloc.filters import ExtendedKalmanFilter
from jaxloc.filters.interface import GaussianState
from jaxloc.lanes import dickmanns, ralph
from jaxloc.lanes.dickmanns import BorderSensor, LaneMotion, Ride, RoadState, Windows
from jaxloc.lanes.ground_view import GroundGrid, inverse_perspective
from jaxloc.lanes.lane import Lane
from jaxloc.sensors.ground_camera import GroundCamera

_WIDTHS = (2.9, 3.2, 3.5, 3.8)  # of lanes that a detection tries: the third stands for the expected width
_FAR = 15.0  # distance at which a lane of constant curvature best approximates a clothoid, m
_PASSES = 3
_GATE = 0.9999  # probability that a correct fit passes the gate


class LaneTracker(eqx.Module):
    """Camera, models and options that all steps share.

    Attributes:
        ground: the camera with its mean pitch.
        grid: of the ground view.
        windows: measurement windows along the borders.
        motion: motion model of the filter.
        thresholds: acceptance thresholds of an edge.
        width: expected width of the lane, m,
        width_sigma: and its standard deviation, m.
        pitch_sigma: standard deviation of the mean pitch, rad.
    """

    ground: GroundCamera
    grid: GroundGrid
    windows: Windows
    motion: LaneMotion
    thresholds: dickmanns.EdgeThresholds
    width: Float[Array, ""]
    width_sigma: Float[Array, ""]
    pitch_sigma: Float[Array, ""]


class FitSensor(Sensor):
    """RALPH's fit as a measurement of (offset, heading, curvature, pitch).

    Attributes:
        fit_covariance: of the fit.
    """

    fit_covariance: Float[Array, "4 4"]

    def expect(self, state: RoadState, measurement: Float[Array, "4"]) -> Float[Array, "4"]:
        """Expected fit; its constant curvature is that of the clothoid some distance ahead."""
        lane = state.lane
        return jnp.stack([lane.offset, lane.heading, lane.curvature + _FAR * lane.rate, state.pitch])

    def covariance(self, state: RoadState, measurement: Float[Array, "4"]) -> Float[Array, "4 4"]:
        """Covariance of the fit, plus the error of the template."""
        floor = jnp.array([0.02, 2e-3, 1e-4, 1e-3], self.fit_covariance.dtype)
        return self.fit_covariance + jnp.diag(floor**2)


class Update(eqx.Module):
    """Result of a measurement in one image.

    Attributes:
        state: of the filter after it.
        ok: whether the image was used.
        found: number of windows along the left and the right border with an edge in them.
        visible: number of windows in the image.
        confidence: 0 to 1.
    """

    state: GaussianState
    ok: Bool[Array, ""]
    found: Float[Array, "2"]
    visible: Float[Array, ""]
    confidence: Float[Array, ""]


def detect_lane(tracker: LaneTracker, image: Float[Array, "h w"], bank: ralph.Template) -> Update:
    """Detects a lane without a prediction: RALPH with painted templates, then borders with a narrowing prior.

    Args:
        tracker: camera, models and options.
        image: gray levels.
        bank: painted templates, see `painted_templates`.

    Returns:
        The initial state; not ok where no pair of borders was found.
    """
    state = _propose(tracker, image, bank)
    for number in range(_PASSES):
        update = update_by_borders(tracker, state, image)
        # The same image again is no independent measurement: only the mean of the prior changes.
        state = _prior_state(tracker, update.state.mean, jnp.asarray(0.5 ** (number + 1), image.dtype))
    ok = update.ok & (jnp.min(update.found) >= 2.0)
    return eqx.tree_at(lambda m: (m.ok, m.confidence), update, (ok, jnp.where(ok, update.confidence, 0.0)))


@filter_jit
def _run_ralph(
    tracker: LaneTracker, image: Float[Array, "h w"], bank: ralph.Template, tried: ralph.Hypotheses
) -> ralph.LaneState:
    """RALPH with a fixed number of templates and hypotheses: one compiled program for all uses."""
    view = inverse_perspective(tracker.ground, image, tracker.grid)
    return ralph.estimate(view, bank, hypotheses=tried, pitch_sigma=tracker.pitch_sigma)


@filter_jit
def _propose(tracker: LaneTracker, image: Float[Array, "h w"], bank: ralph.Template) -> GaussianState:
    """RALPH's search without its refinement, as a wide prior.

    Where only one side shows paint, a painted template fits with a wrong pitch as well.
    """
    view = inverse_perspective(tracker.ground, image, tracker.grid)
    tried = ralph.Hypotheses.around(_straight_lane(tracker))
    rough = ralph.find_straightest(view, tried).fit
    profile = ralph.straighten(view, rough, bank.left[0]).profile()
    match = ralph.match_profile(profile, bank, around=tried.offset, reach=tried.reach)
    share = jnp.array(_WIDTHS, image.dtype)[match.which] / _WIDTHS[2]
    lane = Lane(match.offset, rough.heading, rough.curvature, jnp.zeros_like(match.offset))
    return _prior_state(tracker, RoadState(lane, tracker.width * share, rough.pitch), jnp.ones_like(tracker.width))


@filter_jit
def _as_prior(tracker: LaneTracker, seen: ralph.LaneState) -> GaussianState:
    """A fit of RALPH as a narrow prior."""
    fit = jax.tree.map(lambda leaf: jnp.where(seen.ok, leaf, 0.0), seen.estimate.value)
    return _prior_state(tracker, RoadState(fit.lane(), tracker.width, fit.pitch), jnp.full_like(tracker.width, 0.3))


def _straight_lane(tracker: LaneTracker) -> ralph.LaneFit:
    zero = jnp.zeros_like(tracker.width)
    return ralph.LaneFit(zero, zero, zero, zero)


@filter_jit
def update_by_borders(tracker: LaneTracker, predicted: GaussianState, image: Float[Array, "h w"]) -> Update:
    """Updates a prediction by the borders measured in their windows; not ok where there are too few edges.

    Args:
        tracker: camera, models and options.
        predicted: state at this image.
        image: gray levels.
    """
    borders = dickmanns.measure(
        image, tracker.ground, predicted.gaussian(), tracker.windows, thresholds=tracker.thresholds
    )
    count = jnp.sum(borders.found.reshape(2, -1), axis=1).astype(borders.columns.dtype)
    visible = jnp.sum(borders.visible).astype(count.dtype)
    enough = (jnp.sum(count) >= 4.0) & (jnp.max(count) >= 3.0)
    filt = ExtendedKalmanFilter(tracker.motion, borders.sensor)
    state, info = filt.update(predicted, borders.columns, borders.found & enough)
    ok = enough & info.ok
    # Dashes fill a third of the windows: half of all windows counts as full confidence.
    share = jnp.minimum(2.0 * jnp.sum(count) / jnp.maximum(visible, 1.0), 1.0)
    return Update(state, ok, count, visible, jnp.where(ok, share, 0.0))


def update_by_template(
    tracker: LaneTracker, predicted: GaussianState, image: Float[Array, "h w"], template: ralph.Template
) -> Update:
    """Updates a prediction by a template of the road across the lane; not ok where the image does not match it.

    Args:
        tracker: camera, models and options.
        predicted: state at this image.
        image: gray levels.
        template: appearance of the road so far.
    """
    mean: RoadState = predicted.mean
    near = ralph.LaneFit(mean.lane.offset, mean.lane.heading, mean.lane.curvature, mean.pitch)
    tried = ralph.Hypotheses.around(near, curvature=1.5e-3, heading=0.02, pitch=0.006, offset=0.8)
    return _update_by_fit(tracker, predicted, _run_ralph(tracker, image, _repeated(template), tried))


@filter_jit
def _update_by_fit(tracker: LaneTracker, predicted: GaussianState, seen: ralph.LaneState) -> Update:
    fit = seen.estimate.value
    values = jnp.stack([fit.offset, fit.heading, fit.curvature, fit.pitch])
    covariance = jnp.where(seen.ok, seen.estimate.covariance, jnp.eye(4, dtype=values.dtype))
    filt = ExtendedKalmanFilter(tracker.motion, FitSensor(covariance), gate=_GATE)
    state, info = filt.update(predicted, values, seen.ok)
    return _by_template(state, seen, seen.ok & info.ok & info.accepted)


def detect_by_template(tracker: LaneTracker, image: Float[Array, "h w"], template: ralph.Template) -> Update:
    """Detects a lane without a prediction and without paint, by a saved template.

    Args:
        tracker: camera, models and options.
        image: gray levels.
        template: appearance of the road across the lane.
    """
    seen = _run_ralph(tracker, image, _repeated(template), ralph.Hypotheses.around(_straight_lane(tracker)))
    return _by_template(_as_prior(tracker, seen), seen, seen.ok)


def _by_template(state: GaussianState, seen: ralph.LaneState, ok: Bool[Array, ""]) -> Update:
    zero = jnp.zeros_like(seen.confidence)
    return Update(state, ok, jnp.stack([zero, zero]), zero, jnp.where(ok, seen.confidence, 0.0))


def _repeated(template: ralph.Template) -> ralph.Template:
    """Copies of one template, as many as there are painted ones."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(_WIDTHS), *leaf.shape)), template)


@filter_jit
def predict(tracker: LaneTracker, state: GaussianState, ride: Ride) -> GaussianState:
    """The state predicted at the next image."""
    return _filter(tracker).predict(state, ride)


@filter_jit
def adapt_template(
    tracker: LaneTracker, image: Float[Array, "h w"], state: RoadState, template: ralph.Template, rate: Float[Array, ""]
) -> ralph.Template:
    """A template blended with the appearance of the road in an image, weighted by the rate."""
    view = inverse_perspective(tracker.ground, image, tracker.grid)
    lane = state.lane
    fit = ralph.LaneFit(lane.offset, lane.heading, lane.curvature + _FAR * lane.rate, state.pitch)
    return ralph.blend(template, ralph.capture(view, fit, left=template.left), rate)


@filter_jit
def border_columns(tracker: LaneTracker, state: RoadState, rows: Float[Array, " r"]) -> Float[Array, "2 r"]:
    """Columns of the left and the right border in rows of the image."""
    camera = state.camera(tracker.ground)
    ranges, _ = camera.to_ground_components(jnp.full_like(rows, camera.camera.cx), rows)
    ones = jnp.ones_like(rows)

    def columns(side: float) -> Array:
        return BorderSensor(tracker.ground, rows, ranges, side * ones, ones).expect(state, rows)

    return jnp.stack([columns(1.0), columns(-1.0)])


def painted_templates(grid: GroundGrid, width: Any) -> ralph.Template:
    """Templates of two painted borders on a uniform road, for several widths of the lane."""
    left = grid.left

    def paint(share: Array) -> ralph.Template:
        marks = sum(jnp.exp(-0.5 * ((left - 0.5 * side * width * share) / 0.09) ** 2) for side in (1.0, -1.0))
        centered = marks - jnp.mean(marks)
        return ralph.Template(centered / jnp.std(centered), jnp.ones(left.shape, bool), left)

    return jax.vmap(paint)(jnp.array(_WIDTHS, left.dtype) / _WIDTHS[2])


def initial_state(tracker: LaneTracker) -> GaussianState:
    """A state with a wide prior, before any measurement."""
    return _prior_state(
        tracker, RoadState(Lane(*[jnp.zeros_like(tracker.width)] * 4), tracker.width), 4.0 + 0.0 * tracker.width
    )


@filter_jit
def _prior_state(tracker: LaneTracker, mean: RoadState, scale: Float[Array, ""]) -> GaussianState:
    sigmas = jnp.array([0.4, 0.01, 5e-4, 8e-6, 0.0, 0.0], tracker.width.dtype)
    sigmas = sigmas.at[4].set(tracker.width_sigma).at[5].set(tracker.pitch_sigma)
    return _filter(tracker).init(Gaussian(mean, jnp.diag((scale * sigmas) ** 2)))


def _filter(tracker: LaneTracker) -> ExtendedKalmanFilter:
    """The filter without measurements."""
    return ExtendedKalmanFilter(tracker.motion, BorderSensor(tracker.ground, *[jnp.zeros(1)] * 4))
