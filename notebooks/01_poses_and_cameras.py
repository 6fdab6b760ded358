# %% [markdown]
# # 1. Poses and cameras
#
# Where is the camera, and what does it see from there? This notebook introduces the three things that all
# others use: a **pose**, its **tangent space**, in which small motions and uncertainties live, and a
# **camera** that turns points into pixels. Everything is JAX: what you can compute you can also `jit`, `vmap`
# and differentiate.

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
# ## Poses compose like fractions
#
# `T_world_camera` maps coordinates of the camera to the world. In a product the inner names cancel:
# `T_world_camera @ T_camera_lamp = T_world_lamp`. The inverse swaps the names. Camera axes: x right, y down,
# z forward.

# %%
T_world_camera = jl.poses.SE3.from_euler(jnp.array([1.0, 0.0, 2.0]), yaw=0.0, pitch=0.3, roll=0.0)
T_camera_lamp = jl.poses.SE3.from_euler(jnp.array([0.0, -1.0, 5.0]), yaw=0.0, pitch=0.0, roll=0.0)
T_world_lamp = T_world_camera @ T_camera_lamp
print("the lamp in the world:", T_world_lamp.translation)

points_camera = jnp.array([[0.0, 0.0, 1.0], [0.0, -1.0, 5.0]])
points_world = T_world_camera.apply(points_camera)
print("there and back:", *T_world_camera.inverse().apply(points_world))

# %% [markdown]
# ## The tangent space
#
# A pose has six degrees of freedom but sixteen numbers in its matrix, so adding to those numbers leaves the
# group. We move it by a tangent vector `d = (translation, rotation)` on the right, `T @ exp(d)`: first go
# along the camera's own axes, then read off where you are in the world. `retract` does that, `local` is its
# inverse, and both work on any pytree.

# %%
step = jnp.array([0.1, 0.0, 0.5, 0.0, 0.02, 0.0])  # half a meter ahead, a bit to the right, a slight turn
moved = jl.poses.retract(T_world_camera, step)
print("recovered:", jl.poses.local(T_world_camera, moved))

state = {"pose": T_world_camera, "velocity": jnp.zeros(3)}
print("degrees of freedom of a pose with a velocity:", jl.poses.tangent_dimension(state))

# %% [markdown]
# Dead reckoning chains many such steps. In single precision the question is not whether rounding adds up but
# how fast. Here is a circle of a kilometer; its end should be its start.

# %%
count = 200 if FAST else 2000
turn = 2.0 * np.pi / count
circle = jnp.tile(jnp.array([0.0, 0.0, 1000.0 / count, 0.0, turn, 0.0]), (count, 1))
path = jl.poses.chain(jl.poses.SE3.identity(), jax.vmap(jl.poses.SE3.exp)(circle))
gap = float(jnp.linalg.norm(path.translation[-1]))
print(f"the ends of the circle are {1000 * gap:.1f} mm apart")

# %% [markdown]
# ## Uncertain poses
#
# A `Gaussian` has a mean on the manifold and a covariance in its tangent space. Composing two of them carries
# the first covariance through the second pose: an error of heading early on moves the end sideways. That is
# the banana of dead reckoning: we draw samples of a drive, and the ellipse that first-order compounding gives
# for its end.

# %%
noise = jnp.diag(jnp.array([1e-4, 1e-5, 2e-4]))  # forward, sideways, heading, for each meter
step = jl.beliefs.Gaussian(jl.poses.SE2(1.0, 0.0, 0.02), noise)
start = jl.beliefs.Gaussian(jl.poses.SE2(0.0, 0.0, 0.0), 1e-9 * jnp.eye(3))


@jax.jit
def drive(start, step):
    def advance(pose, _):
        pose = jl.beliefs.compose(pose, step)
        return pose, pose

    return jax.lax.scan(advance, start, None, length=40)


@jax.jit
def wander(key):
    deltas = jnp.linalg.cholesky(noise) @ jax.random.normal(key, (3, 40))
    motions = jax.vmap(lambda d: step.mean.retract(d))(deltas.T)
    return jl.poses.chain(jl.poses.SE2(0.0, 0.0, 0.0), motions).translation


end, history = drive(start, step)
walks = jax.vmap(wander)(jax.random.split(jax.random.key(0), 50 if FAST else 400))

axes = plt.figure(figsize=(6, 4)).add_subplot()
axes.plot(walks[:50, :, 0].T, walks[:50, :, 1].T, color="tab:blue", alpha=0.1)
axes.plot(walks[:, -1, 0], walks[:, -1, 1], ".", markersize=3, label="ends of simulated drives")
rotation = end.mean.rotation.matrix()
spread = rotation @ end.covariance[:2, :2] @ rotation.T
circle = np.stack([np.cos(np.linspace(0, 2 * np.pi, 60)), np.sin(np.linspace(0, 2 * np.pi, 60))])
ellipse = end.mean.translation[:, None] + 2.45 * jnp.linalg.cholesky(spread) @ circle
axes.plot(*ellipse, color="tab:red", label="95 % by first-order compounding")
axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="Forty meters of dead reckoning")
axes.legend(frameon=False)
plt.show()

# %% [markdown]
# ## Cameras
#
# A pinhole camera with a lens: pixels are (right, down) with centers at integers. Its intrinsics are array
# leaves, so that they can be learned. A point behind the camera has no image: `project` returns something
# finite for it, with zero gradient, and `in_front` says so. That is the rule of the whole library: no NaN,
# and a mask beside the values.

# %%
lens = jl.sensors.lenses.BrownConrady((-0.3, 0.1, 0.0, 0.0, 0.0))
camera = jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0, lens=lens)
points = jnp.array([[0.5, 0.2, 4.0], [0.0, 0.0, -1.0]])
print("pixels:", *camera.project(points), " in front:", camera.in_front(points))

grid = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 17), np.linspace(-0.6, 0.6, 13)), axis=-1)
grid = jnp.asarray(np.concatenate([grid, np.ones_like(grid[..., :1])], axis=-1).reshape(-1, 3), jnp.float32)
straight = jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0)
axes = plt.figure(figsize=(6, 4.5)).add_subplot()
for name, model in {"without lens": straight, "with lens": camera}.items():
    u, v = np.asarray(model.project(grid)).T
    axes.plot(u, v, ".", label=name)
axes.set(xlabel="u (px)", ylabel="v (px)", aspect="equal", title="Barrel distortion of a grid")
axes.invert_yaxis()
axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
plt.show()

# %% [markdown]
# The derivative of a pixel with respect to the pose is one call away. It says how far a feature moves when
# the camera does: what every refinement in the next notebook is built on.


# %%
def pixel(delta):
    return straight.project(jl.poses.SE3.identity().retract(delta).inverse().apply(points[:1]))[0]


print(jax.jacobian(pixel)(jnp.zeros(6)).round(1))

# %% [markdown]
# ## Stereo: depth with its uncertainty
#
# A rectified stereo rig measures `(u_left, u_right, v)`. Depth is inversely proportional to disparity, so its
# error grows with the square of the distance.

# %%
rig = jl.data.simulate.stereo_points.kitti_rig()
depths = jnp.linspace(4.0, 60.0, 29)
measured = rig.project(jnp.stack([jnp.zeros_like(depths), jnp.zeros_like(depths), depths], axis=1))


def sigma(measurement):
    return jnp.sqrt(jl.multiview.stereo_triangulation.triangulate(rig, measurement, 0.25 * jnp.eye(3)).covariance[2, 2])


axes = plt.figure(figsize=(6, 3)).add_subplot()
axes.plot(depths, jax.vmap(sigma)(measured))
axes.set(xlabel="depth (m)", ylabel="standard deviation (m)", title="Depth from KITTI's rig, half a pixel of noise")
axes.grid(alpha=0.3)
plt.show()

# %% [markdown]
# ## Takeaways
#
# - `T_world_camera` maps camera to world; inner names cancel in products.
# - Small motions and covariances live in the tangent space: (translation, rotation), on the right.
# - Functions take one object; `jax.vmap` makes batches, `jax.jacobian` makes derivatives.
# - What cannot be seen is finite and masked, never NaN.
#
# ## Next steps
#
# `02_pose_refinement`: from pixels back to the pose, with outliers, covariance and derivatives through the
# solution.
