"""Square-root information filter: the Kalman filter in information form, for priors without information."""

import math
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _linalg
from jaxloc import _tree as tree
from jaxloc._linalg import matmul
from jaxloc.beliefs import Gaussian, Motion, Sensor, validity
from jaxloc.beliefs.models import innovation
from jaxloc.beliefs.square_root import cholesky, solve, triangularize, whiten
from jaxloc.filters.interface import Filter, FilterState, GaussianState, Info, conclude
from jaxloc.filters.kalman import noise_root, process_root

_LARGEST_ROUNDING = 10.0  # of a whitened measurement, in sigmas


class InformationState(FilterState):
    """State of the information filter: equations ``L^T x = b + e`` of a vector x with unit noise e.

    Attributes:
        information_sqrt: lower triangular L; ``L L^T`` is the information matrix.
        target: b.
        step: number of predictions so far.
    """

    information_sqrt: Float[Array, "d d"]
    target: Float[Array, " d"]
    step: Int[Array, ""]

    @property
    def information(self) -> Float[Array, "d d"]:
        """The information matrix, the inverse of the covariance."""
        return matmul(self.information_sqrt, self.information_sqrt.mT)

    @property
    def determined(self) -> Bool[Array, ""]:
        """Whether the information matrix has full rank, so that there is a mean and a covariance."""
        return jnp.all(_known(self.information_sqrt))

    @property
    def mean(self) -> Float[Array, " d"]:
        """Mean of the vector; zero along directions without information."""
        return _back(self.information_sqrt, self.target)

    def gaussian(self) -> Gaussian:
        """The state as a density; its covariance is meaningful only where `determined`."""
        root = _inverse(self.information_sqrt)
        return Gaussian(self.mean, matmul(root.T, root))


class InformationInfo(Info):
    """Diagnostics of an update of the information filter.

    Attributes:
        log_likelihood: of the measurement given all earlier ones; zero while the state is not determined, since
            it then has no density.
        ok: whether the state can be used.
        nis: normalized innovation squared, chi-square with `dof` degrees of freedom.
        dof: number of valid directions, less those that increased the rank of the information matrix.
    """

    log_likelihood: Float[Array, ""]
    ok: Bool[Array, ""]
    nis: Float[Array, ""]
    dof: Int[Array, ""]


class InformationFilter(Filter):
    """The square-root information filter of linear models; equal to `KalmanFilter`, but allows zero prior information.

    Predictions and updates stack whitened equations and triangularize them. Only the transition matrix is inverted.

    Args:
        motion: linear motion of a vector, with an invertible transition matrix.
        sensor: linear sensor.

    References:
        Bierman, *Factorization Methods for Discrete Sequential Estimation*, 1977, chapters V and VI; Thesis 2.4.1
        [T-56].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> eye = jnp.eye(2)
        >>> filt = jl.filters.InformationFilter(jl.filters.LinearMotion(eye, eye), jl.filters.LinearSensor(eye, eye))
        >>> state = filt.predict(filt.init_uninformative(2), None)
        >>> state, info = filt.update(state, jnp.array([3.0, 4.0]), jnp.array(True))
        >>> [round(float(number), 3) for number in state.mean], bool(state.determined), float(info.nis)
        ([3.0, 4.0], True, 0.0)
    """

    motion: Motion
    sensor: Sensor

    def init(self, prior: Gaussian | GaussianState) -> InformationState:
        """The initial state of a prior density of a vector.

        Where the prior is no density, the state holds no information, and its updates are not ``ok``.
        """
        mean, covariance = validity.usable_or_unknown(prior.mean, prior.covariance)
        ok, state = tree.protect(_of_density, mean, covariance)
        ok = ok & validity.usable(prior.mean, prior.covariance)
        beyond = jnp.full_like(mean, 1.01 * tree.largest(mean.dtype))
        return tree.where(ok, state, InformationState(jnp.zeros_like(covariance), beyond, state.step))

    def init_uninformative(self, size: int, dtype: Any = float) -> InformationState:
        """The initial state of a vector without any prior information."""
        return InformationState(jnp.zeros((size, size), dtype), jnp.zeros(size, dtype), jnp.zeros((), jnp.int32))

    def predict(self, state: InformationState, control: Any, *, key: Key[Array, ""] | None = None) -> InformationState:
        """The state one step ahead; non-finite entries of the control count as zero."""
        del key
        ok, after = tree.protect(_moved, self, state, validity.finite_or_neutral(control))
        return tree.where(ok, after, InformationState(state.information_sqrt, state.target, state.step + 1))

    def move(self, state: InformationState, control: Any) -> InformationState:
        """`predict` without protection from non-finite numbers, which `predict` adds."""
        mean = state.mean
        moved, transition = self.motion.linearize(mean, control)
        noise = process_root(self.motion.covariance(mean, control))
        size = mean.shape[0]
        # With x = F^-1 (x' - shift - noise w): equations in (w, x'), of which w is eliminated.
        shift = moved - matmul(transition, mean)
        rows = _linalg.solve(transition.T, state.information_sqrt).T
        eye, zero = jnp.eye(size, dtype=mean.dtype), jnp.zeros((size, size), mean.dtype)
        left = jnp.block([[eye, zero], [-matmul(rows, noise), rows]])
        right = jnp.concatenate([jnp.zeros_like(mean), state.target + matmul(rows, shift)])
        root = triangularize(jnp.concatenate([left, right[:, None]], axis=1).T)
        block = slice(size, 2 * size)
        return InformationState(root[block, block], root[2 * size, block], state.step + 1)

    def update(
        self, state: InformationState, measurement: Any, valid: Bool[Array, "*m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[InformationState, InformationInfo]:
        """The state updated by a measurement; not ``ok`` where noise is so small that only rounding is left of it."""
        del key
        ok, (after, info) = tree.protect(_updated, self, state, measurement, valid)
        return conclude(ok, after, info, state)

    def correct_by(
        self, state: InformationState, measurement: Any, valid: Bool[Array, "*m"]
    ) -> tuple[InformationState, InformationInfo]:
        """`update` without protection from non-finite numbers, which `update` adds."""
        mean = state.mean
        expected, matrix = self.sensor.linearize(mean, measurement)
        residual, mask = innovation(expected, measurement, valid)
        mask = mask & jnp.all(jnp.isfinite(matrix), axis=1)
        noise, mask = noise_root(self.sensor.covariance(mean, measurement), mask)
        matrix = whiten(noise, jnp.where(mask[:, None], matrix, 0.0))
        target = whiten(noise, jnp.where(mask, residual, 0.0)) + matmul(matrix, mean)
        rounding = float(jnp.finfo(target.dtype).eps) * jnp.max(jnp.abs(lax.stop_gradient(target)), initial=0.0)
        usable = rounding < _LARGEST_ROUNDING
        matrix, target = jnp.where(usable, matrix, 0.0), jnp.where(usable, target, 0.0)
        rows = jnp.concatenate([state.information_sqrt.T, matrix])
        after, misfit = _reduce(rows, jnp.concatenate([state.target, target]), state.step)
        ok = usable & tree.all_finite(after)
        info = self._info(state, after, misfit, noise, jnp.sum(mask), ok)
        return tree.where(ok & jnp.any(mask), after, state), info

    def _info(
        self, before: InformationState, after: InformationState, misfit: Array, noise: Array, seen: Array, ok: Array
    ) -> InformationInfo:
        gained = jnp.sum(_known(after.information_sqrt)) - jnp.sum(_known(before.information_sqrt))
        nis = jnp.where(ok, misfit**2, 0.0)
        volume = _log_volume(after.information_sqrt) - _log_volume(before.information_sqrt)
        volume = volume + jnp.sum(jnp.log(jnp.diagonal(noise)))
        likelihood = -0.5 * nis - volume - 0.5 * math.log(2.0 * math.pi) * seen.astype(nis.dtype)
        counts = ok & before.determined & (seen > 0)
        return InformationInfo(jnp.where(counts, likelihood, 0.0), ok, nis, seen - gained)


def _of_density(mean: Array, covariance: Array) -> tuple[Bool[Array, ""], InformationState]:
    # S^-1 is lower triangular; the equations S^-1 x = S^-1 m are brought to triangular form.
    inverse = _inverse(cholesky(covariance))
    state = _reduce(inverse, matmul(inverse, mean), jnp.zeros((), jnp.int32))[0]
    return tree.within_range(state.target) & tree.all_finite((state, state.mean)), state


def _moved(filt: InformationFilter, state: InformationState, control: Any) -> tuple[Bool[Array, ""], InformationState]:
    after = filt.move(state, control)
    return tree.within_range((state.target, after.target)) & tree.all_finite(after), after


def _updated(
    filt: InformationFilter, state: InformationState, measurement: Any, valid: Bool[Array, "*m"]
) -> tuple[Bool[Array, ""], tuple[InformationState, InformationInfo]]:
    after, info = filt.correct_by(state, measurement, valid)
    return info.ok & tree.within_range(state.target), (after, info)


def _reduce(rows: Float[Array, "k d"], target: Float[Array, " k"], step: Array) -> tuple[InformationState, Array]:
    """Equations ``rows x = target`` in triangular form, and the norm of their residual."""
    size = rows.shape[1]
    root = triangularize(jnp.concatenate([rows, target[:, None]], axis=1).T)
    return InformationState(root[:size, :size], root[size, :size], step), root[size, size]


def _known(root: Float[Array, "d d"]) -> Bool[Array, " d"]:
    """Which pivots are above rounding level."""
    floor = 8.0 * float(jnp.finfo(root.dtype).eps) * jnp.sqrt(jnp.sum(lax.stop_gradient(root) ** 2, axis=1))
    return jnp.diagonal(root) > floor


def _safe(root: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """A root with unit, uncorrelated pivots in directions without information."""
    known = _known(root)
    return jnp.where(known[:, None] & known[None, :], root, jnp.eye(root.shape[0], dtype=root.dtype))


def _back(root: Float[Array, "d d"], target: Float[Array, " d"]) -> Float[Array, " d"]:
    """Solves ``L^T x = b``; zero along directions without information."""
    safe = _safe(root)
    wanted = jnp.where(_known(root), target, 0.0)
    return solve(safe, matmul(safe, wanted))


def _inverse(root: Float[Array, "d d"]) -> Float[Array, "d d"]:
    safe = _safe(root)
    return whiten(safe, jnp.eye(root.shape[0], dtype=root.dtype))


def _log_volume(root: Float[Array, "d d"]) -> Float[Array, ""]:
    return jnp.sum(jnp.log(jnp.where(_known(root), jnp.diagonal(root), 1.0)))
