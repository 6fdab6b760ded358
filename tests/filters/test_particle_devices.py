"""Particles sharded over devices and processes: they stay where they are, and the numbers are those of one device."""

import os
import socket
import subprocess
import sys

import numpy as np
import pytest

WORLD = """
import os, sys
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec
import jaxloc as jl

def model():
    eye = jnp.eye(2)
    motion, sensor = jl.filters.LinearMotion(0.9 * eye, eye), jl.filters.LinearSensor(eye, 0.1 * eye)
    return jl.filters.ParticleFilter(motion, sensor, ess_threshold=0.7)

def cloud(size=4096):
    values, log_weights = np.random.default_rng(0).normal(size=(2, size, 2)).astype(np.float32)
    return jl.beliefs.Particles(jnp.asarray(values), jnp.asarray(log_weights[:, 0]))

def steps(state):
    readings, valid = jnp.sin(jnp.arange(16.0)).reshape(8, 2), jnp.ones(8, bool)
    keep = lambda state: state.particles.mean()
    return jl.filters.run(model(), state, None, readings, valid, keep=keep, key=jax.random.key(2))

def shard(tree, mesh, axis="particles"):
    def put(leaf):
        names = (axis,) if leaf.ndim else ()
        return jax.device_put(leaf, NamedSharding(mesh, PartitionSpec(*names)))
    return jax.tree.map(put, tree)
"""

EIGHT = (
    WORLD
    + """
mesh = jax.make_mesh((8,), ("particles",), axis_types=(AxisType.Auto,))
spec = PartitionSpec("particles")
one, alone = cloud(), model().init(cloud())
many = shard(one, mesh)
draw = jax.jit(lambda particles: jl.beliefs.resampling.Multinomial().resample(particles, key=jax.random.key(3)))
single, shared = draw(one), draw(many)
assert np.array_equal(single.ancestors, shared.ancestors)
assert np.array_equal(single.particles.values, shared.particles.values)
assert all(leaf.sharding.spec == spec for leaf in jax.tree.leaves(shared)), shared
end, history = steps(shard(alone, mesh))
last, expected = steps(alone)
assert np.array_equal(end.ancestors, last.ancestors)
assert np.allclose(end.particles.values, last.particles.values, atol=1e-6)
assert np.allclose(history.infos.log_likelihood, expected.infos.log_likelihood, atol=1e-4)
assert all(leaf.sharding.spec == spec for leaf in jax.tree.leaves(end.particles)), end
# A batch of filters sharded over the devices.
batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 8), alone)
shared = jax.jit(jax.vmap(steps))(shard(batch, mesh))
assert shared[0].particles.values.sharding.spec == spec
assert np.allclose(shared[1].infos.log_likelihood, expected.infos.log_likelihood, atol=1e-4)
try:
    model().init(shard(one, jax.make_mesh((8,), ("particles",), axis_types=(AxisType.Explicit,))))
except ValueError as error:
    assert "AxisType.Auto" in str(error)
else:
    raise AssertionError("explicit axes were taken")
print("same", float(history.infos.log_likelihood.sum()))
"""
)

TWO = (
    WORLD
    + """
jax.config.update("jax_cpu_collectives_implementation", "gloo")
jax.distributed.initialize(sys.argv[1], num_processes=2, process_id=int(sys.argv[2]), initialization_timeout=60)
assert jax.device_count() == 2 and len(jax.local_devices()) == 1
mesh = jax.make_mesh((2,), ("particles",), axis_types=(AxisType.Auto,))
held = jax.tree.map(np.asarray, model().init(cloud()))
def put(leaf):
    sharding = NamedSharding(mesh, PartitionSpec(*(("particles",) if leaf.ndim else ())))
    return jax.make_array_from_callback(leaf.shape, sharding, lambda index: leaf[index])
end, history = steps(jax.tree.map(put, held))
assert end.particles.values.sharding.spec == PartitionSpec("particles")
assert end.particles.values.addressable_data(0).shape == (2048, 2)
print("likelihood", float(history.infos.log_likelihood.sum()), float(end.ancestors.addressable_data(0).sum()))
"""
)


def start(code, *arguments, devices=1):
    environment = {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}",
    }
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(processes):
    try:
        answers = [process.communicate(timeout=150) for process in processes]
    finally:
        for process in processes:
            process.kill()
    for process, (_, errors) in zip(processes, answers, strict=True):
        assert process.returncode == 0, errors[-3000:]
    return [out.splitlines()[-1].split() for out, _ in answers]


@pytest.fixture(scope="module")
def expected():
    """What eight devices found, after they had compared themselves with one."""
    ((word, value),) = finish([start(EIGHT, devices=8)])
    assert word == "same"
    return float(value)


@pytest.mark.slow
def test_eight_devices_equal_one(expected):
    assert np.isfinite(expected)


@pytest.mark.slow
def test_two_processes_equal_one(expected):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    first, second = finish([start(TWO, address, str(rank)) for rank in (0, 1)])
    assert first[0] == second[0] == "likelihood"
    assert float(first[1]) == float(second[1]) and np.isclose(float(first[1]), expected, atol=1e-3)
