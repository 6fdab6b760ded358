"""Measurement of lane borders in windows around their predicted positions."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import Gaussian
from jaxloc.lanes.dickmanns.edges import EdgeDetector, LightStripe, find_edge
from jaxloc.lanes.dickmanns.model import BorderSensor, RoadState
from jaxloc.lanes.dickmanns.windows import Windows, sum_columns
from jaxloc.sensors.ground_camera import GroundCamera


class EdgeThresholds(eqx.Module):
    """Thresholds for an edge to be accepted as the lane border.

    Args:
        snr: least response, in its own standard deviations.
        contrast: least contrast, gray levels.
        gate: greatest distance from the prediction, in standard deviations of that distance.
        paint: standard deviation of the place of paint on the road, m,
        pixels: and of the image of an edge, px: what an edge is never better known than.
    """

    snr: float = 5.0
    contrast: float = 8.0
    gate: float = 3.0
    paint: float = 0.03
    pixels: float = 0.4


class Borders(eqx.Module):
    """Border measurements of all windows, those of the left border first.

    Attributes:
        columns: in which the borders cross `sensor.rows`, px; the predicted ones where not found.
        found: which were.
        sensor: measurement model of the columns.
        predicted: columns by the prediction, px.
        visible: which windows are in the image.
    """

    columns: Float[Array, " n"]
    found: Bool[Array, " n"]
    sensor: BorderSensor
    predicted: Float[Array, " n"]
    visible: Bool[Array, " n"]


@filter_jit
def measure(
    image: Num[Array, "h w"],
    ground: GroundCamera,
    predicted: Gaussian,
    windows: Windows | None = None,
    *,
    detector: EdgeDetector = LightStripe(),
    thresholds: EdgeThresholds = EdgeThresholds(),
) -> Borders:
    """Measures the borders in windows around their predicted positions.

    Each window is searched only as far as the prediction is uncertain, and what lies farther off than its gate is left
    out [K-31].

    Args:
        image: gray levels.
        ground: the camera with its mean pitch.
        predicted: a `RoadState` and its covariance.
        windows: measurement windows; `Windows()` by default.
        detector: what a border is.
        thresholds: acceptance thresholds of an edge.

    Returns:
        The borders, for `jaxloc.filters.ExtendedKalmanFilter.update` with ``sensor``, ``columns`` and ``found``.

    References:
        Dickmanns and Mysliwetz (1992) [K-31], [K-32].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> ground = jl.sensors.GroundCamera(jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0), height=1.5)
        >>> state = jl.lanes.dickmanns.RoadState(jl.lanes.Lane(0.0, 0.0, 0.0))
        >>> night = jl.lanes.dickmanns.measure(
        ...     jnp.zeros((480, 640)), ground, jl.beliefs.Gaussian(state, 1e-4 * jnp.eye(6)))
        >>> bool(jnp.any(night.found))
        False
    """
    windows = Windows() if windows is None else windows
    state: RoadState = predicted.mean
    ranges, _ = windows.ranges()
    sides = windows.sides()
    camera = state.camera(ground)
    y = state.border(ranges, sides)
    (columns, rows), (scale, _) = jax.jvp(
        lambda left: camera.project_components(ranges, left), (y,), (jnp.ones_like(y),)
    )
    sensor = BorderSensor(ground, rows, ranges, sides, jnp.ones_like(rows))
    _, jacobian = sensor.linearize(state, columns)
    predicted_variance = jnp.sum(matmul(jacobian, predicted.covariance) * jacobian, axis=1)
    per_meter = jnp.maximum(jnp.abs(scale), 1e-3)
    within = jnp.clip(thresholds.gate * jnp.sqrt(predicted_variance) / per_meter + 0.1, 0.2, windows.reach)
    sums = sum_columns(image, ground, state, windows)
    # Samples nearer to each other than a pixel are not independent.
    crowd = jnp.maximum(1.0 / (per_meter * 2.0 * windows.reach / (windows.columns - 1)), 1.0)
    edges = jax.vmap(lambda p, n, w: find_edge(p, n, windows.reach, within=w, detector=detector))(
        sums.profile, sums.variance * crowd, within
    )
    variance = scale**2 * (edges.variance + thresholds.paint**2) + thresholds.pixels**2
    moved = scale * edges.place
    near = moved**2 <= thresholds.gate**2 * (predicted_variance + variance)
    found = sums.seen & edges.ok & (edges.snr > thresholds.snr) & (edges.contrast > thresholds.contrast) & near
    variance = jnp.where(found, variance, 1.0)
    sensor = eqx.tree_at(lambda s: s.variances, sensor, variance)
    return Borders(jnp.where(found, columns + moved, columns), found, sensor, columns, sums.seen)
