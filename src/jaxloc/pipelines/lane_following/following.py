"""Lane following: lateral position and heading of a vehicle in its lane, and the lane's curvature, image by image.

RALPH detects the lane, also after it was lost; Dickmanns' Kalman filter tracks the painted borders; where there is too
little paint, a template of the road's appearance is tracked.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxloc.filters.interface import GaussianState
from jaxloc.lanes import dickmanns
from jaxloc.lanes.departure import time_to_line_crossing
from jaxloc.lanes.dickmanns import LaneMotion, Ride, RoadState, Windows
from jaxloc.lanes.ground_view import GroundGrid
from jaxloc.lanes.ralph import Template
from jaxloc.pipelines.input_checks import check_image
from jaxloc.pipelines.lane_following import lane_tracker
from jaxloc.pipelines.lane_following.lane_tracker import LaneTracker, Update
from jaxloc.pipelines.lane_following.pitch import Pitch, estimate_pitch
from jaxloc.sensors.ground_camera import GroundCamera


class Config(eqx.Module):
    """Options of lane following.

    Attributes:
        lane_width: expected width, m,
        lane_width_sigma: and its standard deviation, m.
        vehicle_width: for the time to line crossing, m.
        speed: of the vehicle, m/s.
        interval: between images that have no time, s.
        sequence: whether images without a time are a sequence; otherwise each is processed on its own.
        near: range of the nearest windows, m; 0 for what the image shows.
        far: range of the farthest ones, m; 0 for 20 m and 1.5 s of driving.
        rows: number of image rows for which the columns of the borders are computed.
        blend: weight of each image in the template of the road's appearance.
        patience: number of images without a lane after which it is detected anew.
        pitch_frames: number of images from which an unknown pitch is estimated.
        pitch_sigma: standard deviation of a given pitch, rad.
        motion: motion model of the filter.
        thresholds: acceptance thresholds of an edge.
    """

    lane_width: float = 3.6
    lane_width_sigma: float = 0.25
    vehicle_width: float = 1.8
    speed: float = 20.0
    interval: float = 0.1
    sequence: bool = False
    near: float = 0.0
    far: float = 0.0
    rows: int = 16
    blend: float = 0.05
    patience: int = 5
    pitch_frames: int = 25
    pitch_sigma: float = 0.006
    motion: LaneMotion = LaneMotion()
    thresholds: dickmanns.EdgeThresholds = dickmanns.EdgeThresholds()

    def __check_init__(self):
        for name in ("lane_width", "lane_width_sigma", "vehicle_width", "interval", "pitch_sigma"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}, must be positive")
        for name in ("rows", "patience", "pitch_frames"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, must be at least 1")
        if self.speed < 0:
            raise ValueError(f"speed is {self.speed}, must not be negative")
        if not 0 <= self.blend <= 1:
            raise ValueError(f"blend is {self.blend}, must lie between 0 and 1")


@runtime_checkable
class Frame(Protocol):
    """A grayscale image with its time."""

    @property
    def gray(self) -> np.ndarray:
        """Gray levels, 0 to 255."""
        ...

    @property
    def time(self) -> float | None:
        """Seconds since the first image, or None."""
        ...


class Output(eqx.Module):
    """Lane estimated at one image.

    Attributes:
        index: number of the image, from 0.
        lane: offset (m), heading (rad), curvature (1/m) and its rate (1/m^2).
        width: of the lane, m.
        pitch: of the camera, rad.
        covariance: of offset, heading, curvature, rate, width and pitch.
        confidence: 0 to 1.
        ok: whether the lane was measured in this image; otherwise it is predicted.
        source: what it was measured by: "start" (detection), "borders", "template", or "prediction".
        found: number of windows with an edge, along the left and the right border.
        rows: of the image.
        left: column of the left border in each of them, px,
        right: and of the right one.
        crossing: time to line crossing, s; infinite for none.
        crossing_side: 1 for the left line, -1 for the right one, 0 for none.
    """

    index: int
    lane: Float64[np.ndarray, "4"]
    width: float
    pitch: float
    covariance: Float64[np.ndarray, "6 6"]
    confidence: float
    ok: bool
    source: str
    found: tuple[int, int]
    rows: Float64[np.ndarray, " r"]
    left: Float64[np.ndarray, " r"]
    right: Float64[np.ndarray, " r"]
    crossing: float
    crossing_side: int


class State(eqx.Module):
    """State of lane following between two images.

    Attributes:
        config: options.
        tracker: camera and models.
        shape: rows and columns of the images.
        rows: of the image for which the borders are computed.
        painted: templates of painted borders.
        saved: template that was given, if any.
        template: of the road's appearance so far.
        has_template: whether there is one.
        belief: state of the filter.
        missing: number of images in a row without a lane.
        time: of the last image, s; nan where it had none.
        index: number of the next image.
    """

    config: Config
    tracker: LaneTracker
    shape: tuple[int, int]
    rows: Float64[np.ndarray, " r"]
    painted: Template
    saved: Template | None
    template: Template
    has_template: bool
    belief: GaussianState
    missing: int
    time: float
    index: int


def init(
    config: Config,
    ground: GroundCamera,
    shape: tuple[int, int],
    *,
    template: Template | None = None,
    pitch_sigma: float | None = None,
) -> State:
    """The state before the first image.

    Args:
        config: options.
        ground: the camera over the road, with its mean pitch.
        shape: rows and columns of the images.
        template: appearance of the road across the lane, where it may have no paint; none by default.
        pitch_sigma: standard deviation of the pitch, rad; that of the options by default.

    Raises:
        ValueError: the camera does not see the road between the nearest and farthest windows.
    """
    near, far, rows = _field(ground, shape, config)
    width = jnp.asarray(config.lane_width, ground.height.dtype)
    sigma = config.pitch_sigma if pitch_sigma is None else max(pitch_sigma, config.pitch_sigma)
    tracker = LaneTracker(
        ground,
        GroundGrid.between(near, far, 9.6),
        Windows(near, far),
        config.motion,
        config.thresholds,
        width,
        jnp.asarray(config.lane_width_sigma, width.dtype),
        jnp.asarray(sigma, width.dtype),
    )
    painted = lane_tracker.painted_templates(tracker.grid, width)
    left = painted.left[0]
    first = Template(jnp.zeros_like(left), jnp.zeros(left.shape, bool), left) if template is None else template
    belief = lane_tracker.initial_state(tracker)
    templates = (painted, template, first, template is not None)
    return State(config, tracker, shape, rows, *templates, belief, config.patience, math.nan, 0)


def step(state: State, frame: Frame, *, yaw_rate: float | None = None) -> tuple[State, Output]:
    """Estimates the lane at the next image.

    Args:
        state: from `init` or the last step.
        frame: grayscale image of the shape given to `init`, and its time.
        yaw_rate: of the vehicle since the last image, rad/s; None where not known: it is assumed to follow the lane.

    Returns:
        The next state, and the lane.

    Raises:
        ValueError: the image is no grayscale image of bytes or floats, or has another shape.
    """
    check_image(frame.gray, state.shape)
    image = jnp.asarray(frame.gray, state.tracker.width.dtype)
    ride = _ride(state, frame.time, yaw_rate)
    if ride is None:  # an image on its own, or the first: nothing of the past is used
        state = _reset(state)
    update, source = _measure(state, image, ride)
    ok = bool(update.ok)
    output = _output(state, update, source if ok else "prediction")
    template, has_template = state.template, state.has_template
    if ok and source != "template":
        template, has_template = _learn(state, image, update.state.mean), True
    time = math.nan if frame.time is None else float(frame.time)
    missing = 0 if ok else state.missing + 1
    changed = {"template": template, "has_template": has_template, "belief": update.state}
    return dataclasses.replace(state, **changed, missing=missing, time=time, index=state.index + 1), output


def run(
    frames: Iterable[Frame],
    config: Config,
    ground: GroundCamera,
    *,
    pitch_known: bool = True,
    template: Template | None = None,
    yaw_rates: Iterable[float] | None = None,
) -> Iterator[Output]:
    """Follows a lane through a recording, see `step`.

    Args:
        frames: images of one shape.
        config: options.
        ground: the camera over the road.
        pitch_known: False to estimate the pitch from the vanishing point of the first images.
        template: appearance of the road across the lane, where it may have no paint.
        yaw_rates: of the vehicle before each image, rad/s; None where not known.

    Yields:
        The lane at each image.

    Example:
        >>> import jaxloc as jl
        >>> from jaxloc.pipelines import lane_following
        >>> ground = jl.sensors.GroundCamera(jl.sensors.Pinhole(250.0, 250.0, 159.5, 100.0), height=1.3, pitch=0.03)
        >>> list(lane_following.run([], lane_following.Config(), ground))
        []
    """
    frames, sigma = iter(frames), None
    if not pitch_known:
        first = list(itertools.islice(frames, config.pitch_frames))
        pitch, ground = correct_pitch(first, ground)
        sigma, frames = pitch.sigma, itertools.chain(first, frames)
    rates: Iterator[Any] = itertools.repeat(None) if yaw_rates is None else iter(yaw_rates)
    state: State | None = None
    for frame in frames:
        if state is None:
            shape = check_image(frame.gray, (0, 0))
            state = init(config, ground, shape, template=template, pitch_sigma=sigma)
        state, output = step(state, frame, yaw_rate=next(rates))
        yield output


def correct_pitch(frames: Iterable[Frame], ground: GroundCamera) -> tuple[Pitch, GroundCamera]:
    """The pitch estimated from images, and the camera with it.

    Args:
        frames: of a mostly straight road.
        ground: the camera; its pitch stays where no vanishing point is found.
    """
    pitch = estimate_pitch((frame.gray for frame in frames), ground)
    return pitch, eqx.tree_at(lambda g: g.pitch, ground, jnp.asarray(pitch.value, ground.pitch.dtype))


def _ride(state: State, time: float | None, yaw_rate: float | None) -> Ride | None:
    """Time and motion since the last image; None if the last one is of no use."""
    if state.index == 0 or (time is None and not state.config.sequence):
        return None
    dt = state.config.interval if time is None or math.isnan(state.time) else max(time - state.time, 0.0)
    known = yaw_rate is not None
    return Ride(dt, state.config.speed, yaw_rate if known else 0.0, known)


def _reset(state: State) -> State:
    """The state before any image, with the template that was given."""
    has_template = state.saved is not None
    template = state.template if state.saved is None else state.saved
    changed = {"template": template, "has_template": has_template, "missing": state.config.patience}
    return dataclasses.replace(state, belief=lane_tracker.initial_state(state.tracker), **changed)


def _measure(state: State, image: jax.Array, ride: Ride | None) -> tuple[Update, str]:
    """Tracks the lane by borders or template, or detects it where it was lost."""
    tracker, belief = state.tracker, state.belief
    predicted = belief if ride is None else lane_tracker.predict(tracker, belief, ride)
    if state.missing < state.config.patience:
        update = lane_tracker.update_by_borders(tracker, predicted, image)
        if bool(update.ok) or not state.has_template:
            return update, "borders"
        return lane_tracker.update_by_template(tracker, update.state, image, state.template), "template"
    found = lane_tracker.detect_lane(tracker, image, state.painted)
    if not bool(found.ok) and state.saved is not None:
        found = lane_tracker.detect_by_template(tracker, image, state.saved)
    if bool(found.ok):
        return found, "start"
    return eqx.tree_at(lambda u: u.state, found, predicted), "prediction"


def _learn(state: State, image: jax.Array, mean: RoadState) -> Template:
    """The template blended with the image; the first one is the image's."""
    old, rate = state.template, state.config.blend
    if not state.has_template:
        left = state.painted.left[0]
        old, rate = Template(jnp.zeros_like(left), jnp.zeros(left.shape, bool), left), 1.0
    return lane_tracker.adapt_template(state.tracker, image, mean, old, jnp.asarray(rate, image.dtype))


def _output(state: State, update: Update, source: str) -> Output:
    config, belief, rows = state.config, update.state, state.rows
    mean: RoadState = belief.mean
    columns = np.asarray(lane_tracker.border_columns(state.tracker, mean, jnp.asarray(rows, jnp.float32)))
    crossing = time_to_line_crossing(mean.lane, mean.width, config.vehicle_width, config.speed)
    lane = mean.lane
    return Output(
        index=state.index,
        lane=np.array([float(part) for part in (lane.offset, lane.heading, lane.curvature, lane.rate)]),
        width=float(mean.width),
        pitch=float(state.tracker.ground.pitch + mean.pitch),
        covariance=np.asarray(belief.covariance, np.float64),
        confidence=float(update.confidence),
        ok=bool(update.ok),
        source=source,
        found=(int(update.found[0]), int(update.found[1])),
        rows=rows,
        left=columns[0].astype(np.float64),
        right=columns[1].astype(np.float64),
        crossing=float(crossing.time),
        crossing_side=int(crossing.side),
    )


def _field(
    ground: GroundCamera, shape: tuple[int, int], config: Config
) -> tuple[float, float, Float64[np.ndarray, " r"]]:
    """Ranges of the nearest and farthest windows, and rows for which the borders are computed."""
    middle, bottom = ground.camera.cx, jnp.asarray(shape[0] - 1.0, ground.camera.cx.dtype)
    nearest, _ = ground.to_ground_components(middle, bottom)
    near = max(1.02 * float(nearest), 5.0) if config.near <= 0.0 else config.near
    far = 20.0 + 1.5 * config.speed if config.far <= 0.0 else config.far
    if not (bool(ground.meets_ground_components(middle, bottom)) and 0.0 < near < 0.8 * far):
        raise ValueError(
            f"The camera sees the road from {float(nearest):.1f} m on, with the pitch {float(ground.pitch):.3f} rad; "
            f"it is needed from {near:.1f} m to {far:.1f} m: check its pitch and height."
        )
    _, top = ground.project_components(jnp.asarray(far), jnp.zeros(()))
    rows = np.unique(np.round(np.linspace(float(top), shape[0] - 1.0, config.rows)))
    return near, far, rows[(rows >= 0) & (rows < shape[0])]
