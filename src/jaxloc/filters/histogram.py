"""Histogram (grid) filter: the Bayes filter on a grid of cells, for small state spaces and as a reference."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc._linalg import matmul
from jaxloc.beliefs import Gaussian, Motion, Sensor, validity
from jaxloc.beliefs.models import innovation
from jaxloc.filters.interface import Filter, FilterState, Info
from jaxloc.filters.unscented import intrinsic_mean
from jaxloc.poses import SE2


class Cells(eqx.Module):
    """Cells that tile a region of the state space.

    Attributes:
        points: centers, stacked along a leading axis; vectors, poses, or any pytree of them.
        volume: of one cell, in the units of the tangent.
    """

    points: Any
    volume: Float[Array, ""]

    @property
    def count(self) -> int:
        """Number of cells."""
        return jax.tree.leaves(self.points)[0].shape[0]


class HistogramState(FilterState):
    """State of the grid filter.

    Attributes:
        cells: the grid.
        mass: probability of each cell; sums to one.
        step: number of predictions so far.
    """

    cells: Cells
    mass: Float[Array, " n"]
    step: Int[Array, ""]

    @property
    def density(self) -> Float[Array, " n"]:
        """Probability density at the centers."""
        return self.mass / self.cells.volume

    def gaussian(self) -> Gaussian:
        """Mean (intrinsic for poses) and covariance of the mass."""
        mean, deviations = intrinsic_mean(self.cells.points, self.mass)
        return Gaussian(mean, matmul(deviations.T, self.mass[:, None] * deviations))


class HistogramInfo(Info):
    """Diagnostics of an update of the grid filter.

    Attributes:
        log_likelihood: of the measurement given all earlier ones; zero where there is none.
        ok: whether any cell has a positive likelihood.
        entropy: of the mass after the update, nats.
    """

    log_likelihood: Float[Array, ""]
    ok: Bool[Array, ""]
    entropy: Float[Array, ""]


class HistogramFilter(Filter):
    """The Bayes filter with the transition density between all pairs of cells, and the likelihood in each.

    A prediction costs the square of the number of cells: use at most some thousands. Transition densities are
    normalized over the cells, so that no mass leaves the region.

    Args:
        motion: motion model; the standard deviation of its noise must be at least the size of a cell.
        sensor: sensor model.

    References:
        Review section 3, eqs. 1-5 [R-1, R-2, R-3, R-4]; Thesis eqs. 1.1, 1.2 and Fig. 2.17 [T-1, T-3, T-55].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> eye = jnp.eye(1)
        >>> filt = jl.filters.HistogramFilter(jl.filters.LinearMotion(eye, eye), jl.filters.LinearSensor(eye, eye))
        >>> cells = jl.filters.histogram.box((-9.0,), (9.0,), (61,))
        >>> state = filt.init_gaussian(cells, jl.beliefs.Gaussian(jnp.zeros(1), eye))
        >>> state, info = filt.update(filt.predict(state, None), jnp.array([3.0]), jnp.array(True))
        >>> round(float(state.gaussian().mean[0]), 2)  # the Kalman filter says 2
        2.0
    """

    motion: Motion
    sensor: Sensor

    def init(self, prior: Cells) -> HistogramState:
        """The uniform initial state over the cells."""
        mass = jnp.full(prior.count, 1.0 / prior.count, prior.volume.dtype)
        return HistogramState(prior, mass, jnp.zeros((), jnp.int32))

    def init_gaussian(self, cells: Cells, prior: Gaussian) -> HistogramState:
        """The initial state of a prior density."""
        mass = jax.nn.softmax(jax.vmap(prior.log_prob)(cells.points))
        return HistogramState(cells, mass, jnp.zeros((), jnp.int32))

    def predict(self, state: HistogramState, control: Any, *, key: Key[Array, ""] | None = None) -> HistogramState:
        """The state one step ahead: mass moves between cells by the transition density."""
        del key
        points, control = state.cells.points, validity.finite_or_neutral(control)

        def transition(point):
            shares = jax.vmap(lambda target: self.motion.log_prob(point, control, target))(points)
            return jax.nn.softmax(jnp.where(jnp.isfinite(shares), shares, -jnp.inf), where=jnp.isfinite(shares))

        mass = matmul(state.mass, jax.vmap(transition)(points))
        mass = mass / jnp.sum(mass)
        ok = jnp.isfinite(jnp.sum(mass))
        return HistogramState(state.cells, jnp.where(ok, mass, state.mass), state.step + 1)

    def update(
        self, state: HistogramState, measurement: Any, valid: Bool[Array, "*m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[HistogramState, HistogramInfo]:
        """The state updated by a measurement."""
        del key
        scores = jax.vmap(lambda point: self.sensor.log_prob(point, measurement, valid))(state.cells.points)
        fits = jnp.isfinite(scores) & (state.mass > 0.0)
        safe_mass = jnp.where(fits, state.mass, 1.0)
        joint = jnp.where(fits, jnp.where(fits, scores, 0.0) + jnp.log(safe_mass), -jnp.inf)
        ok = jnp.any(fits)
        likelihood = jax.nn.logsumexp(jnp.where(ok, joint, 0.0))
        mass = jnp.where(ok, jnp.exp(jnp.where(fits, joint - likelihood, -jnp.inf)), state.mass)
        seen = jnp.any(self._mask(state, measurement, valid))
        after = tree.where(seen, HistogramState(state.cells, mass, state.step), state)
        entropy = -jnp.sum(
            jnp.where(after.mass > 0.0, after.mass * jnp.log(jnp.where(after.mass > 0.0, after.mass, 1.0)), 0.0)
        )
        return after, HistogramInfo(jnp.where(ok & seen, likelihood, 0.0), ok, entropy)

    def _mask(self, state: HistogramState, measurement: Any, valid: Bool[Array, "*m"]) -> Bool[Array, " m"]:
        """Mask of the valid directions of the measurement, at the first cell."""
        first = jax.tree.map(lambda leaf: leaf[0], state.cells.points)
        return innovation(self.sensor.expect(first, measurement), measurement, valid)[1]


def box(lower: tuple[float, ...], upper: tuple[float, ...], shape: tuple[int, ...], dtype: Any = float) -> Cells:
    """Cells that tile a box of vectors.

    Args:
        lower: corner.
        upper: the opposite corner.
        shape: number of cells along each axis.
        dtype: of the points.

    Returns:
        The cells, the last axis running fastest.

    Raises:
        ValueError: if the corners and the shape differ in length, or the box is empty.

    Example:
        >>> import jaxloc as jl
        >>> cells = jl.filters.histogram.box((0.0, 0.0), (2.0, 1.0), (2, 1))
        >>> cells.points.tolist(), float(cells.volume)
        ([[0.5, 0.5], [1.5, 0.5]], 1.0)
    """
    if not len(lower) == len(upper) == len(shape):
        raise ValueError(
            f"A box needs corners and a shape of equal length; got {len(lower)}, {len(upper)}, {len(shape)}."
        )
    sides = (np.asarray(upper) - np.asarray(lower)) / np.asarray(shape)
    if np.any(sides <= 0.0):
        raise ValueError(f"The box from {lower} to {upper} is empty.")
    axes = [low + side * (np.arange(n) + 0.5) for low, side, n in zip(lower, sides, shape, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(shape))
    return Cells(jnp.asarray(points, dtype), jnp.asarray(np.prod(sides), dtype))


def plane(
    lower: tuple[float, float], upper: tuple[float, float], shape: tuple[int, int, int], dtype: Any = float
) -> Cells:
    """Cells of planar poses: a rectangle of positions, with all headings.

    Args:
        lower: corner, m.
        upper: the opposite corner, m.
        shape: number of cells along x, y and heading.
        dtype: of the poses.

    Returns:
        The cells, headings running fastest.

    Example:
        >>> import jaxloc as jl
        >>> jl.filters.histogram.plane((0.0, 0.0), (4.0, 2.0), (4, 2, 36)).count
        288
    """
    flat = box((*lower, -np.pi), (*upper, np.pi), shape, dtype)
    return Cells(jax.vmap(SE2)(*flat.points.T), flat.volume)
