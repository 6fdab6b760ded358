"""Kalman filters and smoothers parallel in time."""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc.beliefs.models import innovation
from jaxloc.beliefs.square_root import cholesky, product, triangularize, whiten
from jaxloc.filters.extended import ExtendedKalmanFilter
from jaxloc.filters.interface import GaussianState, History
from jaxloc.filters.kalman import GaussianFilter, KalmanFilter, noise_root, retract_root
from jaxloc.filters.parallel.associative_scan import Line, Linearized, filter_blocks, hold, smooth_blocks
from jaxloc.filters.smoothers import regression, reverse_step
from jaxloc.poses import carry, is_flat, local, retract


@filter_jit
def run_parallel(
    filt: KalmanFilter | ExtendedKalmanFilter,
    state: GaussianState,
    controls: Any,
    measurements: Any,
    valid: Bool[Array, "t *m"],
    *,
    active: Bool[Array, " t"] | None = None,
    iterations: int = 1,
    num_blocks: int = 32,
) -> tuple[GaussianState, History]:
    """The filter of a whole recording at once: what `run` gives for linear models.

    Nonlinear models are linearized along a nominal path: the prior mean predicted without measurements, and in further
    iterations the smoothed path, which is Gauss-Newton on the whole trajectory.

    Args:
        filt: a linear or extended Kalman filter; its gate, robust kernel and iterations are not used.
        state: the initial state.
        controls: stacked along the steps, or None.
        measurements: stacked along the steps.
        valid: mask of the measurements: one Boolean per step, or one for each tangent direction.
        active: mask of the steps; None for all.
        iterations: number of passes over the recording; 1 is enough for linear models.
        num_blocks: number of parallel blocks; about ten per processor core, as many as steps on an accelerator.

    Returns:
        The last state, and the `History` (of the last linearization).

    Raises:
        ValueError: if iterations or blocks are fewer than 1.

    References:
        Särkkä and García-Fernández 2021; Yaghoobi et al. 2022.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> eye = jnp.eye(1)
        >>> filt = jl.filters.KalmanFilter(jl.filters.LinearMotion(eye, eye), jl.filters.LinearSensor(eye, eye))
        >>> data = (filt.init(jl.beliefs.Gaussian(jnp.zeros(1), eye)), None, jnp.ones((5, 1)), jnp.ones(5, bool))
        >>> a, b = jl.filters.run(filt, *data), jl.filters.run_parallel(filt, *data, num_blocks=2)
        >>> bool(jnp.allclose(a[0].mean, b[0].mean, atol=1e-5))
        True
    """
    if iterations < 1 or num_blocks < 1:
        raise ValueError(f"A parallel run needs iterations and blocks; got {iterations} and {num_blocks}.")
    active = jnp.ones(valid.shape[:1], bool) if active is None else active
    controls = tree.finite_or_zero(controls)
    path = _nominal_path(filt, state, controls, active)
    num_blocks = min(num_blocks, active.shape[0])

    def linearized(path):
        prior = _tangent_at(jax.tree.map(lambda leaf: leaf[0], path), state)
        steps = _linearize(filt, path, controls, measurements, valid, active)
        return steps, prior, filter_blocks(steps, prior, num_blocks)

    def again(path, _):
        steps, prior, found = linearized(path)
        return _move_path(path, _tangent_smoothed(steps, prior, found[0], num_blocks)), (path, found)

    if iterations > 1:
        _, passes = lax.scan(again, path, length=iterations)
        path, (filtered, infos) = jax.tree.map(lambda leaf: leaf[-1], passes)
    else:
        filtered, infos = linearized(path)[2]
    numbers = state.step + jnp.cumsum(active, dtype=state.step.dtype)
    states = jax.vmap(_state)(jax.tree.map(lambda leaf: leaf[1:], path), filtered, numbers)
    return jax.tree.map(lambda leaf: leaf[-1], states), History(states, infos)


@filter_jit
def smooth_parallel(
    filt: GaussianFilter,
    history: History,
    controls: Any,
    *,
    active: Bool[Array, " t"] | None = None,
    num_blocks: int = 32,
) -> GaussianState:
    """The smoother of a whole recording at once: what `smooth` gives, for vectors exactly, for poses to first order.

    Args:
        filt: the filter of the run; any of the Kalman family.
        history: of the run, with whole states.
        controls: those of the run.
        active: that of the run.
        num_blocks: number of parallel blocks.

    Returns:
        Smoothed states, stacked along the steps.

    References:
        Särkkä and García-Fernández 2021, section 4.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> eye = jnp.eye(1)
        >>> filt = jl.filters.KalmanFilter(jl.filters.LinearMotion(eye, eye), jl.filters.LinearSensor(eye, eye))
        >>> start = filt.init(jl.beliefs.Gaussian(jnp.zeros(1), eye))
        >>> _, history = jl.filters.run(filt, start, None, jnp.array([[1.0], [2.0], [0.0]]), jnp.ones(3, bool))
        >>> a, b = jl.filters.smooth(filt, history, None), jl.filters.smooth_parallel(filt, history, None)
        >>> bool(jnp.allclose(a.mean, b.mean, atol=1e-5))
        True
    """
    states = history.states
    active = jnp.ones(states.step.shape[:1], bool) if active is None else active
    following = jax.tree.map(lambda leaf: leaf[1:], (states.mean, controls, active))

    def line(state, inputs):
        later, control, here = inputs
        step = reverse_step(filt, state, control)
        zero = jnp.zeros(state.covariance_sqrt.shape[:1], state.covariance_sqrt.dtype)
        gain = step.gain if is_flat(later) else product(step.gain, carry(later, zero, step.mean))
        return hold(Line(gain, product(step.gain, local(step.mean, later)), step.rest), here)

    lines = jax.vmap(line)(jax.tree.map(lambda leaf: leaf[:-1], states), following)
    last = jax.tree.map(lambda leaf: leaf[-1], states)
    end = (jnp.zeros_like(last.covariance_sqrt[0]), last.covariance_sqrt)
    deltas, roots = smooth_blocks(lines, end, num_blocks)
    mean, roots = jax.vmap(retract_root)(states.mean, deltas, roots)
    return jax.vmap(GaussianState)(mean, roots, states.step)


def _nominal_path(filt: Any, state: GaussianState, controls: Any, active: Bool[Array, " t"]) -> Any:
    """The prior mean predicted without measurements, including the first; any path serves linear models."""
    if isinstance(filt, KalmanFilter):
        return _broadcast(state.mean, active.shape[0] + 1)

    def advance(mean, inputs):
        control, here = inputs
        moved = tree.where(here, filt.motion.move(mean, control), mean)
        return moved, moved

    _, path = lax.scan(advance, state.mean, (controls, active))
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), state.mean, path)


def _linearize(filt: Any, path: Any, controls: Any, measurements: Any, valid: Any, active: Any) -> Linearized:
    motion, sensor = filt.motion, filt.sensor

    def one(before, after, control, measurement, valid_here, here):
        moved, gain = motion.linearize(before, control)
        noise = cholesky(motion.covariance(before, control))
        slip = local(moved, after)
        offset = -slip
        if not is_flat(before):
            # Linearized at the noise that leads along the path, so that iterations are Gauss-Newton steps.
            turn = jax.jacfwd(lambda e: local(after, retract(retract(moved, e), slip)))(jnp.zeros_like(slip))
            gain, noise = product(turn, gain), product(carry(moved, slip, after), noise)
        forward = hold(Line(gain, offset, noise), here)
        expected, matrix = sensor.linearize(after, measurement)
        residual, mask = innovation(expected, measurement, valid_here & here)
        sensed, mask = noise_root(sensor.covariance(after, measurement), mask & jnp.all(jnp.isfinite(matrix), axis=1))
        matrix, residual = jnp.where(mask[:, None], matrix, 0.0), jnp.where(mask, residual, 0.0)
        usable = jnp.isfinite(jnp.sum(whiten(sensed, lax.stop_gradient(residual)) ** 2))
        residual, mask = jnp.where(usable, residual, 0.0), mask & usable
        return Linearized(forward.gain, forward.offset, forward.root, matrix, residual, sensed, mask)

    ends = [jax.tree.map(lambda leaf, s=part: leaf[s], path) for part in (slice(None, -1), slice(1, None))]
    return jax.vmap(one)(*ends, controls, measurements, valid, active)


def _tangent_smoothed(
    steps: Linearized, prior: tuple[Array, Array], filtered: tuple[Array, Array], num_blocks: int
) -> Float[Array, "n d"]:
    """Smoothed tangents of linearized steps, including that of the initial state."""
    deltas, roots = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), prior, filtered)

    def line(delta, root, step):
        after = jnp.concatenate([product(step.gain, root), step.noise], axis=1)
        before = jnp.concatenate([root, jnp.zeros_like(step.noise)], axis=1)
        gain, rest = regression(triangularize(jnp.concatenate([after, before])))
        return Line(gain, delta - product(gain, product(step.gain, delta) + step.offset), rest)

    lines = jax.vmap(line)(deltas[:-1], roots[:-1], steps)
    return smooth_blocks(lines, (deltas[-1], roots[-1]), num_blocks)[0]


def _tangent_at(mean: Any, state: GaussianState) -> tuple[Array, Array]:
    """A state as a tangent at a nominal mean, with its root in that tangent space."""
    slip, root = local(state.mean, mean), state.covariance_sqrt
    return -slip, root if is_flat(mean) else product(carry(state.mean, slip, mean), root)


def _move_path(path: Any, deltas: Float[Array, "n d"]) -> Any:
    eye = jnp.eye(deltas.shape[1], dtype=deltas.dtype)
    return jax.vmap(lambda mean, delta: retract_root(mean, delta, eye)[0])(path, deltas)


def _state(mean: Any, tangent: tuple[Array, Array], step: Array) -> GaussianState:
    mean, root = retract_root(mean, *tangent)
    return GaussianState(mean, root, step)


def _broadcast(value: Any, count: int) -> Any:
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[None], (count, *leaf.shape)), value)
