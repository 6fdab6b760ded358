"""Simulated multi-target scenarios with clutter: the two on which PHD filters are commonly compared.

References:
    Vo and Ma, "The Gaussian mixture probability hypothesis density filter", IEEE TSP 2006. [T-74]
    B.-T. Vo, RFS tracking toolbox: `phd/gms`, `phd/ekf` and `phd/ukf`.
"""

import math
from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import Motion, Sensor
from jaxloc.beliefs.square_root import cholesky
from jaxloc.filters import CoordinatedTurn, LinearMotion, LinearSensor
from jaxloc.poses import SE2, SO2, retract
from jaxloc.poses.lie_group import as_floats
from jaxloc.sensors import RangeBearing
from jaxloc.sensors.landmarks import observe, polar_jacobian

_SCANS = 100
_LATER = 2**30  # a scan after all others

# First state (x, y, vx, vy), first and last scan, counted from 1.
_STRAIGHT = (
    ((0, 0, 0, -10), 1, 70),
    ((400, -600, -10, 5), 1, _LATER),
    ((-800, -200, 20, -5), 1, 70),
    ((400, -600, -7, -4), 20, _LATER),
    ((400, -600, -2.5, 10), 20, _LATER),
    ((0, 0, 7.5, -5), 20, _LATER),
    ((-800, -200, 12, 7), 40, _LATER),
    ((-200, 800, 15, -10), 40, _LATER),
    ((-800, -200, 3, 15), 60, _LATER),
    ((-200, 800, -3, -15), 60, _LATER),
    ((0, 0, -20, -15), 80, _LATER),
    ((-200, 800, 15, -5), 80, _LATER),
)
# The last entry is the turn rate, degrees/s.
_TURNING = (
    ((1003.8676, 1488.2543, -10, -10, 0.25), 1, _LATER),
    ((-255.8857, 1011.4102, 20, 3, -2 / 3), 10, _LATER),
    ((-1507.3806, 256.7993, 11, 10, -1), 10, _LATER),
    ((-1500, 250, 43, 0, 0), 10, 66),
    ((246.1324, 738.9253, 11, 5, 0.5), 20, 80),
    ((-242.6194, 993.2007, -12, -12, 1), 40, _LATER),
    ((1000, 1500, 0, -10, 0.5), 40, _LATER),
    ((250, 750, -50, 0, -0.5), 40, 80),
    ((1000, 1500, -50, 0, -0.5), 60, _LATER),
    ((250, 750, -40, 25, 0.5), 60, _LATER),
)


class TargetScenario(eqx.Module):
    """Multi-target scenario: motion, measurement, clutter, birth and death parameters.

    Scans are a second apart and counted from 1.

    Attributes:
        starts: "n d" states of the targets, a second before they are first seen.
        lifetimes: "n 2" first and last scan of each.
        survival: probability that a tracker should give a target to be there at the next scan (the truth is fixed).
        detection: probability that a target is measured in a scan.
        clutter_rate: expected number of false measurements in a scan.
        birth_weights: "b" expected number of targets born at each place in a scan.
        birth_means: "b d" places where they are born.
        birth_covariance: "d d" around each place.
        low: "2" lower ends of the measurement space.
        high: "2" upper ends.
        num_scans: how many.
        capacity: most measurements in a scan.
    """

    starts: eqx.AbstractVar[Float[Array, "n d"]]
    lifetimes: eqx.AbstractVar[Int[Array, "n 2"]]
    survival: eqx.AbstractVar[Float[Array, ""]]
    detection: eqx.AbstractVar[Float[Array, ""]]
    clutter_rate: eqx.AbstractVar[Float[Array, ""]]
    birth_weights: eqx.AbstractVar[Float[Array, " b"]]
    birth_means: eqx.AbstractVar[Float[Array, "b d"]]
    birth_covariance: eqx.AbstractVar[Float[Array, "d d"]]
    low: eqx.AbstractVar[Float[Array, "2"]]
    high: eqx.AbstractVar[Float[Array, "2"]]
    num_scans: eqx.AbstractVar[int]
    capacity: eqx.AbstractVar[int]

    @property
    def clutter_volume(self) -> Float[Array, ""]:
        """Of the measurement space, in which clutter is uniform."""
        return jnp.prod(self.high - self.low)

    @property
    @abstractmethod
    def motion(self) -> Motion:
        """How a tracker should expect targets to move; the control is not used."""

    @property
    @abstractmethod
    def sensor(self) -> Sensor:
        """What is measured of a target."""

    @abstractmethod
    def reading(self, values: Float[Array, "2"]) -> Any:
        """The measurement with two coordinates of the measurement space."""


class LinearScenario(TargetScenario):
    """Twelve targets on straight lines in a square of 2 km, whose positions are measured; states are (x, y, vx, vy).

    Args:
        clutter_rate: expected number of false measurements in a scan.
        acceleration: standard deviation that a tracker should expect, m/s^2.
        deviation: of a measured coordinate, m.

    Example:
        >>> import jaxloc as jl
        >>> scenario = jl.data.simulate.targets.LinearScenario(clutter_rate=10.0)
        >>> float(scenario.clutter_volume), scenario.sensor.noise_covariance.tolist()
        (4000000.0, [[100.0, 0.0], [0.0, 100.0]])
    """

    starts: Float[Array, "n 4"]
    lifetimes: Int[Array, "n 2"]
    survival: Float[Array, ""]
    detection: Float[Array, ""]
    clutter_rate: Float[Array, ""]
    birth_weights: Float[Array, " b"]
    birth_means: Float[Array, "b 4"]
    birth_covariance: Float[Array, "4 4"]
    low: Float[Array, "2"]
    high: Float[Array, "2"]
    acceleration: Float[Array, ""]
    deviation: Float[Array, ""]
    num_scans: int = eqx.field(static=True)
    capacity: int = eqx.field(static=True)

    def __init__(self, clutter_rate: float = 60.0, *, acceleration: float = 5.0, deviation: float = 10.0):
        self.starts, self.lifetimes = _life(_STRAIGHT)
        self.survival, self.detection, self.clutter_rate = as_floats(0.99, 0.98, clutter_rate)
        places = jnp.array([[0.0, 0.0], [400.0, -600.0], [-800.0, -200.0], [-200.0, 800.0]])
        self.birth_means = jnp.pad(places, ((0, 0), (0, 2)))
        self.birth_weights = jnp.full((4,), 0.03, places.dtype)
        self.birth_covariance = 100.0 * jnp.eye(4, dtype=places.dtype)
        self.high = jnp.full((2,), 1000.0, places.dtype)
        self.low = -self.high
        self.acceleration, self.deviation = as_floats(acceleration, deviation)
        self.num_scans, self.capacity = _SCANS, _capacity(len(_STRAIGHT), clutter_rate)

    @property
    def motion(self) -> LinearMotion:
        """Constant velocity, with an acceleration that is constant during each second."""
        half = jnp.kron(jnp.array([0.5, 1.0], self.starts.dtype), jnp.eye(2, dtype=self.starts.dtype)).reshape(2, 2, 2)
        gain = self.acceleration * half.swapaxes(0, 1).reshape(4, 2)
        eye = jnp.eye(4, dtype=self.starts.dtype)
        return LinearMotion(eye + jnp.eye(4, k=2, dtype=self.starts.dtype), matmul(gain, gain.T))

    @property
    def sensor(self) -> LinearSensor:
        """The position."""
        eye = jnp.eye(2, 4, dtype=self.starts.dtype)
        return LinearSensor(eye, self.deviation**2 * jnp.eye(2, dtype=self.starts.dtype))

    def reading(self, values: Float[Array, "2"]) -> Float[Array, "2"]:
        """The position itself."""
        return values


class TurningScenario(TargetScenario):
    """Ten targets that turn, seen from the origin by range and bearing; states are (x, y, vx, vy, turn rate).

    The sensor sees the half plane y > 0 up to 2 km. Measurements are `RangeBearing` of landmark 0, whose bearings are
    counted from the x axis.

    Args:
        clutter_rate: expected number of false measurements in a scan.
        acceleration: standard deviation that a tracker should expect, m/s^2.
        turn_acceleration: standard deviation that a tracker should expect of the turn rate's change, rad/s^2.
        range_deviation: of a measured range, m.
        bearing_deviation: of a measured bearing, rad.

    Example:
        >>> import jaxloc as jl
        >>> scenario = jl.data.simulate.targets.TurningScenario()
        >>> round(float(scenario.clutter_volume), 1), scenario.starts.shape
        (6283.2, (10, 5))
    """

    starts: Float[Array, "n 5"]
    lifetimes: Int[Array, "n 2"]
    survival: Float[Array, ""]
    detection: Float[Array, ""]
    clutter_rate: Float[Array, ""]
    birth_weights: Float[Array, " b"]
    birth_means: Float[Array, "b 5"]
    birth_covariance: Float[Array, "5 5"]
    low: Float[Array, "2"]
    high: Float[Array, "2"]
    acceleration: Float[Array, ""]
    turn_acceleration: Float[Array, ""]
    deviations: Float[Array, "2"]
    num_scans: int = eqx.field(static=True)
    capacity: int = eqx.field(static=True)

    def __init__(
        self,
        clutter_rate: float = 20.0,
        *,
        acceleration: float = 5.0,
        turn_acceleration: float = math.radians(1.0),
        range_deviation: float = 10.0,
        bearing_deviation: float = math.radians(2.0),
    ):
        starts, self.lifetimes = _life(_TURNING)
        self.starts = starts.at[:, 4].multiply(math.pi / 180.0)
        self.survival, self.detection, self.clutter_rate = as_floats(0.99, 0.98, clutter_rate)
        places = jnp.array([[-1500.0, 250.0], [-250.0, 1000.0], [250.0, 750.0], [1000.0, 1500.0]])
        self.birth_means = jnp.pad(places, ((0, 0), (0, 3)))
        self.birth_weights = jnp.array([0.02, 0.02, 0.03, 0.03])
        self.birth_covariance = jnp.diag(jnp.array([50.0, 50.0, 50.0, 50.0, math.radians(6.0)]) ** 2)
        self.low, self.high = jnp.array([0.0, 0.0]), jnp.array([2000.0, math.pi])
        self.acceleration, self.turn_acceleration = as_floats(acceleration, turn_acceleration)
        self.deviations = jnp.array([range_deviation, bearing_deviation])
        self.num_scans, self.capacity = _SCANS, _capacity(len(_TURNING), clutter_rate)

    @property
    def motion(self) -> "SampledTurn":
        """A turn, with accelerations that are constant during each second."""
        return SampledTurn(self.acceleration, self.turn_acceleration)

    @property
    def sensor(self) -> "PositionSensor":
        """Range and bearing of the target."""
        return PositionSensor(self.deviations)

    def reading(self, values: Float[Array, "2"]) -> RangeBearing:
        """Of a range and a bearing."""
        return RangeBearing(values[0], SO2.from_angle(values[1]), jnp.zeros((), jnp.int32))


class SampledTurn(Motion):
    """A `CoordinatedTurn` in steps of one second, whose noise is an acceleration that is constant during each.

    Attributes:
        acceleration: standard deviation, m/s^2.
        turn_acceleration: standard deviation, rad/s^2.
    """

    acceleration: Float[Array, ""]
    turn_acceleration: Float[Array, ""]

    def move(self, state: Float[Array, "5"], control: Any) -> Float[Array, "5"]:
        """The state a second later."""
        del control
        return CoordinatedTurn(0.0, 0.0).move(state, jnp.ones((), state.dtype))

    def covariance(self, state: Float[Array, "5"], control: Any) -> Float[Array, "5 5"]:
        """Of the noise that gathers in a second."""
        del state, control
        axis = jnp.array([[0.25, 0.5], [0.5, 1.0]], self.acceleration.dtype) * self.acceleration**2
        plane = axis[:, None, :, None] * jnp.eye(2, dtype=axis.dtype)[None, :, None, :]
        return jnp.pad(plane.reshape(4, 4), (0, 1)).at[4, 4].set(self.turn_acceleration**2)


class PositionSensor(Sensor):
    """Range and bearing from the origin to a state that begins with its position in the plane.

    Attributes:
        deviations: standard deviations of range (m) and bearing (rad).
    """

    deviations: Float[Array, "2"]

    def expect(self, state: Float[Array, " d"], measurement: RangeBearing) -> RangeBearing:
        """Range and bearing of the position."""
        return observe(SE2.identity(state.dtype), state[:2], measurement.landmark)

    def covariance(self, state: Float[Array, " d"], measurement: RangeBearing) -> Float[Array, "2 2"]:
        """Of (range, bearing)."""
        del state, measurement
        return jnp.diag(self.deviations**2)

    def linearize(
        self, state: Float[Array, " d"], measurement: RangeBearing
    ) -> tuple[RangeBearing, Float[Array, "2 d"]]:
        """The expected reading and its Jacobian."""
        expected = self.expect(state, measurement)
        return expected, jnp.pad(polar_jacobian(expected), ((0, 0), (0, state.shape[0] - 2)))


class TargetDrive(eqx.Module):
    """A simulated scenario.

    Attributes:
        truth: "t n d" states of the targets at each scan; the first state where there is no target.
        truth_valid: which targets are there.
        measurements: of each scan, stacked "t m"; targets and clutter in random order, those that count first.
        valid: which measurements there are.
        sources: which target each is of; -1 for clutter.
    """

    truth: Float[Array, "t n d"]
    truth_valid: Bool[Array, "t n"]
    measurements: Any
    valid: Bool[Array, "t m"]
    sources: Int[Array, "t m"]


@filter_jit
def simulate_targets(scenario: TargetScenario, *, key: Key[Array, ""]) -> TargetDrive:
    """Simulates targets with noisy measurements, missed detections and uniform clutter.

    Args:
        scenario: what is there.
        key: random key.

    Returns:
        The drive. False measurements beyond the scenario's capacity are left out (six sigmas above the rate).

    Example:
        >>> import jax, jaxloc as jl
        >>> scenario = jl.data.simulate.targets.LinearScenario(clutter_rate=10.0)
        >>> drive = jl.data.simulate.targets.simulate_targets(scenario, key=jax.random.key(0))
        >>> drive.truth.shape, drive.measurements.shape, drive.truth_valid.sum(axis=1)[jnp.array([0, 99])].tolist()
        ((100, 12, 4), (100, 45, 2), [3, 10])
    """
    truth, there = _true_states(scenario)
    keys = jax.random.split(key, scenario.num_scans)
    scans = jax.vmap(lambda states, present, k: _scan(scenario, states, present, k))(truth, there, keys)
    return TargetDrive(truth, there, *scans)


def _true_states(scenario: TargetScenario) -> tuple[Float[Array, "t n d"], Bool[Array, "t n"]]:
    first, last = scenario.lifetimes[:, 0], scenario.lifetimes[:, 1]
    motion = scenario.motion

    def step(states, scan):
        there = (first <= scan) & (scan <= last)
        moved = jax.vmap(lambda state: motion.move(state, None))(states)
        states = jnp.where(there[:, None], moved, scenario.starts)
        return states, (states, there)

    scans = jnp.arange(1, scenario.num_scans + 1, dtype=first.dtype)
    return jax.lax.scan(step, scenario.starts, scans)[1]


def _scan(
    scenario: TargetScenario, states: Float[Array, "n d"], present: Bool[Array, " n"], key: Key[Array, ""]
) -> tuple[Any, Bool[Array, " m"], Int[Array, " m"]]:
    """Measurements of one scan: those of targets first, then clutter, then mixed."""
    key_seen, key_noise, key_count, key_place, key_order = jax.random.split(key, 5)
    count, room = states.shape[0], scenario.capacity - states.shape[0]
    dtype, sensor = states.dtype, scenario.sensor
    example = scenario.reading(scenario.low)

    def measure(state, normal):
        return retract(sensor.expect(state, example), matmul(cholesky(sensor.covariance(state, example)), normal))

    seen = present & (jax.random.uniform(key_seen, (count,), dtype) < scenario.detection)
    found = jax.vmap(measure)(states, jax.random.normal(key_noise, (count, 2), dtype))
    places = jax.random.uniform(key_place, (room, 2), dtype)
    false = jax.vmap(lambda place: scenario.reading(scenario.low + place * (scenario.high - scenario.low)))(places)
    there = jnp.arange(room, dtype=jnp.int32) < jax.random.poisson(key_count, scenario.clutter_rate, dtype=jnp.int32)

    valid = jnp.concatenate([seen, there])
    order = jnp.argsort(jax.random.uniform(key_order, valid.shape, dtype) + (~valid).astype(dtype))
    mixed = jax.tree.map(lambda a, b: jnp.concatenate([a, b])[order], found, false)
    sources = jnp.pad(jnp.arange(count, dtype=jnp.int32), (0, room), constant_values=-1)[order]
    return mixed, valid[order], jnp.where(valid[order], sources, -1)


def _life(table: tuple) -> tuple[Float[Array, "n d"], Int[Array, "n 2"]]:
    starts = jnp.array([[float(x) for x in start] for start, _, _ in table])
    return starts, jnp.array([(first, last) for _, first, last in table], jnp.int32)


def _capacity(targets: int, rate: float) -> int:
    """Measurements of a scan, but in one of a billion."""
    return targets + math.ceil(rate + 6.0 * math.sqrt(rate)) + 4
