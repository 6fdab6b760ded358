"""Interface of filters: init, predict and update, and `run` over a recording."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import Gaussian


class FilterState(eqx.Module):
    """State of a filter: all that its next step depends on.

    Attributes:
        step: number of predictions so far; random keys are derived from it, so that a resumed run draws the same
            numbers as one pass.
    """

    step: eqx.AbstractVar[Int[Array, ""]]


class GaussianState(FilterState):
    """State of the Kalman family: a normal density in square-root form.

    Attributes:
        mean: a vector, a pose, or any pytree of them.
        covariance_sqrt: lower triangular root of the covariance in the tangent space of the mean.
        step: number of predictions so far.
    """

    mean: Any
    covariance_sqrt: Float[Array, "d d"]
    step: Int[Array, ""]

    @property
    def covariance(self) -> Float[Array, "*s d d"]:
        """Covariance of the tangent at the mean; positive semidefinite, as the product of the root with itself."""
        return matmul(self.covariance_sqrt, self.covariance_sqrt.mT)

    def gaussian(self) -> Gaussian:
        """The state as a density."""
        return Gaussian(self.mean, self.covariance)


class Info(eqx.Module):
    """Diagnostics of an update.

    Attributes:
        log_likelihood: of the measurement given all earlier ones; zero where there is none.
        ok: whether the state can be used; False for non-finite input, where the state is the predicted one.
    """

    log_likelihood: eqx.AbstractVar[Float[Array, ""]]
    ok: eqx.AbstractVar[Bool[Array, ""]]


class GaussianInfo(Info):
    """Diagnostics of an update of the Kalman family.

    Attributes:
        log_likelihood: of the measurement given all earlier ones; zero where there is none.
        ok: whether the state can be used.
        innovation: measured minus predicted, in the tangent space of the measurement, zero where masked.
        innovation_covariance: its predicted covariance; unit variance where masked.
        nis: normalized innovation squared, chi-square with `dof` degrees of freedom under the model.
        dof: number of degrees of freedom: of valid directions.
        accepted: whether the measurement passed the gate (True without one).
    """

    log_likelihood: Float[Array, ""]
    ok: Bool[Array, ""]
    innovation: Float[Array, " m"]
    innovation_covariance: Float[Array, "m m"]
    nis: Float[Array, ""]
    dof: Int[Array, ""]
    accepted: Bool[Array, ""]


def conclude(ok: Bool[Array, ""], after: Any, info: Any, before: Any) -> tuple[Any, Any]:
    """The result of an update where it is usable; else the state before it, and an info with finite numbers.

    Args:
        ok: whether the update is usable.
        after: the state after it.
        info: its `Info`.
        before: the state before it.
    """
    info = eqx.tree_at(lambda i: i.ok, info, info.ok & ok)
    return tree.where(ok, after, before), tree.where(ok, info, tree.finite_or_zero(info))


class Filter(eqx.Module):
    """A recursive estimator: a pytree of its models, with pure functions `init`, `predict` and `update`."""

    @abstractmethod
    def init(self, prior: Any) -> Any:
        """The initial state, from a prior such as a `Gaussian`."""

    @abstractmethod
    def predict(self, state: Any, control: Any, *, key: Key[Array, ""] | None = None) -> Any:
        """The state one step ahead, before its measurement."""

    @abstractmethod
    def update(
        self, state: Any, measurement: Any, valid: Bool[Array, "*m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[Any, Any]:
        """The state updated by a measurement, and an `Info`; unchanged where the measurement is not valid."""


class History(eqx.Module):
    """States and infos of a run, stacked along the steps.

    Attributes:
        states: after each update (or what `keep` made of them).
        infos: of each update.
    """

    states: Any
    infos: Any


def _identity(state: Any) -> Any:
    return state


@filter_jit
def run(
    filt: Filter,
    state: Any,
    controls: Any,
    measurements: Any,
    valid: Bool[Array, "t *m"],
    *,
    active: Bool[Array, " t"] | None = None,
    keep: Callable[[Any], Any] = _identity,
    key: Key[Array, ""] | None = None,
) -> tuple[Any, History]:
    """A pass over a recording: for each step `predict`, then `update`, in one scan.

    Args:
        filt: any `Filter`.
        state: the initial state, `filt.init(prior)` or the last state of an earlier run. A resumed run gives the same
            numbers as one pass.
        controls: stacked along the steps, such as ``dt``; or None.
        measurements: stacked along the steps.
        valid: mask of the measurements: one Boolean per step, or one for each tangent direction of each.
        active: mask of the steps. An inactive step leaves the state unchanged, so that padded sequences of different
            lengths share one compiled program. None for all.
        keep: function of each state whose results the history holds, such as an estimate instead of all particles.
        key: random key, for filters that sample.

    Returns:
        The last state, and the `History`.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> eye = jnp.eye(1)
        >>> filt = jl.filters.KalmanFilter(jl.filters.LinearMotion(eye, eye), jl.filters.LinearSensor(eye, eye))
        >>> state = filt.init(jl.beliefs.Gaussian(jnp.zeros(1), eye))
        >>> state, history = jl.filters.run(filt, state, None, jnp.ones((5, 1)), jnp.ones(5, bool))
        >>> history.infos.log_likelihood.shape
        (5,)
    """
    mask = jnp.ones(valid.shape[:1], bool) if active is None else active

    def advance(before, inputs):
        control, measurement, valid_here, here = inputs
        keys = (None, None) if key is None else jax.random.split(jax.random.fold_in(key, before.step))
        moved = filt.predict(before, control, key=keys[0])
        after, info = filt.update(moved, measurement, valid_here & here, key=keys[1])
        if active is not None:
            after = tree.where(here, after, before)
        return after, History(keep(after), info)

    return lax.scan(advance, state, (controls, measurements, valid, mask))
