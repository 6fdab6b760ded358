# %% [markdown]
# # 8. Moving objects from a moving camera
#
# A stereo camera drives along a street. Most of what it sees stands still, which gives the camera motion. What that
# motion does not explain moves by itself: it is matched once more, grouped to objects, and followed by a GM-PHD filter
# in the world.

# %%
import os

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxloc as jl
from jaxloc.pipelines import moving_objects

FAST = "JAXLOC_FAST" in os.environ
plt.rcParams["figure.dpi"] = 70

# %% [markdown]
# ## What stands, and what moves
#
# The street is rendered, so that the truth is known. Two frames, and their odometry:

# %%
street = jl.data.simulate_street(num_frames=18 if FAST else 60, seed=0)
frames = list(street)
evidence = list(jl.pipelines.odometry.run_with_evidence(frames, jl.pipelines.odometry.Config(), street.rig))
step, found = evidence[16]
points = jl.odometry.find_moving(
    street.rig, found.reference, found.current, found.matches, found.motion, jnp.array(0.1, jnp.float32)
)
valid = np.asarray(points.valid)
figure, axes = plt.subplots(figsize=(9, 3))
axes.imshow(frames[16].left, cmap="gray")
explained = np.asarray(found.matches.current)[np.asarray(found.motion.inliers)]
axes.plot(explained[:, 0], explained[:, 2], ".", color="tab:green", markersize=2, label="explained by the motion")
axes.plot(*np.asarray(points.uv)[valid].T, ".", color="tab:red", label="moving")
axes.legend(fontsize=7, loc="lower left")
axes.set_axis_off()
plt.show()

# %% [markdown]
# A point is called moving when its displacement is larger than its covariance allows: that of both triangulations and
# of the camera's motion. Far away a pixel is many meters, so few points are sure of it alone. Points that lie together
# and move alike are one object, whose velocity is known much better:

# %%
objects = jl.odometry.group_points(points)
for i in np.flatnonzero(objects.valid):
    sigma = np.sqrt(np.diagonal(objects.velocity_covariances[i]))
    velocity = np.asarray(objects.velocities[i])
    print(
        f"{int(objects.counts[i])} points, velocity {velocity.round(1)} +- {sigma.round(1)} m/s (right, down, forward)"
    )

# %% [markdown]
# ## Tracks
#
# The filter knows where the camera is, how surely, and what it can see from there: an object out of view is not missed.

# %%
steps = list(moving_objects.run_after_odometry(evidence, moving_objects.Config(), street.rig))
figure, axes = plt.subplots(figsize=(5, 6))
camera = np.array([np.asarray(one.odometry.pose.translation) for one in steps])
axes.plot(camera[:, 0], camera[:, 2], "k", label="camera")
for item in street.objects:
    axes.plot(item.poses[:, 0, 3], item.poses[:, 2, 3], color="0.8", linewidth=6)
paths = {}
for one in steps:
    for track in one.tracks:
        paths.setdefault(track.label, []).append(track.state)
for label, states in paths.items():
    places = np.array(states)
    axes.plot(places[:, 0], places[:, 2], ".-", markersize=3, label=f"track {label}")
axes.set(xlabel="x [m]", ylabel="z [m]", title="tracks over the true paths (gray)", xlim=(-25, 25), ylim=(-5, 110))
axes.legend(fontsize=7)
plt.show()

# %% [markdown]
# How long each stage takes, on this machine:

# %%
warm = [one.timings for one in steps[4:]]
for name in warm[0]:
    print(f"{name:9} {1e3 * np.median([spent[name] for spent in warm]):6.1f} ms")

# %% [markdown]
# ## What limits it
#
# A car ahead that drives as fast as the camera hardly moves in the images; its distance has to change by more than its
# error. The standard deviation of a velocity, from two frames a tenth of a second apart, at several depths:

# %%
camera_pose = jl.poses.SE3.identity()
sensor = jl.sensors.MovingObjectSensor(street.rig, camera_pose, jnp.zeros((6, 6)), 0.1, extent=0.0, slack=0.0)
depths = jnp.array([5.0, 10.0, 20.0, 40.0])
states = jnp.stack([jnp.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]) * depth for depth in depths])
sigmas = jnp.sqrt(jax.vmap(lambda state: jnp.diagonal(sensor.covariance(state, None)))(states))
for depth, sigma in zip(depths, sigmas, strict=True):
    print(f"{depth:4.0f} m: {sigma[3]:5.1f} m/s sideways, {sigma[5]:5.1f} m/s along the view")

# %% [markdown]
# ## Takeaways
#
# - Odometry comes first: what it does not explain is little, and can be searched widely.
# - One point says little, a group says much: covariances carry that through.
# - The tracker lives in the world; what is seen, and how well, follows from the pose of the camera.
#
# ## Next steps
#
# `jaxloc track SEQUENCE` does all this on a recording, and writes tracks, images and a report.
