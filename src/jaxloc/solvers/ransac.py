"""RANSAC: random sample consensus with the MSAC score, all hypotheses in one batch."""

import functools
from collections.abc import Callable
from math import ceil, log
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc._jit import filter_jit
from jaxloc._tree import detach_unless
from jaxloc.beliefs import Gaussian
from jaxloc.beliefs.validity import positive
from jaxloc.solvers.estimate import Estimate


class Candidates(eqx.Module):
    """Several models of one sample (P3P has up to four), for a ``fit`` that may return them.

    Attributes:
        models: models stacked along a leading axis.
        valid: which of them are solutions.
    """

    models: Any
    valid: Bool[Array, " m"]


class Consensus(eqx.Module):
    """Result of RANSAC: the model with the lowest MSAC cost.

    Attributes:
        model: the model; that of an arbitrary sample where not ok.
        inliers: items within the threshold of it.
        score: MSAC cost, ``sum min(r^2 / t^2, 1)`` over valid items: 0 is perfect.
        ok: whether any model has more inliers than a sample has items.
    """

    model: Any
    inliers: Bool[Array, " n"]
    score: Float[Array, ""]
    ok: Bool[Array, ""]


class RobustEstimate(eqx.Module):
    """An estimate from data with outliers, and its inliers.

    The fields of `Estimate` can be read from the record itself (stacked ones from a stacked record).

    Attributes:
        estimate: value, covariance and whether they can be used.
        inliers: items of the given data that agree with the value.
    """

    estimate: Estimate
    inliers: Bool[Array, " n"]

    @property
    def value(self) -> Any:
        """The estimate's value."""
        return self.estimate.value

    @property
    def covariance(self) -> Array:
        """Covariance in the tangent space of the value."""
        return self.estimate.covariance

    @property
    def cost(self) -> Array:
        """The objective at the value."""
        return self.estimate.cost

    @property
    def ok(self) -> Array:
        """Whether value and covariance can be used."""
        return self.estimate.ok

    @property
    def num_steps(self) -> Array:
        """Solver steps taken."""
        return self.estimate.num_steps

    @property
    def status(self) -> Array:
        """A `Status` code."""
        return self.estimate.status

    @property
    def information(self) -> Array:
        """The Gauss-Newton Hessian at the value."""
        return self.estimate.information

    def gaussian(self) -> Gaussian:
        """The estimate as a density."""
        return self.estimate.gaussian()

    def describe(self) -> str:
        """One line of text: status, steps and cost (host only, one estimate)."""
        return self.estimate.describe()

    def check(self) -> "RobustEstimate":
        """The estimate itself, if ok (host only).

        Raises:
            ValueError: if not; the message gives the status.
        """
        self.estimate.check()
        return self


@filter_jit
def ransac(
    data: Any,
    fit: Callable[[Any], Any],
    residual: Callable[[Any, Any], Float[Array, " n"]],
    *,
    sample_size: int,
    threshold: Any,
    hypotheses: int,
    key: Key[Array, ""],
    valid: Bool[Array, " n"] | None = None,
) -> Consensus:
    """Random sample consensus with the MSAC score; every hypothesis is fitted and scored in one batch.

    The number of hypotheses is fixed (see `required_hypotheses`), without early termination. Refining the model on its
    inliers is left to the caller: a weighted or robust `solve` from this model, which also gives derivatives and a
    covariance.

    Args:
        data: pytree whose arrays have a leading axis over n items.
        fit: model of a sample (``data`` with a leading axis of sample_size), or `Candidates`. Define it at module
            level, or give it parameters by ``jax.tree_util.Partial``: a fresh lambda is compiled at every call.
        residual: distance of each item of ``data`` from a model.
        sample_size: items in a sample.
        threshold: distance at which an item becomes an outlier, in the residual's unit; positive.
        hypotheses: number of samples, static.
        key: random key.
        valid: which items may be drawn and count; non-finite ones never do.

    Returns:
        The best model, its inliers and score.

    References:
        Fischler and Bolles, CACM 1981 [K-60, K-61]; Torr and Zisserman, "MLESAC", CVIU 2000 (the score).

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> def line(sample):
        ...     rise = sample[1, 1] - sample[0, 1]
        ...     slope = rise / jnp.where(sample[1, 0] == sample[0, 0], 1.0, sample[1, 0] - sample[0, 0])
        ...     return slope, sample[0, 1] - slope * sample[0, 0]
        >>> def distance(model, points):
        ...     return jnp.abs(model[0] * points[:, 0] + model[1] - points[:, 1])
        >>> x = jnp.arange(10.0)
        >>> points = jnp.stack([x, jnp.where(x % 3 == 0, 7.0, 2.0 * x + 1.0)], axis=1)
        >>> options = dict(sample_size=2, threshold=0.1, hypotheses=64, key=jax.random.key(0))
        >>> found = jl.solvers.ransac(points, line, distance, **options)
        >>> float(found.model[0]), int(found.inliers.sum())
        (2.0, 7)
    """
    n = jax.tree.leaves(data)[0].shape[0]
    valid = jnp.ones(n, bool) if valid is None else valid
    if sample_size > n:
        raise ValueError(f"A sample of {sample_size} items cannot be drawn from {n}: give more data.")
    threshold = jnp.asarray(threshold)
    sound = positive(threshold)
    threshold = jnp.where(sound, threshold, 1.0)
    valid, data = _usable(valid, data)
    chosen = sample_indices(key, valid, sample_size, hypotheses)
    fits = jax.vmap(lambda index: _as_candidates(fit(jax.tree.map(lambda leaf: leaf[index], data))))(chosen)
    models, usable = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (fits.models, fits.valid))

    def score(model: Any) -> tuple[Float[Array, ""], Bool[Array, " n"]]:
        distance = residual(model, data)
        ratio = distance / threshold.astype(distance.dtype)
        inside = valid & (jnp.abs(ratio) < 1.0)
        return jnp.sum(jnp.where(inside, ratio**2, jnp.where(valid, 1.0, 0.0))), inside

    costs, inliers = jax.vmap(score)(models)
    best = jnp.argmin(jnp.where(usable, costs, jnp.inf))
    model, inside = jax.tree.map(lambda leaf: leaf[best], (models, inliers))
    enough = (jnp.sum(valid) >= sample_size) & (jnp.sum(inside) > sample_size)
    ok = usable[best] & enough & sound
    model, cost = detach_unless(ok, (model, costs[best]))
    return Consensus(model, inside, cost, ok)


def _usable(valid: Bool[Array, " n"], data: Any) -> tuple[Bool[Array, " n"], Any]:
    """The mask of finite items, and the data with the others replaced by zero."""
    floats = jax.tree.leaves(eqx.filter(data, eqx.is_inexact_array))
    finite = [jnp.all(jnp.isfinite(leaf), axis=tuple(range(1, leaf.ndim))) for leaf in floats]
    valid = functools.reduce(jnp.logical_and, finite, valid)
    return valid, jax.tree.map(lambda leaf: jnp.where(_along(valid, leaf), leaf, jnp.zeros_like(leaf)), data)


def _along(mask: Bool[Array, " n"], leaf: Array) -> Bool[Array, "..."]:
    return mask.reshape(-1, *(1,) * (leaf.ndim - 1))


def _as_candidates(fitted: Any) -> Candidates:
    if isinstance(fitted, Candidates):
        return fitted
    return Candidates(jax.tree.map(lambda leaf: leaf[None], fitted), jnp.ones(1, bool))


def sample_indices(key: Key[Array, ""], valid: Bool[Array, " n"], size: int, count: int) -> Int[Array, "count size"]:
    """Samples without replacement among the valid items, by Floyd's algorithm: no sort of all items for every sample.

    Args:
        key: random key.
        valid: items that may be drawn; where fewer than ``size`` are, samples repeat items.
        size: items in a sample.
        count: number of samples.

    Returns:
        Indices of items, each row a sample.
    """
    order = jnp.argsort(~valid, stable=True)
    available = jnp.maximum(jnp.sum(valid), size)
    uniform = jax.random.uniform(key, (count, size))
    ranks: list[Int[Array, " count"]] = []
    for i in range(size):
        last = available - size + i
        drawn = jnp.minimum((uniform[:, i] * (last + 1).astype(uniform.dtype)).astype(last.dtype), last)
        taken = [drawn == rank for rank in ranks]
        repeated = jnp.any(jnp.stack(taken), axis=0) if taken else jnp.zeros_like(drawn, bool)
        ranks.append(jnp.where(repeated, last, drawn))
    return order[jnp.stack(ranks, axis=1)]


def required_hypotheses(inlier_fraction: float, sample_size: int, *, confidence: float = 0.99) -> int:
    """Number of samples of which, to a confidence, at least one holds inliers only.

    ``log(1 - confidence) / log(1 - inlier_fraction^sample_size)`` [K-61].

    Args:
        inlier_fraction: share of inliers, in (0, 1].
        sample_size: items in a sample.
        confidence: in (0, 1).

    Returns:
        Number of samples, rounded up.

    Raises:
        ValueError: an argument lies outside its range.

    Example:
        >>> import jaxloc as jl
        >>> [jl.solvers.required_hypotheses(0.5, s) for s in (2, 3, 5, 8)]
        [17, 35, 146, 1177]
    """
    if not 0.0 < inlier_fraction <= 1.0 or not 0.0 < confidence < 1.0:
        raise ValueError(f"Shares lie in (0, 1]; came inlier_fraction={inlier_fraction}, confidence={confidence}.")
    clean = inlier_fraction**sample_size
    return 1 if clean == 1.0 else ceil(log(1.0 - confidence) / log(1.0 - clean))
