"""Moving objects from a stereo camera: real clips where they lie beside the checkout, and a rendered street.

The tables of the thesis, for four detectors, are rows ``datmo.table_*``: 1 merging threshold, 2 missed objects, 3 cost,
4 timing [T-92]...[T-95].
"""

import csv
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxloc as jl
from benchmarks.metric import ACCURACY, REPOSITORY, TIME, Metric
from jaxloc.evaluation import consistency
from jaxloc.features import opencv
from jaxloc.pipelines import moving_objects, odometry

_CLIPS = REPOSITORY.parent / "shared" / "data" / "kitti_odometry"
_WARM_UP = 4  # frames that compile
_DETECTORS = {"shi_tomasi": opencv.ShiTomasi(), "orb": opencv.ORB(), "kaze": opencv.KAZE(), "akaze": opencv.AKAZE()}
_THRESHOLDS = (0.1, 1.0, 4.0, 16.0)  # nats
_FEWEST_PIXELS, _FARTHEST = 300, 50.0  # of an object that should be found


def metrics(smoke: bool) -> Iterator[Metric]:
    if _CLIPS.is_dir() and not smoke:
        yield from _highway()
        yield from _standing_street()
    yield from _rendered(8 if smoke else 60, ("orb",) if smoke else tuple(_DETECTORS))


def _highway() -> Iterator[Metric]:
    """KITTI 01: hand-labelled cars."""
    with (_CLIPS / "moving_cars_01.csv").open() as file:
        labels = list(csv.DictReader(file))
    sequence = jl.data.kitti.read_sequence(_CLIPS / "sequences" / "01")
    steps = list(moving_objects.run(list(sequence), moving_objects.Config(), sequence.rig))
    hits: dict[str, list[bool]] = {}
    speeds = []
    for row in labels:
        box = np.array([float(row[name]) for name in ("x1", "y1", "x2", "y2")])
        inside = [track for track in steps[int(row["frame"])].tracks if _inside(box, track.uv)]
        hits.setdefault(row["track"], []).append(bool(inside))
        speeds += [np.linalg.norm(track.state[3:]) for track in inside if row["track"] == "lead"]
    for name, found in hits.items():
        yield Metric(f"datmo.kitti_01.{name}_found", 100.0 * float(np.mean(found)), "% of labels", "higher", ACCURACY)
    yield Metric("datmo.kitti_01.lead_slowest", float(np.min(speeds)), "m/s", "equal", ACCURACY)
    yield Metric("datmo.kitti_01.lead_fastest", float(np.max(speeds)), "m/s", "equal", ACCURACY)
    yield from _times("datmo.kitti_01", steps)


def _standing_street() -> Iterator[Metric]:
    """KITTI 06: nothing moves."""
    sequence = jl.data.kitti.read_sequence(_CLIPS / "sequences" / "06")
    steps = list(moving_objects.run(list(sequence), moving_objects.Config(), sequence.rig))
    false = {track.label for step in steps for track in step.tracks}
    rate = 10.0 * len(false) / len(steps)
    yield Metric("datmo.kitti_06.false_tracks", rate, "per 10 frames", "lower", ACCURACY)
    yield from _times("datmo.kitti_06", steps)


def _times(key: str, steps: list[moving_objects.Output]) -> Iterator[Metric]:
    stages = {name: [step.timings[name] for step in steps[_WARM_UP:]] for name in steps[-1].timings}
    for name, seconds in stages.items():
        yield Metric(f"{key}.stage.{name}", 1e3 * float(np.median(seconds)), "ms")
    total = float(np.median([sum(step.timings.values()) for step in steps[_WARM_UP:]]))
    yield Metric(f"{key}.frames_per_second", 1.0 / total, "1/s", "higher", TIME)


def _rendered(num_frames: int, detectors: tuple[str, ...]) -> Iterator[Metric]:
    """A street whose moving objects are known in every frame."""
    street = jl.data.simulate_street(num_frames=num_frames, seed=0)
    frames = list(street)
    truth = [_visible(street, i) for i in range(num_frames)]
    for name in detectors:
        config = odometry.Config(detector=_DETECTORS[name])
        evidence = list(odometry.run_with_evidence(frames, config, street.rig))
        steps = list(moving_objects.run_after_odometry(evidence, moving_objects.Config(odometry=config), street.rig))
        key = f"datmo.table_2.{name}"
        found, squared = _compare(steps, truth)
        yield Metric(f"{key}.missed", 100.0 * (1.0 - found), "% of visible", "lower", ACCURACY)
        if len(squared) > 1:
            errors = consistency.SquaredErrors(jnp.asarray(squared), jnp.ones(len(squared), bool))
            fit = consistency.calibration(errors, 3)
            yield Metric(f"{key}.nees_median", float(np.median(squared)), "of 2.37", "equal", ACCURACY)
            yield Metric(f"{key}.ks_distance", float(fit.distance), "", "lower", ACCURACY)
        total = float(np.median([sum(step.timings.values()) for step in steps[_WARM_UP:]]))
        yield Metric(f"datmo.table_3.{name}.ms_a_frame", 1e3 * total, "ms", "lower", TIME)
        for stage in steps[-1].timings:
            spent = float(np.median([step.timings[stage] for step in steps[_WARM_UP:]]))
            yield Metric(f"datmo.table_4.{name}.{stage}", 100.0 * spent / total, "% of the frame")
        for threshold in _THRESHOLDS:
            merge = jl.beliefs.KullbackLeibler(threshold)
            steps = list(
                moving_objects.run_after_odometry(
                    evidence, moving_objects.Config(odometry=config, merge=merge), street.rig
                )
            )
            key = f"datmo.table_1.{name}.{threshold:g}_nats".replace("0.1", "01")
            yield Metric(f"{key}.missed", 100.0 * (1.0 - _compare(steps, truth)[0]), "% of visible", "lower", ACCURACY)
            labels = {track.label for step in steps for track in step.tracks}
            yield Metric(f"{key}.tracks", len(labels), "tracks", "equal", ACCURACY)


def _visible(street: Any, index: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Center of the visible part, and mean velocity, of each object that should be found in a frame."""
    frame, camera = street.render(index), street.rig.camera
    found = []
    for item in street.objects:
        rows, columns = np.nonzero(frame.instances == item.instance)
        depth = frame.depth[rows, columns]
        if len(rows) < _FEWEST_PIXELS or depth.mean() > _FARTHEST:
            continue
        rays = np.stack([(columns - float(camera.cx)) / float(camera.fx), (rows - float(camera.cy)) / float(camera.fy)])
        center = np.r_[(rays * depth).mean(axis=1), depth.mean(), 1.0]
        before, after = max(index - 1, 0), min(index + 1, len(street) - 1)
        moved = item.poses[after][:3, 3] - item.poses[before][:3, 3]
        velocity = moved / (street.times[after] - street.times[before])
        found.append(((street.matrices[index] @ center)[:3], velocity))
    return found


def _compare(
    steps: list[moving_objects.Output], truth: list[list[tuple[np.ndarray, np.ndarray]]]
) -> tuple[float, np.ndarray]:
    """Share of the visible objects that a track is at, and squared position errors in sigmas of these."""
    hits, squared = [], []
    for step in steps[2:]:
        for place, _ in truth[step.index]:
            near = [t for t in step.tracks if np.linalg.norm(t.state[:3] - place) < 3.0 + 0.1 * place[2]]
            hits.append(bool(near))
            for track in near[:1]:
                error = track.state[:3] - place
                squared.append(error @ np.linalg.solve(track.covariance[:3, :3], error))
    return float(np.mean(hits)) if hits else 0.0, np.array(squared)


def _inside(box: np.ndarray, uv: np.ndarray) -> bool:
    return bool(np.all(uv > box[:2] - 6.0) and np.all(uv < box[2:] + 6.0))
