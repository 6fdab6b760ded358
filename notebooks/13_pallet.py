# %% [markdown]
# # 13. Find the pallet
#
# A fork lift has to know where the pallet stands, to a centimeter and half a degree. From an image: **edges of the
# fork holes**, four of them picked by polarity and by a ratio that no range changes, the **kind** of pallet by
# correlation, and the **pose** from four bearings. At the end another use of features: the motion of the camera from
# their velocities in the image.

# %%
import os

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxloc as jl
from jaxloc.data.simulate.pallet import make_camera, render_pallet
from jaxloc.refinement.motion_from_flow import interaction_matrix, motion_from_flow, twist_from_flow
from jaxloc.refinement.pallet import (
    block_narrow,
    detect_pallet,
    edge_bearings,
    euro_long,
    euro_short,
    hole_ratio,
    level_view,
    printed_jacobian,
)
from jaxloc.refinement.pallet.edges import band_profile, hole_band, strongest_edges, summed

FAST = "JAXLOC_FAST" in os.environ
plt.rcParams["figure.dpi"] = 70
np.set_printoptions(precision=3, suppress=True)

# %%
camera = make_camera(height=0.35)
kinds = (euro_long(), euro_short(), block_narrow())
truth = np.array([2.0, 0.15, 0.2])  # x ahead, y left, heading
picture = jnp.asarray(render_pallet(kinds[0], truth, camera))
plt.figure(figsize=(8, 5))
plt.imshow(picture, cmap="gray")
plt.title("the long side of a euro pallet, 2 m ahead")
plt.axis("off")
plt.show()

# %% [markdown]
# ## Edges
#
# A level camera at a known height knows in which rows the holes of a pallet at some range lie. The mean of the
# horizontal derivative over those rows has four clear peaks: wood **darkens** to the hole and **lightens** again,
# twice. Where the parabola through the logarithm of a peak has its top, there the edge is: to a hundredth of a pixel.

# %%
view = level_view(picture, camera)
band = hole_band(view, kinds[0], jnp.array(2.0))
profile = band_profile(summed(view.slope), band[0], band[1])
dark, light = strongest_edges(-profile, 4), strongest_edges(profile, 4)
plt.figure(figsize=(8, 3))
plt.plot(profile, lw=0.8, color="k")
for peaks, sign, name in ((dark, -1, "darkening"), (light, 1, "lightening")):
    some = np.asarray(peaks.strength) > 2.0
    plt.plot(np.asarray(peaks.columns)[some], sign * np.asarray(peaks.strength)[some], "o", label=name)
plt.xlabel("column, px")
plt.ylabel("gray levels a pixel")
plt.legend()
plt.show()

# %% [markdown]
# ## A ratio that no range changes
#
# Which four of all the edges in a hall? Hole width over hole separation is the same from one meter and from ten, and
# each kind of pallet has its own.

# %%
ranges = np.linspace(1.0, 8.0, 15)
for kind, name in zip(kinds, ("euro, long side", "euro, short side", "narrow block"), strict=True):
    ratios = [float(hole_ratio(edge_bearings(jl.poses.SE2(float(x), 0.3, 0.1), kind.edges(), 600.0))) for x in ranges]
    plt.plot(ranges, ratios, label=name)
plt.xlabel("range, m")
plt.ylabel("hole width : separation, seen")
plt.ylim(0, 3.2)
plt.legend()
plt.show()

# %% [markdown]
# ## Kind and pose
#
# `detect_pallet` proposes four edges at each of many ranges, fits a pose, compares the image there with the front of
# each kind, and measures the edges of the best once more. The covariance comes from how parts of the edges scatter.

# %%
found = detect_pallet(picture, camera, kinds)
value = found.estimate.value
print("ok:", bool(found.estimate.ok), " kind:", int(found.kind), " correlation:", np.asarray(found.correlation))
print("pose: ", np.array([float(value.x), float(value.y), float(value.theta)]), " truth:", truth)
sigmas = np.sqrt(np.diag(np.asarray(found.estimate.covariance)))
print(f"sigmas: {1e3 * sigmas[0]:.2f} mm along, {1e3 * sigmas[1]:.2f} mm across, {np.degrees(sigmas[2]):.3f} deg")
print("asked for another kind:", bool(detect_pallet(picture, camera, (kinds[1],) * 3).estimate.ok))

# %% [markdown]
# The Jacobian behind it is Kelly's: how a bearing moves with the place of the edge, times how the place moves with the
# pallet. Heading is the weak direction: it shows only in how the two halves differ in size.

# %%
print(np.asarray(printed_jacobian(value, kinds[0].edges(), camera.camera.fx)).T)

# %%
errors = []
for x in (1.3, 2.0, 3.0, 4.0):
    for seed in range(2 if FAST else 10):
        rng = np.random.default_rng([seed, int(10 * x)])
        pose = np.array([x, rng.uniform(-0.1, 0.1) * x, rng.uniform(-0.3, 0.3)])
        fit = detect_pallet(jnp.asarray(render_pallet(kinds[0], pose, camera, seed=seed)), camera, kinds).estimate
        away = np.hypot(float(fit.value.x) - pose[0], float(fit.value.y) - pose[1])
        errors.append((x, 1e3 * away, np.degrees(abs(float(fit.value.theta) - pose[2]))))
errors = np.array(errors)
figure, axes = plt.subplots(1, 2, figsize=(8, 3))
for axis, column, name in zip(axes, (1, 2), ("place, mm", "heading, deg"), strict=True):
    axis.semilogy(errors[:, 0], errors[:, column], "o", ms=4)
    axis.set_xlabel("range, m")
    axis.set_ylabel("error of " + name)
figure.tight_layout()
plt.show()

# %% [markdown]
# ## Flow to twist
#
# Features that move: `flow = A v / Z + B w`. With depth (stereo) the twist of the camera follows by linear least
# squares. Without it only ``v / Z`` counts: a world twice as large, crossed twice as fast, is the same image. Then
# the direction of travel and the rotation are left, and a wide view is needed to tell one from the other.

# %%
twist = jnp.array([0.3, -0.1, 0.9, 0.05, 0.12, -0.08])
keys = jax.random.split(jax.random.key(0), 3)
points = jax.random.uniform(keys[0], (80, 2), minval=-0.7, maxval=0.7)
depth = jax.random.uniform(keys[1], (80,), minval=2.0, maxval=10.0)
flow = interaction_matrix(points, depth) @ twist + 1e-3 * jax.random.normal(keys[2], (80, 2))
plt.figure(figsize=(5, 5))
plt.quiver(points[:, 0], -points[:, 1], flow[:, 0], -flow[:, 1], angles="xy")
plt.title("flow of a camera that travels and turns")
plt.show()
print("twist:   ", np.asarray(twist_from_flow(points, flow, depth, sigma=1e-3).value))
free = motion_from_flow(points, flow, sigma=1e-3)
print("no depth:", np.asarray(free.value.direction.vector), np.asarray(free.value.angular_velocity))
print("truth:   ", np.asarray(twist[:3] / jnp.linalg.norm(twist[:3])), np.asarray(twist[3:]))

# %%
views, conditions = np.array([10, 20, 40, 60, 90, 120]), []
for degrees in views:
    wide = jnp.tan(jnp.radians(degrees / 2.0)) / 0.7 * points
    wall = 5.0 + 0.02 * depth
    conditions.append(float(twist_from_flow(wide, jnp.zeros_like(wide), wall).observability().condition))
plt.semilogy(views, conditions, "o-")
plt.xlabel("field of view, deg")
plt.ylabel("condition of the twist before a wall")
plt.show()

# %% [markdown]
# ## Takeaways
#
# - Polarity and a scale-free ratio find four edges among many; the fit, the correlation and the rows have to agree, or
#   `ok` is False.
# - Four bearings tell a pose with its covariance; heading is what they tell worst.
# - Flow with depth determines the whole twist, without depth the direction and the rotation.
#
# ## Next steps
#
# - Mix points, lines and segments in one pose: `jl.refinement.correspondences`.
# - Give the estimates to a filter: `find_pallet(...).gaussian()` is a measurement like any other.
