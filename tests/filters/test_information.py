import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs import Gaussian
from jaxloc.filters import InformationFilter, KalmanFilter, LinearMotion, LinearSensor, run

STEPS = 12


def parts(dtype=np.float64):
    rng = np.random.default_rng(0)
    motion = LinearMotion(
        jnp.asarray(np.eye(3) + 0.3 * rng.normal(size=(3, 3)), dtype),
        jnp.asarray(np.diag([0.1, 0.2, 0.0]), dtype),
        jnp.asarray(rng.normal(size=(3, 2)), dtype),
    )
    sensor = LinearSensor(jnp.asarray(rng.normal(size=(2, 3)), dtype), jnp.asarray(0.3 * np.eye(2), dtype))
    data = rng.normal(size=(STEPS, 2)), rng.normal(size=(STEPS, 2)), rng.uniform(size=(STEPS, 2)) < 0.8
    return motion, sensor, [jnp.asarray(data[0], dtype), jnp.asarray(data[1], dtype), jnp.asarray(data[2])]


@pytest.fixture(scope="module")
def both():
    """The same recording through both forms, and from knowing nothing."""
    with jax.enable_x64(True):
        motion, sensor, data = parts()
        prior = Gaussian(jnp.asarray([1.0, -1.0, 0.5]), jnp.asarray(np.diag([1.0, 2.0, 0.5])))
        ours, theirs = InformationFilter(motion, sensor), KalmanFilter(motion, sensor)

        @jax.jit
        def everything(data):
            history, peer = run(ours, ours.init(prior), *data)[1], run(theirs, theirs.init(prior), *data)[1]
            last, blank = run(ours, ours.init_uninformative(3), *data)
            known = jax.vmap(lambda state: state.determined)(blank.states)
            density = jax.vmap(lambda state: state.gaussian())(history.states)
            return density, history.infos, peer, (last.mean, known, blank)

        return everything(data)


# T-56
def test_equals_the_kalman_filter(both):
    density, infos, theirs, _ = both
    roots = np.asarray(theirs.states.covariance_sqrt)
    assert np.allclose(density.mean, theirs.states.mean, atol=1e-9)
    assert np.allclose(density.covariance, roots @ roots.transpose(0, 2, 1), atol=1e-9)
    for name in ("log_likelihood", "nis", "ok", "dof"):
        assert np.allclose(getattr(infos, name), getattr(theirs.infos, name), atol=1e-8), name


def test_from_nothing_equals_least_squares(x64, both):
    motion, sensor, (controls, readings, valid) = parts()
    transition, push, noise = (np.asarray(a) for a in (motion.transition, motion.input_matrix, motion.noise_covariance))
    size = 3 * STEPS
    # Unknown x1 and the noises w2, w3, ...: each reading is linear in them.
    rows, values = [], []
    effect, shift = np.zeros((3, size)), np.zeros(3)
    effect[:, :3] = np.eye(3)
    for k in range(STEPS):
        if k:
            effect, shift = transition @ effect, transition @ shift + push @ np.asarray(controls[k])
            effect[:, 3 * k : 3 * k + 3] += np.sqrt(noise)
            rows.append(np.eye(size)[3 * k : 3 * k + 3])
            values.append(np.zeros(3))
        here = np.asarray(valid[k])
        rows.append(np.asarray(sensor.matrix)[here] @ effect / np.sqrt(0.3))
        values.append((np.asarray(readings[k]) - np.asarray(sensor.matrix) @ shift)[here] / np.sqrt(0.3))
    answer, *_ = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)
    assert np.allclose(both[3][0], effect @ answer + shift, atol=1e-8)


def test_nothing_is_known_at_first(both):
    _, known, history = both[3]
    infos = history.infos
    assert not known[0] and known[3:].all()
    likelihood = np.asarray(infos.log_likelihood)
    assert likelihood[0] == 0.0 and (likelihood[5:] != 0.0).all() and np.asarray(infos.ok).all()
    for leaf in jax.tree.leaves(history):
        assert np.isfinite(leaf).all()


@pytest.mark.parametrize("bad", [np.nan, 1e30])
def test_nonfinite_measurements_change_nothing(bad):
    motion, sensor, _ = parts(np.float32)
    filt = InformationFilter(motion, sensor)

    @jax.jit
    def after(reading):
        state, info = filt.update(filt.predict(filt.init_uninformative(3), jnp.zeros(2)), reading, jnp.array(True))
        return jnp.sum(state.mean) + jnp.sum(state.information), (state, info)

    (value, (state, info)), gradient = jax.value_and_grad(after, has_aux=True)(jnp.array([1.0, bad]))
    assert np.isfinite(value) and np.isfinite(gradient).all() and np.isfinite(state.target).all()
    assert bool(info.ok) == np.isnan(bad)
