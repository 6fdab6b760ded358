"""What a run of the tracker of detections says of itself: numbers for metrics.json and the page of the report."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxloc.cli import results
from jaxloc.data.tracking import Detections, LabelledTracks
from jaxloc.evaluation import plots, report, targets
from jaxloc.evaluation.targets import mot_metrics

_SOLID_CUTOFF, _BOX_CUTOFF = 5.0, 50.0  # of GOSPA and OSPA: m, px
_SOLID_REACH = 2.0  # of the similarity of solids, m


class Record:
    """What a run has given.

    Args:
        title: of the report.
        found: what the detector found.
        tracked: what the pipeline made of it.
        boxes: "t k 4" of the tracks, px.
        boxed: which of the tracks have a box.
        truth: true tracks.
        cameras: T_world_camera, where known.
        seconds: that the first pass took, compiling included, and the second.
    """

    def __init__(
        self,
        title: str,
        found: Detections,
        tracked: Any,
        boxes: Float64[np.ndarray, "t k 4"],
        boxed: Bool[np.ndarray, "t k"],
        *,
        truth: LabelledTracks | None = None,
        cameras: Float64[np.ndarray, "t 4 4"] | None = None,
        seconds: tuple[float, float] = (0.0, 0.0),
    ):
        self.title, self.found, self.tracked, self.truth = title, found, tracked, truth
        self.boxes, self.boxed, self.cameras, self.seconds = boxes, boxed, cameras, seconds

    @property
    def solid(self) -> bool:
        """Whether places are in the world, and not in images."""
        return self.found.positions is not None

    def tracks(self) -> LabelledTracks:
        """The tracks with their boxes, as they are written in the format of the MOT challenge."""
        tracked, found = self.tracked, self.found
        frames = found.frames + (1 if found.frames[0] == 0 else 0)
        existence = np.minimum(tracked.existence, 1.0)
        types = np.where(self.boxed, 0, -1)
        nothing = np.zeros(len(tracked), np.int64)
        boxes = Detections(frames, found.times, self.boxed, self.boxes, existence, types, ("object",), nothing)
        return LabelledTracks(boxes, np.where(self.boxed, tracked.ids, -1))

    def lengths(self) -> Int64[np.ndarray, " n"]:
        """In how many frames each track is spoken of."""
        return np.unique(self.tracked.ids[self.tracked.valid], return_counts=True)[1]

    def metrics(self) -> dict[str, Any]:
        """The numbers of metrics.json: SI units, or the unit in the name."""
        tracked, found, lengths = self.tracked, self.found, self.lengths()
        missed = tracked.slots[tracked.valid] < 0
        numbers: dict[str, Any] = {
            "frames": len(tracked),
            "detections": int(found.valid.sum()),
            "detections_left_out": int(found.left_out.sum()),
            "tracks": len(lengths),
            "track_frames": int(lengths.sum()),
            "track_frames_missed": int(missed.sum()),
            "median_track_frames": float(np.median(lengths)) if len(lengths) else 0.0,
            "tracks_without_room": int(tracked.crowded.sum()),
            "seconds_with_compiling": self.seconds[0],
            "frames_per_second": len(tracked) / max(self.seconds[1], 1e-9),
        }
        if self.truth is not None:
            numbers |= self._accuracy(self.truth)
        return results.finite(numbers)

    def _accuracy(self, truth: LabelledTracks) -> dict[str, Any]:
        """GOSPA and OSPA of places, on average over frames; HOTA, MOTA and IDF1 of points or boxes."""
        there, tracked = truth.detections, self.tracked
        cutoff = _SOLID_CUTOFF if self.solid else _BOX_CUTOFF
        mine, true = (
            (tracked.places, there.positions) if self.solid else (tracked.places[..., :2], centers(there.boxes))
        )
        sets = jnp.asarray(mine, float), jnp.asarray(tracked.valid), jnp.asarray(true, float), jnp.asarray(there.valid)
        gospa = jax.vmap(lambda *four: targets.gospa(*four, cutoff=cutoff))(*sets)
        ospa = jax.vmap(lambda *four: targets.ospa(*four, cutoff=cutoff))(*sets)
        similarity = mot_metrics.PointDistance(_SOLID_REACH) if self.solid else mot_metrics.BoxOverlap()
        one, other = (there.positions, tracked.places) if self.solid else (there.boxes, self.boxes)
        pairs = mot_metrics.compare(
            one, truth.ids, there.valid, other, tracked.ids, tracked.valid, similarity=similarity
        )
        hota, clear, idf1 = mot_metrics.hota(pairs).mean(), mot_metrics.clear_mot(pairs), mot_metrics.id_f1(pairs)
        unit = "m" if self.solid else "px"
        return {
            "true_tracks": len(truth.identities()),
            f"gospa_{cutoff:g}{unit}": float(gospa.distance.mean()),
            f"ospa_{cutoff:g}{unit}": float(ospa.distance.mean()),
            "missed_targets": int(gospa.num_missed.sum()),
            "false_targets": int(gospa.num_false.sum()),
            "hota": float(hota.hota),
            "hota_detection": float(hota.det_a),
            "hota_association": float(hota.ass_a),
            "mota": clear.mota,
            "idf1": idf1.f1,
            "switches": clear.switches,
        }

    def page(self, metrics: dict[str, Any]) -> str:
        """The report."""
        sections = [self._map(), self._numbers()]
        sections.append(report.Section("Numbers", "SI units, or the unit in the name.", table=results.table(metrics)))
        summary = f"{metrics['detections']} detections in {metrics['frames']} frames, {metrics['tracks']} tracks."
        return report.render_report(self.title, sections, summary=summary, highlights=_highlights(metrics))

    def _map(self) -> report.Section:
        tracked, truth = self.tracked, self.truth
        shades = {}
        if truth is not None:
            there = truth.detections
            true = there.positions if self.solid else centers(there.boxes)
            shades = {"truth": true, "truth_valid": there.valid}
        if self.solid:
            camera = None if self.cameras is None else self.cameras[: len(tracked), :3, 3]
            figure = plots.draw_tracks(tracked.places, tracked.ids, tracked.valid, camera=camera, **shades)
            return report.Section("Tracks", "From above, in the frame of the first camera.", figure)
        centered = tracked.places[..., :2]
        axes = {"axes": (0, 1), "unit": "px", "downwards": True}
        figure = plots.draw_tracks(centered, tracked.ids, tracked.valid, **axes, **shades)
        return report.Section("Tracks", "Centers of the boxes in the image.", figure)

    def _numbers(self) -> report.Section:
        true = None if self.truth is None else self.truth.detections.valid.sum(axis=1)
        figure = plots.draw_counts(self.found.times, self.tracked.valid.sum(axis=1), true)
        return report.Section("Number of targets", "Tracks that are spoken of in each frame.", figure)


def centers(boxes: Float64[np.ndarray, "t k 4"]) -> Float64[np.ndarray, "t k 2"]:
    """Centers of boxes (left, top, right, bottom)."""
    return 0.5 * (boxes[..., :2] + boxes[..., 2:])


def _highlights(metrics: dict[str, Any]) -> tuple[report.Highlight, ...]:
    wanted = (
        ("tracks", "tracks", "{:d}"),
        ("hota", "HOTA", "{:.3f}"),
        ("mota", "MOTA", "{:.3f}"),
        ("idf1", "IDF1", "{:.3f}"),
        ("frames_per_second", "frames a second", "{:.0f}"),
    )
    shown = [(label, form.format(metrics[name])) for name, label, form in wanted if metrics.get(name) is not None]
    return tuple(report.Highlight(label, value) for label, value in shown)
