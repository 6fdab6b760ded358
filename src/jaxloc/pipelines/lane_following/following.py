"""Lane following: where a vehicle is in its lane, image by image.

RALPH starts it, and starts it again where it was lost; Dickmanns' filter tracks the borders; where too little paint
is seen, the look of the road across carries it on.
"""

import itertools
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
from jaxloc.pipelines.lane_following import tracker
from jaxloc.pipelines.lane_following.pitch import Pitch, estimate_pitch
from jaxloc.pipelines.lane_following.tracker import Moved, Tracker
from jaxloc.sensors.ground_camera import GroundCamera


class Config(eqx.Module):
    """Options of lane following.

    Attributes:
        lane_width: m,
        lane_width_sigma: and its standard deviation, m.
        vehicle_width: for the warning, m.
        speed: m/s.
        interval: between images that have no time, s.
        sequence: whether images without a time are of one drive; each is looked at for itself otherwise.
        near: range of the nearest windows, m; 0 for what the image shows.
        far: range of the farthest ones, m; 0 for 20 m and 1.5 s of driving.
        rows: of the image at which borders are told.
        blend: share of each image in the template of the road's look.
        patience: images without a lane after which it is searched for anew.
        pitch_frames: images from which an unknown pitch is estimated.
        pitch_sigma: standard deviation of a pitch that was given, rad.
        motion: of the filter.
        trust: in an edge.
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
    trust: dickmanns.Trust = dickmanns.Trust()

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
    """An image: gray levels, and s since the first one, or None."""

    @property
    def gray(self) -> np.ndarray:
        """Gray levels, 0 to 255."""
        ...

    @property
    def time(self) -> float | None:
        """S since the first image."""
        ...


class Step(eqx.Module):
    """The lane at one image.

    Attributes:
        index: of the image.
        lane: offset (m), heading (rad), curvature (1/m) and its rate (1/m^2).
        width: of the lane, m.
        pitch: of the camera, rad.
        covariance: of offset, heading, curvature, rate, width and pitch.
        confidence: 0 to 1.
        ok: whether this image shows the lane; it is predicted where not.
        source: what showed it: "start", "borders", "template", or "prediction".
        found: windows with an edge, along the left and the right border.
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


class LaneFollower:
    """Follows a lane through images that come one at a time.

    Args:
        ground: the camera over the road, with its mean pitch.
        shape: rows and columns of the images.
        config: options.
        template: what the road looks like across, where it may have no paint; none by default.
        pitch_sigma: how well the pitch is known, rad; that of the options by default.

    Raises:
        ValueError: the camera does not see the road between the nearest and farthest windows.
    """

    def __init__(
        self,
        ground: GroundCamera,
        shape: tuple[int, int],
        config: Config = Config(),
        *,
        template: Template | None = None,
        pitch_sigma: float | None = None,
    ):
        self.config, self.shape = config, shape
        near, far, rows = _field(ground, shape, config)
        width = jnp.asarray(config.lane_width, ground.height.dtype)
        sigma = config.pitch_sigma if pitch_sigma is None else max(pitch_sigma, config.pitch_sigma)
        self._tracker = Tracker(
            ground,
            GroundGrid.between(near, far, 9.6),
            Windows(near, far),
            config.motion,
            config.trust,
            width,
            jnp.asarray(config.lane_width_sigma, width.dtype),
            jnp.asarray(sigma, width.dtype),
        )
        self._rows = rows
        self._bank = tracker.painted_bank(self._tracker.grid, width)
        self._saved = template
        self._template: Template | None = template
        self._state: GaussianState = tracker.unknown_state(self._tracker)
        self._missing = config.patience
        self._time: float | None = None
        self._index = 0

    def follow(self, frame: Frame, *, yaw_rate: float | None = None) -> Step:
        """Looks at the next image.

        Args:
            frame: of the shape that was told.
            yaw_rate: of the vehicle since the last one, rad/s; None where not known: it is taken to follow the lane.

        Returns:
            The lane.

        Raises:
            ValueError: the image has another shape.
        """
        if frame.gray.shape != self.shape:
            raise ValueError(f"The image has the shape {frame.gray.shape}; the follower was told {self.shape}.")
        image = jnp.asarray(frame.gray, self._tracker.width.dtype)
        moved, source = self._look(image, self._ride(frame.time, yaw_rate))
        self._state = moved.state
        ok = bool(moved.ok)
        self._missing = 0 if ok else self._missing + 1
        if ok and source != "template":
            self._learn(image)
        step = self._step(moved, source if ok else "prediction")
        self._index += 1
        return step

    def _ride(self, time: float | None, yaw_rate: float | None) -> Ride | None:
        """What happened since the last image; None if the last one is of no use."""
        alone = time is None and not self.config.sequence
        before, self._time = self._time, time
        if self._index == 0 or alone:
            return None
        dt = self.config.interval if time is None or before is None else max(time - before, 0.0)
        known = yaw_rate is not None
        return Ride(dt, self.config.speed, yaw_rate if known else 0.0, known)

    def _look(self, image: jax.Array, ride: Ride | None) -> tuple[Moved, str]:
        if ride is None:
            self._state, self._missing = tracker.unknown_state(self._tracker), self.config.patience
            self._template = self._saved
        elif self._missing < self.config.patience:
            predicted = tracker.predict(self._tracker, self._state, ride)
            moved = tracker.settle(self._tracker, predicted, image)
            if bool(moved.ok) or self._template is None:
                return moved, "borders"
            return tracker.follow_template(self._tracker, moved.state, image, self._template), "template"
        found = tracker.begin(self._tracker, image, self._bank)
        if not bool(found.ok) and self._saved is not None:
            found = tracker.recognize(self._tracker, image, self._saved)
        if bool(found.ok):
            return found, "start"
        state = self._state if ride is None else tracker.predict(self._tracker, self._state, ride)
        return eqx.tree_at(lambda m: m.state, found, state), "prediction"

    def _learn(self, image: jax.Array) -> None:
        mean, rate = self._state.mean, self.config.blend
        old = self._template
        if old is None:
            left = self._bank.left[0]
            old, rate = Template(jnp.zeros_like(left), jnp.zeros(left.shape, bool), left), 1.0
        share = jnp.asarray(rate, image.dtype)
        self._template = tracker.adapt(self._tracker, image, mean, old, share)

    def _step(self, moved: Moved, source: str) -> Step:
        config, state = self.config, moved.state
        mean: RoadState = state.mean
        columns = np.asarray(tracker.border_columns(self._tracker, mean, jnp.asarray(self._rows, jnp.float32)))
        crossing = time_to_line_crossing(mean.lane, mean.width, config.vehicle_width, config.speed)
        lane = mean.lane
        return Step(
            index=self._index,
            lane=np.array([float(part) for part in (lane.offset, lane.heading, lane.curvature, lane.rate)]),
            width=float(mean.width),
            pitch=float(self._tracker.ground.pitch + mean.pitch),
            covariance=np.asarray(state.covariance, np.float64),
            confidence=float(moved.confidence),
            ok=bool(moved.ok),
            source=source,
            found=(int(moved.found[0]), int(moved.found[1])),
            rows=self._rows,
            left=columns[0].astype(np.float64),
            right=columns[1].astype(np.float64),
            crossing=float(crossing.time),
            crossing_side=int(crossing.side),
        )


def follow(
    frames: Iterable[Frame],
    ground: GroundCamera,
    config: Config = Config(),
    *,
    pitch_known: bool = True,
    template: Template | None = None,
    yaw_rates: Iterable[float] | None = None,
) -> Iterator[Step]:
    """Follows a lane through images.

    Args:
        frames: images of one shape.
        ground: the camera over the road.
        config: options.
        pitch_known: False to estimate the pitch from the vanishing point of the first images.
        template: what the road looks like across, where it may have no paint.
        yaw_rates: of the vehicle before each image, rad/s; None where not known.

    Yields:
        The lane at each image.

    Example:
        >>> import jaxloc as jl
        >>> from jaxloc.pipelines.lane_following.following import Config, follow
        >>> ground = jl.sensors.GroundCamera(jl.sensors.Pinhole(250.0, 250.0, 159.5, 100.0), height=1.3, pitch=0.03)
        >>> list(follow([], ground, Config()))
        []
    """
    frames = iter(frames)
    sigma = None
    if not pitch_known:
        first = list(itertools.islice(frames, config.pitch_frames))
        pitch, ground = level(first, ground)
        sigma, frames = pitch.sigma, itertools.chain(first, frames)
    rates: Iterator[Any] = itertools.repeat(None) if yaw_rates is None else iter(yaw_rates)
    follower: LaneFollower | None = None
    for frame in frames:
        if follower is None:
            shape = (frame.gray.shape[0], frame.gray.shape[1])
            follower = LaneFollower(ground, shape, config, template=template, pitch_sigma=sigma)
        yield follower.follow(frame, yaw_rate=next(rates))


def level(frames: Iterable[Frame], ground: GroundCamera) -> tuple[Pitch, GroundCamera]:
    """The pitch that images show, and the camera with it.

    Args:
        frames: of a stretch that is straight on the whole.
        ground: the camera; its pitch stays where no vanishing point is found.
    """
    pitch = estimate_pitch((frame.gray for frame in frames), ground)
    return pitch, eqx.tree_at(lambda g: g.pitch, ground, jnp.asarray(pitch.value, ground.pitch.dtype))


def _field(
    ground: GroundCamera, shape: tuple[int, int], config: Config
) -> tuple[float, float, Float64[np.ndarray, " r"]]:
    """Ranges of the nearest and farthest windows, and rows at which borders are told."""
    middle, bottom = ground.camera.cx, jnp.asarray(shape[0] - 1.0, ground.camera.cx.dtype)
    seen, _ = ground.to_ground_components(middle, bottom)
    near = max(1.02 * float(seen), 5.0) if config.near <= 0.0 else config.near
    far = 20.0 + 1.5 * config.speed if config.far <= 0.0 else config.far
    if not (bool(ground.meets_ground_components(middle, bottom)) and 0.0 < near < 0.8 * far):
        raise ValueError(
            f"The camera sees the road from {float(seen):.1f} m on, with the pitch {float(ground.pitch):.3f} rad; "
            f"it is needed from {near:.1f} m to {far:.1f} m: check its pitch and height."
        )
    _, top = ground.project_components(jnp.asarray(far), jnp.zeros(()))
    rows = np.unique(np.round(np.linspace(float(top), shape[0] - 1.0, config.rows)))
    return near, far, rows[(rows >= 0) & (rows < shape[0])]
