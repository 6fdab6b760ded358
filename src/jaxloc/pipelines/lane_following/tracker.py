"""The jitted steps of lane following: start from nothing, go on by borders, go on by the look of the road.

RALPH tells where a road runs without being told where to look; Dickmanns' windows then find its painted borders to the
centimeter, in a Kalman filter that knows how a clothoid passes below a vehicle.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc.beliefs import Gaussian, Sensor
from jaxloc.filters import ExtendedKalmanFilter
from jaxloc.filters.interface import GaussianState
from jaxloc.lanes import dickmanns, ralph
from jaxloc.lanes.dickmanns import BorderSensor, LaneMotion, Ride, RoadState, Windows
from jaxloc.lanes.ground_view import GroundGrid, look
from jaxloc.lanes.lane import Lane
from jaxloc.sensors.ground_camera import GroundCamera

_WIDTHS = (2.9, 3.2, 3.5, 3.8)  # of lanes that a start tries: the third stands for the width that it is told
_FAR = 15.0  # where a lane of constant curvature best stands for a clothoid, m
_PASSES = 3
_GATE = 0.9999  # probability that a right fit is taken


class Tracker(eqx.Module):
    """What all steps share.

    Attributes:
        ground: the camera with its mean pitch.
        grid: of the view from above.
        windows: along the borders.
        motion: of the filter.
        trust: in an edge.
        width: of the lane as it is expected, m,
        width_sigma: and its standard deviation, m.
        pitch_sigma: of the mean pitch, rad.
    """

    ground: GroundCamera
    grid: GroundGrid
    windows: Windows
    motion: LaneMotion
    trust: dickmanns.Trust
    width: Float[Array, ""]
    width_sigma: Float[Array, ""]
    pitch_sigma: Float[Array, ""]


class FitSensor(Sensor):
    """RALPH's fit as a measurement of (offset, heading, curvature, pitch).

    Attributes:
        spread: covariance of the fit.
    """

    spread: Float[Array, "4 4"]

    def expect(self, state: RoadState, measurement: Float[Array, "4"]) -> Float[Array, "4"]:
        """The four, with the curvature some way ahead: the fit has a constant one."""
        lane = state.lane
        return jnp.stack([lane.offset, lane.heading, lane.curvature + _FAR * lane.rate, state.pitch])

    def covariance(self, state: RoadState, measurement: Float[Array, "4"]) -> Float[Array, "4 4"]:
        """That of the fit, and what a template may be wrong by."""
        floor = jnp.array([0.02, 2e-3, 1e-4, 1e-3], self.spread.dtype)
        return self.spread + jnp.diag(floor**2)


class Moved(eqx.Module):
    """A step of the filter.

    Attributes:
        state: after it.
        ok: whether the image was used.
        found: windows along the left and the right border with an edge in them.
        visible: windows in the image.
        confidence: 0 to 1.
    """

    state: GaussianState
    ok: Bool[Array, ""]
    found: Float[Array, "2"]
    visible: Float[Array, ""]
    confidence: Float[Array, ""]


def begin(tracker: Tracker, image: Float[Array, "h w"], bank: ralph.Template) -> Moved:
    """Finds a lane without a prediction: RALPH against painted templates, then windows of a narrowing prior.

    Args:
        tracker: what all steps share.
        image: gray levels.
        bank: painted templates, see `painted_bank`.

    Returns:
        The first state; not ok where no pair of borders was found.
    """
    state = _propose(tracker, image, bank)
    for number in range(_PASSES):
        moved = settle(tracker, state, image)
        # The same image again is no new evidence: the prior moves, and stays a prior.
        state = _start(tracker, moved.state.mean, jnp.asarray(0.5 ** (number + 1), image.dtype))
    ok = moved.ok & (jnp.min(moved.found) >= 2.0)
    return eqx.tree_at(lambda m: (m.ok, m.confidence), moved, (ok, jnp.where(ok, moved.confidence, 0.0)))


@eqx.filter_jit
def _see(
    tracker: Tracker, image: Float[Array, "h w"], bank: ralph.Template, tried: ralph.Hypotheses
) -> ralph.LaneState:
    """RALPH; one program for all that it is asked here, since it takes long to compile."""
    view = look(tracker.ground, image, tracker.grid)
    return ralph.estimate(view, bank, hypotheses=tried, pitch_sigma=tracker.pitch_sigma)


@eqx.filter_jit
def _propose(tracker: Tracker, image: Float[Array, "h w"], bank: ralph.Template) -> GaussianState:
    """RALPH's search as a wide prior, without its fit.

    Where only one side shows paint, a painted template fits with a wrong pitch as well.
    """
    view = look(tracker.ground, image, tracker.grid)
    tried = ralph.Hypotheses.around(_nothing(tracker))
    rough = ralph.find_straightest(view, tried).fit
    profile = ralph.straighten(view, rough, bank.left[0]).profile()
    match = ralph.match_profile(profile, bank, around=tried.offset, reach=tried.reach)
    share = jnp.array(_WIDTHS, image.dtype)[match.which] / _WIDTHS[2]
    lane = Lane(match.offset, rough.heading, rough.curvature, jnp.zeros_like(match.offset))
    return _start(tracker, RoadState(lane, tracker.width * share, rough.pitch), jnp.ones_like(tracker.width))


@eqx.filter_jit
def _as_prior(tracker: Tracker, seen: ralph.LaneState) -> GaussianState:
    """A lane that RALPH recognized, with a narrow prior of its own."""
    fit = jax.tree.map(lambda leaf: jnp.where(seen.ok, leaf, 0.0), seen.estimate.value)
    return _start(tracker, RoadState(fit.lane(), tracker.width, fit.pitch), jnp.full_like(tracker.width, 0.3))


def _nothing(tracker: Tracker) -> ralph.LaneFit:
    zero = jnp.zeros_like(tracker.width)
    return ralph.LaneFit(zero, zero, zero, zero)


@eqx.filter_jit
def settle(tracker: Tracker, predicted: GaussianState, image: Float[Array, "h w"]) -> Moved:
    """Updates a prediction by the borders where they are found; not ok where too few of them are.

    Args:
        tracker: what all steps share.
        predicted: for this image.
        image: gray levels.
    """
    borders = dickmanns.measure(image, tracker.ground, predicted.gaussian(), tracker.windows, trust=tracker.trust)
    count = jnp.sum(borders.found.reshape(2, -1), axis=1).astype(borders.columns.dtype)
    visible = jnp.sum(borders.visible).astype(count.dtype)
    enough = (jnp.sum(count) >= 4.0) & (jnp.max(count) >= 3.0)
    filt = ExtendedKalmanFilter(tracker.motion, borders.sensor)
    state, info = filt.update(predicted, borders.columns, borders.found & enough)
    ok = enough & info.ok
    # Of dashes a third of the windows shows paint: half of all windows is as good as all of them.
    share = jnp.minimum(2.0 * jnp.sum(count) / jnp.maximum(visible, 1.0), 1.0)
    return Moved(state, ok, count, visible, jnp.where(ok, share, 0.0))


def follow_template(
    tracker: Tracker, predicted: GaussianState, image: Float[Array, "h w"], template: ralph.Template
) -> Moved:
    """Updates a predicted state by what the road looks like across; not ok where it looks otherwise.

    Args:
        tracker: what all steps share.
        predicted: for this image.
        image: gray levels.
        template: what the road looked like so far.
    """
    mean: RoadState = predicted.mean
    near = ralph.LaneFit(mean.lane.offset, mean.lane.heading, mean.lane.curvature, mean.pitch)
    tried = ralph.Hypotheses.around(near, curvature=1.5e-3, heading=0.02, pitch=0.006, offset=0.8)
    return _take(tracker, predicted, _see(tracker, image, _alone(template), tried))


@eqx.filter_jit
def _take(tracker: Tracker, predicted: GaussianState, seen: ralph.LaneState) -> Moved:
    fit = seen.estimate.value
    values = jnp.stack([fit.offset, fit.heading, fit.curvature, fit.pitch])
    spread = jnp.where(seen.ok, seen.estimate.covariance, jnp.eye(4, dtype=values.dtype))
    filt = ExtendedKalmanFilter(tracker.motion, FitSensor(spread), gate=_GATE)
    state, info = filt.update(predicted, values, seen.ok)
    return _by_template(state, seen, seen.ok & info.ok & info.accepted)


def recognize(tracker: Tracker, image: Float[Array, "h w"], template: ralph.Template) -> Moved:
    """Finds a lane without a prediction and without paint, by a saved template.

    Args:
        tracker: what all steps share.
        image: gray levels.
        template: what the road looks like.
    """
    seen = _see(tracker, image, _alone(template), ralph.Hypotheses.around(_nothing(tracker)))
    return _by_template(_as_prior(tracker, seen), seen, seen.ok)


def _by_template(state: GaussianState, seen: ralph.LaneState, ok: Bool[Array, ""]) -> Moved:
    zero = jnp.zeros_like(seen.confidence)
    return Moved(state, ok, jnp.stack([zero, zero]), zero, jnp.where(ok, seen.confidence, 0.0))


def _alone(template: ralph.Template) -> ralph.Template:
    """A bank of nothing but one template, of the size of the painted one."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(_WIDTHS), *leaf.shape)), template)


@eqx.filter_jit
def predict(tracker: Tracker, state: GaussianState, ride: Ride) -> GaussianState:
    """The state at the next image."""
    return _idle(tracker).predict(state, ride)


@eqx.filter_jit
def adapt(
    tracker: Tracker, image: Float[Array, "h w"], state: RoadState, template: ralph.Template, rate: Float[Array, ""]
) -> ralph.Template:
    """A template with a share of what the road looks like now; rate 1 takes it anew."""
    view = look(tracker.ground, image, tracker.grid)
    lane = state.lane
    fit = ralph.LaneFit(lane.offset, lane.heading, lane.curvature + _FAR * lane.rate, state.pitch)
    return ralph.blend(template, ralph.capture(view, fit, left=template.left), rate)


@eqx.filter_jit
def border_columns(tracker: Tracker, state: RoadState, rows: Float[Array, " r"]) -> Float[Array, "2 r"]:
    """Columns of the left and right border in rows of the image."""
    camera = state.camera(tracker.ground)
    ranges, _ = camera.to_ground_components(jnp.full_like(rows, camera.camera.cx), rows)
    ones = jnp.ones_like(rows)

    def columns(side: float) -> Array:
        return BorderSensor(tracker.ground, rows, ranges, side * ones, ones).expect(state, rows)

    return jnp.stack([columns(1.0), columns(-1.0)])


def painted_bank(grid: GroundGrid, width: Any) -> ralph.Template:
    """Templates of two painted borders on an even road, for several widths of the lane."""
    left = grid.left

    def paint(share: Array) -> ralph.Template:
        marks = sum(jnp.exp(-0.5 * ((left - 0.5 * side * width * share) / 0.09) ** 2) for side in (1.0, -1.0))
        centered = marks - jnp.mean(marks)
        return ralph.Template(centered / jnp.std(centered), jnp.ones(left.shape, bool), left)

    return jax.vmap(paint)(jnp.array(_WIDTHS, left.dtype) / _WIDTHS[2])


def unknown_state(tracker: Tracker) -> GaussianState:
    """A state of which nothing is known."""
    return _start(
        tracker, RoadState(Lane(*[jnp.zeros_like(tracker.width)] * 4), tracker.width), 4.0 + 0.0 * tracker.width
    )


@eqx.filter_jit
def _start(tracker: Tracker, mean: RoadState, scale: Float[Array, ""]) -> GaussianState:
    sigmas = jnp.array([0.4, 0.01, 5e-4, 8e-6, 0.0, 0.0], tracker.width.dtype)
    sigmas = sigmas.at[4].set(tracker.width_sigma).at[5].set(tracker.pitch_sigma)
    return _idle(tracker).init(Gaussian(mean, jnp.diag((scale * sigmas) ** 2)))


def _idle(tracker: Tracker) -> ExtendedKalmanFilter:
    """The filter where nothing is measured."""
    return ExtendedKalmanFilter(tracker.motion, BorderSensor(tracker.ground, *[jnp.zeros(1)] * 4))
