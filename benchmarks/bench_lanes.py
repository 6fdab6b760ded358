"""Lanes by RALPH: accuracy on synthetic roads, templates that must follow the road, time by image and by batch.

There is no public implementation to compare with; figures of accuracy stand against the truth of the renderer.
"""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxloc as jl
from benchmarks.metric import ACCURACY, TIME, Metric, compiled, quickest
from jaxloc.data.simulate.road.drive import Course, RoadDrive, drive
from jaxloc.data.simulate.road.rendering import Road, Streak, render
from jaxloc.lanes import ralph
from jaxloc.lanes.ground_view import GroundGrid, GroundView, inverse_perspective

PITCH = 0.03
GROUND = jl.sensors.GroundCamera(jl.sensors.Pinhole(600.0, 600.0, 319.5, 199.5), 1.3, PITCH)
SPEED, SHAPE = 20.0, (480, 640)


class Errors(NamedTuple):
    """Of many images: offset (m), heading (rad), curvature (1/m), pitch (rad); squared Mahalanobis distance; ok."""

    values: np.ndarray
    nees: np.ndarray
    ok: np.ndarray


def metrics(smoke: bool) -> Iterator[Metric]:
    count = 4 if smoke else 60
    scenes = (
        ("marks", Road(), 0.0),
        ("no_marks", Road().without_marks(), 0.0),
        ("pitch_wrong", Road(), np.deg2rad(0.5)),
    )
    for name, road, pitch in scenes[:1] if smoke else scenes:
        yield from _accuracy(f"lanes.{name}", road, pitch, count)
    yield from _time(2 if smoke else 20, 2 if smoke else 256)
    yield from _adaptation(4 if smoke else 160)


def view_of(picture: np.ndarray, wrong_pitch: float = 0.0) -> GroundView:
    """An image from above, by a camera whose pitch may be known wrongly."""
    ground = eqx.tree_at(lambda g: g.pitch, GROUND, GROUND.pitch - wrong_pitch)
    return inverse_perspective(ground, jnp.asarray(picture), GroundGrid.for_speed(SPEED))


def template_of(road: Road, pictures: int = 8) -> ralph.Template:
    """What a driver saves who keeps to the middle of a straight lane for a while: the mean of some images."""
    template, straight = None, jl.lanes.Lane(0.0, 0.0, 0.0)
    for index in range(pictures):
        view = view_of(render(road, straight, GROUND, travelled=5.0 + 37.0 * index))
        fresh = ralph.capture(view, ralph.LaneFit())
        template = fresh if template is None else ralph.blend(template, fresh, jnp.array(1.0 / (index + 1.0)))
    return template


def trials(road: Road, wrong_pitch: float, count: int) -> Errors:
    """Images of several stretches of a road, and roads, from random places in the lane."""
    rng, errors, nees, ok = np.random.default_rng(11), [], [], []
    for index in range(count):
        here = dataclasses.replace(road, seed=index // 10)
        if index % 10 == 0:
            template = template_of(here)
        truth = np.array([rng.uniform(-0.6, 0.6), rng.uniform(-0.03, 0.03), rng.uniform(-2e-3, 2e-3), wrong_pitch])
        picture = render(here, jl.lanes.Lane(*truth[:3]), GROUND, travelled=rng.uniform(50, 900), seed=index)
        found = ralph.estimate(view_of(picture, wrong_pitch), template)
        value = found.estimate.value
        error = np.array([value.offset, value.heading, value.curvature, value.pitch]) - truth
        errors.append(error)
        lane = np.array(found.estimate.covariance, np.float64)[:3, :3]
        nees.append(error[:3] @ np.linalg.solve(lane, error[:3]))
        ok.append(bool(found.ok))
    return Errors(np.array(errors), np.array(nees), np.array(ok))


def _accuracy(key: str, road: Road, wrong_pitch: float, count: int) -> Iterator[Metric]:
    found = trials(road, wrong_pitch, count)
    offset, heading, curvature, _ = np.median(np.abs(found.values), axis=0)
    yield Metric(f"{key}.offset", 100.0 * offset, "cm", "lower", ACCURACY)
    yield Metric(f"{key}.heading", 1e3 * heading, "mrad", "lower", ACCURACY)
    yield Metric(f"{key}.curvature", 1e4 * curvature, "1e-4/m", "lower", ACCURACY)
    yield Metric(f"{key}.ok", float(np.mean(found.ok)), "share", "higher", ACCURACY)
    yield Metric(f"{key}.nees", float(np.median(found.nees)), "of 2.37 (median)", "equal")


def _time(repeats: int, batch: int) -> Iterator[Metric]:
    road = Road()
    template = template_of(road)
    picture = jnp.asarray(render(road, jl.lanes.Lane(0.3, 0.01, 1e-3), GROUND, travelled=100.0))
    grid = GroundGrid.for_speed(SPEED)

    def whole(picture, template):
        return ralph.estimate(inverse_perspective(GROUND, picture, grid), template)

    def narrow(picture, template):
        near = ralph.Hypotheses.around(
            ralph.LaneFit(0.25, 0.012, 8e-4), curvature=6e-4, heading=0.015, pitch=0.006, counts=(9, 7, 3)
        )
        return ralph.estimate(inverse_perspective(GROUND, picture, grid), template, hypotheses=near)

    for key, function in (("lanes.frame", whole), ("lanes.frame.predicted", narrow)):
        program, took = compiled(function, picture, template)
        best = quickest(lambda program=program: program(picture, template), repeats)
        yield Metric(f"{key}.compile", took.wall, "s", "lower", TIME)
        yield Metric(key, 1e3 * best.wall, "ms", "lower", TIME)
        yield Metric(f"{key}.cpu", 1e3 * best.cpu, "ms", "lower", TIME)
    views = jax.vmap(lambda shift: inverse_perspective(GROUND, picture + shift, grid))(jnp.linspace(0.0, 9.0, batch))
    together = jax.jit(jax.vmap(ralph.estimate, in_axes=(0, None)))
    best = quickest(lambda: together(views, template), 1)
    yield Metric("lanes.batch", 1e3 * best.wall / batch, f"ms a road, {batch} under vmap", "lower", TIME)
    one_by_one = jax.jit(lambda views, template: jax.lax.map(lambda view: ralph.estimate(view, template), views))
    best = quickest(lambda: one_by_one(views, template), 1)
    yield Metric("lanes.map", 1e3 * best.wall / batch, f"ms a road, {batch} under lax.map", "lower", TIME)


def _adaptation(frames: int) -> Iterator[Metric]:
    """A slow drift of the looks, and an abrupt change: errors at the end of a drive, by kind of template."""
    old = Road(shadows=None)
    other = Road(
        marks=(),
        streaks=(Streak(1.35, 0.15, 20.0), Streak(-0.2, 0.3, -18.0), Streak(-1.25, 0.2, 16.0)),
        asphalt=80.0,
        edges=(4.4, -3.6),
        grass=120.0,
        shadows=None,
        seed=7,
    )
    scenes = (("drift", 0.2 * frames, 0.6 * frames), ("abrupt", 0.4 * frames, 0.1))
    kinds = (("fixed", ralph.Fixed()), ("blended", ralph.Blended()), ("predictive", ralph.Predictive()))
    for scene, start, length in scenes:
        road = old.followed_by(other, start, length)
        trip = drive(road, GROUND, frames, course=Course(interval=0.05), shape=SHAPE)
        views = [view_of(picture) for picture in trip.frames()]
        for kind, adaptation in kinds:
            errors, believed = follow(trip, views, adaptation)
            late = slice(-max(frames // 10, 1), None)
            watched = None if kind == "fixed" else ACCURACY
            yield Metric(f"lanes.{scene}.{kind}", 100.0 * np.median(errors[late]), "cm", "lower", watched)
            yield Metric(f"lanes.{scene}.{kind}.ok", float(np.mean(believed[late])), "share", "higher", watched)


def follow(trip: RoadDrive, views: list[GroundView], adaptation: ralph.Adaptation) -> tuple[np.ndarray, np.ndarray]:
    """How far the offset is off at each image of a drive, and whether the lane was believed.

    The vehicle's odometry carries the lane from image to image, also where the road looks like nothing known.
    """
    fit, errors, believed = ralph.LaneFit(*trip.lanes[0, :3]), [], []
    template = ralph.capture(views[0], fit)
    interval = trip.times[1] - trip.times[0]
    for view, lane, speed, yaw_rate in zip(views, trip.lanes, trip.speeds, trip.yaw_rates, strict=True):
        tried = ralph.Hypotheses.around(fit, curvature=4e-4, heading=0.012, pitch=0.006, offset=0.4, counts=(9, 7, 5))
        found = ralph.estimate(view, template, hypotheses=tried)
        value = found.estimate.value
        # A lane does not jump: what is far from the prediction belongs to something else.
        near = (abs(value.offset - fit.offset) < 0.15) & (abs(value.heading - fit.heading) < 0.01)
        ok = found.ok & near
        fit = jax.tree.map(lambda new, old, ok=ok: jnp.where(ok, new, old), value, fit)
        template = adaptation.adapt(template, view, fit, jnp.array(True))
        errors.append(float(fit.offset) - lane[0])
        believed.append(bool(ok))
        later = fit.lane().advance(jnp.float32(speed * interval), jnp.float32(yaw_rate * interval))
        fit = ralph.LaneFit(later.offset, later.heading, later.curvature, fit.pitch)
    return np.abs(errors), np.array(believed)
