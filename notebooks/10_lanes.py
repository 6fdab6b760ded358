# %% [markdown]
# # 10. Lanes: RALPH
#
# In 1995 a car steered itself across the United States. Its program, RALPH, knew nothing of lane marks: it looked at
# the road from above, straightened it under many hypotheses of curvature, kept the straightest, and slid the profile
# across the road along a template. We do so on a synthetic road, whose truth is known, and then let a joint fit of
# every row say how sure all of it is.

# %%
import os

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import jaxloc as jl
from jaxloc.data.simulate.road.drive import Course, drive
from jaxloc.data.simulate.road.rendering import Road, Streak, render
from jaxloc.lanes import ralph
from jaxloc.lanes.ground_view import GroundGrid, inverse_perspective

FAST = "JAXLOC_FAST" in os.environ
plt.rcParams["figure.dpi"] = 70

# %% [markdown]
# ## From above
#
# `GroundCamera` is a camera over a plane. The grid on the ground is as wide far away as near by, and reaches farther
# the faster we drive; its numbers are data, so that another speed compiles nothing.

# %%
shape = (240, 320) if FAST else (480, 640)
scale = shape[1] / 640
pinhole = jl.sensors.Pinhole(600.0 * scale, 600.0 * scale, 319.5 * scale, 199.5 * scale)
ground = jl.sensors.GroundCamera(pinhole, height=1.3, pitch=0.03)
road, truth = Road(), jl.lanes.Lane(offset=0.3, heading=0.01, curvature=1.5e-3)
picture = render(road, truth, ground, shape=shape, travelled=100.0)
view = inverse_perspective(ground, jnp.asarray(picture), GroundGrid.for_speed(20.0))
straight = ralph.straighten(view, ralph.LaneFit(0.3, 0.01, 1.5e-3), view.grid.left)

figure, axes = plt.subplots(1, 3, figsize=(11, 3))
pictures = {"image": picture, "from above": view.image, "straightened": straight.values}
for axis, (title, image) in zip(axes, pictures.items(), strict=True):
    axis.imshow(image, cmap="gray", aspect="auto", origin="upper" if title == "image" else "lower")
    axis.set_title(title), axis.set_axis_off()
plt.show()

# %% [markdown]
# ## The straightest is the sharpest
#
# Under the right curvature the columns of the straightened view add up: their sum has sharp edges. `straightness`
# scores one hypothesis; `jax.vmap` scores them all.

# %%
curvatures = 1e-3 * jnp.linspace(-3.0, 4.0, 71)
hypotheses = jax.vmap(lambda c: ralph.LaneFit(0.0 * c, 0.01 + 0.0 * c, c, 0.0 * c))(curvatures)
for sharpness in (ralph.AbsoluteSteps(), ralph.SmoothSteps()):
    scores = jax.vmap(lambda fit, s=sharpness: ralph.straightness(view, fit, sharpness=s))(hypotheses)
    plt.plot(1e3 * curvatures, scores / scores.max(), label=type(sharpness).__name__)
plt.axvline(1.5, color="gray", lw=0.8), plt.xlabel("curvature, 1/km"), plt.legend()
plt.show()

# %% [markdown]
# ## Where in the lane, and how surely
#
# A template is the cross profile of the road, captured once where the lane is known. `estimate` searches, matches, and
# fits offset, heading, curvature and the camera's pitch at once, each row with a gain and bias of its own: shadows
# across the road do not matter. The covariance comes from leaving out stretches of road, and bands of it.

# %%
saved = inverse_perspective(
    ground, jnp.asarray(render(road, jl.lanes.Lane(0.0, 0.0, 0.0), ground, shape=shape)), view.grid
)
template = ralph.capture(saved, ralph.LaneFit())
state = ralph.estimate(view, template)
sigma = jnp.sqrt(jnp.diag(state.estimate.covariance))
for name, value, spread, true in zip(
    ("offset, m", "heading, rad", "curvature, 1/m"),
    (state.offset, state.heading, state.curvature),
    sigma,
    (truth.offset, truth.heading, truth.curvature),
    strict=False,  # the pitch has no true value here
):
    print(f"{name:15} {float(value):9.5f} +- {float(spread):.5f}   true {float(true):9.5f}")
print("ok:", bool(state.ok), " confidence:", round(float(state.confidence), 2))

# %% [markdown]
# ## Roads change
#
# A saved template fails when the surface changes. One that blends in what it sees, and one that is taken from the far
# rows, go on: the vehicle's odometry carries the lane over the change.

# %%
other = Road(marks=(), streaks=(Streak(1.35, 0.15, 25.0), Streak(-0.2, 0.3, -20.0), Streak(-1.25, 0.2, 20.0)), seed=5)
frames = 40 if FAST else 70
trip = drive(road.followed_by(other, 40.0), ground, frames, course=Course(interval=0.1), shape=shape)
views = [inverse_perspective(ground, jnp.asarray(frame), view.grid) for frame in trip.frames()]
for adaptation in (ralph.Fixed(), ralph.Blended(0.1), ralph.Predictive()):
    fit, believed = ralph.LaneFit(*trip.lanes[0, :3]), []
    template = ralph.capture(views[0], fit)
    for seen, speed, yaw_rate in zip(views, trip.speeds, trip.yaw_rates, strict=True):
        near = ralph.Hypotheses.around(fit, curvature=4e-4, heading=0.012, pitch=0.006, offset=0.4, counts=(9, 7, 5))
        found = ralph.estimate(seen, template, hypotheses=near)
        value = found.estimate.value
        # A lane does not jump: what is far from the prediction belongs to something else.
        ok = found.ok & (abs(value.offset - fit.offset) < 0.15) & (abs(value.heading - fit.heading) < 0.01)
        fit = jax.tree.map(lambda new, old, ok=ok: jnp.where(ok, new, old), value, fit)
        template = adaptation.adapt(template, seen, fit, jnp.array(True))
        believed.append(float(found.match.correlation))
        lane = fit.lane().advance(jnp.float32(0.1 * speed), jnp.float32(0.1 * yaw_rate))
        fit = ralph.LaneFit(lane.offset, lane.heading, lane.curvature, fit.pitch)
    plt.plot(trip.travelled, believed, label=type(adaptation).__name__)
plt.xlabel("way, m"), plt.ylabel("correlation with the template"), plt.legend()
plt.show()

# %% [markdown]
# ## Takeaways
#
# - A lane needs no lane model: anything that runs along the road will do, and the sharpest sum finds it.
# - Search first (a thousand hypotheses cost milliseconds), then fit: that gives the last centimeter and a covariance.
# - The pitch belongs to the unknowns: half a degree would bend a straight road.
# - A profile that repeats itself is said to be ambiguous, and a road like no template is not believed.
#
# ## Next steps
#
# `jaxloc lane VIDEO --camera CAMERA.yaml` follows a lane through a recording; notebook 11 does on a
# factory's floor what this one does on a road.
