# %% [markdown]
# # 5. In a map, and without one
#
# A robot with a laser wakes up somewhere in a known building: where is it? Then a robot with a camera among unknown
# landmarks: where is it, and where are they?

# %%
import os

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxloc as jl

FAST = "JAXLOC_FAST" in os.environ
plt.rcParams["figure.dpi"] = 70
np.set_printoptions(precision=3, suppress=True)

# %% [markdown]
# ## A building and its map
#
# The map is an occupancy grid; a scan is judged by how far its end points lie from the nearest obstacle, looked up in
# the distance field. Beams near each other tell the same, so that a scan counts as twenty, not as sixty.

# %%
drive = jl.data.simulate.laser.simulate_laser_drive(seed=2)
grid = drive.building.map()
log = drive.log
figure, axes = plt.subplots(figsize=(6, 3.5))
extent = (-0.5, grid.probability.shape[1] * 0.05 - 0.5, -0.5, grid.probability.shape[0] * 0.05 - 0.5)
axes.imshow(1.0 - grid.probability, origin="lower", cmap="gray", extent=extent)
axes.plot(*drive.truth[:, :2].T, "C0", label="truth")
axes.plot(*(log.odometry[:, :2] - log.odometry[0, :2] + drive.truth[0, :2]).T, "C1--", label="odometry")
axes.legend()
plt.show()

# %% [markdown]
# ## Where am I?
#
# Nothing is known at the start: thousands of poses all over the free space. The pipeline uses many particles until
# one place is left, few after that, and many again should scans stop fitting.

# %%
count = 12 if FAST else len(log)
config = jl.pipelines.localization.Config(
    num_particles=300 if FAST else 1000, num_particles_global=1000 if FAST else 10_000
)
steps = []
for step in jl.pipelines.localization.run(log, config, grid):
    steps.append(step)
    if len(steps) == count:
        break
figure, panels = plt.subplots(1, 3, figsize=(9, 2.4))
for axes, index in zip(panels, (0, count // 4, count - 1), strict=True):
    axes.imshow(1.0 - grid.probability, origin="lower", cmap="gray", extent=extent)
    axes.plot(*steps[index].cloud[:, :2].T, "C3.", markersize=1)
    axes.plot(*drive.truth[index, :2], "C0*", markersize=9)
    axes.set_title(f"scan {index}: {steps[index].num_particles} particles")
    axes.set_axis_off()
plt.show()

# %%
positions = np.array([step.pose[:2] for step in steps])
errors = np.linalg.norm(positions - drive.truth[:count, :2], axis=1)
found = np.array([step.found for step in steps])
if found.any():
    first = int(np.argmax(found))
    print(f"found at scan {first}; median error after that {100 * np.median(errors[first:]):.1f} cm")

# %% [markdown]
# ## No map
#
# Now the landmarks are unknown too. EKF-SLAM holds one normal density over the pose and all landmarks. Its error is
# chosen such that neither the motion nor the readings depend on the heading (an invariant filter): it does not learn a
# heading that is not observable, and stays consistent where the textbook's coordinates become overconfident.

# %%
motion = jl.sensors.IncrementMotion(drive=0.05, side=0.02, turn_drive=0.02, turn_turn=0.05)
deviations = jnp.array([0.1, 0.03])
runs, num_steps = (2, 40) if FAST else (20, 300)


def simulate(key):
    return jl.data.simulate.landmarks.simulate_landmarks(motion, deviations, key=key, num_steps=num_steps)


worlds = jax.jit(jax.vmap(simulate))(jax.random.split(jax.random.key(0), runs))
slam = jl.slam.EkfSlam(motion, *deviations, capacity=20)
prior = jl.beliefs.Gaussian(jl.poses.SE2(0.0, 0.0, 0.0), 1e-6 * jnp.eye(3))


@jax.jit
@jax.vmap
def explore(world):
    arguments = (world.increments, world.readings, world.valid)
    end, history = jl.filters.run(slam, slam.init(prior), *arguments, keep=lambda state: state.gaussian())
    nees = jax.vmap(lambda belief, pose: belief.mahalanobis_squared(pose))(history.states, world.poses)
    return end, history.states.mean, nees


ends, paths, nees = explore(worlds)
figure, axes = plt.subplots(figsize=(5, 4))
axes.plot(*worlds.poses.translation[0].T, "k", label="truth")
axes.plot(*paths.translation[0].T, "C0", label="EKF-SLAM")
axes.plot(*worlds.landmarks[0].T, "k^")
axes.plot(*ends.landmarks[0].T, "C0+", markersize=10)
axes.set_aspect("equal")
axes.legend()
plt.show()
print(f"mean NEES of the pose over {runs} runs (3 expected): {float(nees.mean()):.2f}")

# %% [markdown]
# FastSLAM samples the path, and given a path landmarks are independent of each other: a particle holds a 2x2
# covariance for each, nothing between them. The second version draws each pose with an eye on the reading. Around long
# loops a hundred paths are few; EKF-SLAM, with one density, is the better map maker here.


# %%
def landmark_error(maps):
    squared = jnp.sum((maps - worlds.landmarks) ** 2, axis=-1)
    return float(jnp.sqrt(jnp.mean(squared, where=ends.seen)))


for name, proposal in (
    ("FastSLAM 1", jl.slam.fast_slam.MotionProposal()),
    ("FastSLAM 2", jl.slam.fast_slam.MeasurementProposal()),
):
    fast = jl.slam.FastSlam(motion, *deviations, num_particles=100, capacity=20, proposal=proposal)

    def follow(world, key, fast=fast):
        arguments = (world.increments, world.readings, world.valid)
        return jl.filters.run(fast, fast.init(prior), *arguments, keep=lambda state: state.step, key=key)[0].landmarks()

    maps = jax.jit(jax.vmap(follow))(worlds, jax.random.split(jax.random.key(1), runs))
    print(f"{name}: landmark error {landmark_error(maps):.2f} m")
print(f"EKF-SLAM:   landmark error {landmark_error(ends.landmarks):.2f} m")

# %% [markdown]
# ## Takeaways
#
# - In a map particles start everywhere and end within centimeters: any density will do.
# - Without a map the question is what must not be learned: choose errors in which the unobservable stays so.
# - Readings come with masks; numbers that do not fit are refused by a gate, and say so in the info.
#
# ## Next steps
#
# `jaxloc localize --map MAP.yaml LOG` does the first part on recordings; `jaxloc.data.landmarks` reads real drives for
# the second.
