"""Metrics and report of tracking by detection."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64

from jaxloc.cli import results
from jaxloc.data.tracking import Detections, LabeledTracks
from jaxloc.evaluation import plots, report, targets
from jaxloc.evaluation.targets import mot_metrics
from jaxloc.pipelines.detection_tracking import Tracks, stack

_POSITION_CUTOFF, _BOX_CUTOFF = 5.0, 50.0  # of GOSPA and OSPA: m, px
_POSITION_SCALE = 2.0  # distance at which the similarity of positions is zero, m
_COMPILING = 128  # frames of the first scan, which is compiled


class Record:
    """Outputs of a run so far.

    Args:
        title: of the report.
        found: the detections.
        truth: true tracks.
        cameras: T_world_camera, where known.
        offset: of the frame of positions in that of the results, m.
    """

    def __init__(
        self,
        title: str,
        found: Detections,
        *,
        truth: LabeledTracks | None = None,
        cameras: Float64[np.ndarray, "t 4 4"] | None = None,
        offset: Float64[np.ndarray, " d"],
    ):
        self.title, self.found, self.truth, self.cameras, self.offset = title, found, truth, cameras, offset
        self.interrupted = False
        self.outputs: list[Any] = []
        self.boxes: list[list[np.ndarray | None]] = []
        self.seconds: list[float] = []
        self._last: dict[int, np.ndarray] = {}

    def add(self, seconds: float, output: Any) -> None:
        """Adds a frame.

        Args:
            seconds: since the last one.
            output: of the pipeline.
        """
        frame = len(self.outputs)
        self.seconds.append(seconds)
        self.outputs.append(output)
        self.boxes.append([self._box(frame, output, slot) for slot in range(len(output))])

    def _box(self, frame: int, output: Any, slot: int) -> np.ndarray | None:
        """Box of a track in the image: its own, or that of its last detection."""
        if not self.in_world:
            center, sides = output.places[slot, :2], np.maximum(output.places[slot, 2:], 1.0)
            return np.concatenate([center - 0.5 * sides, center + 0.5 * sides])
        identity, detection = int(output.ids[slot]), int(output.detections[slot])
        if detection >= 0:
            self._last[identity] = self.found.boxes[frame, detection]
        return self._last.get(identity)

    @property
    def in_world(self) -> bool:
        """Whether tracks have positions in the world, and not boxes in images."""
        return self.found.positions is not None

    def tracks(self) -> Tracks:
        """All tracks as one table."""
        return stack(self.outputs)

    def box_table(self) -> tuple[Float64[np.ndarray, "t k 4"], Bool[np.ndarray, "t k"]]:
        """Boxes of the tracks as a table, and which tracks have one."""
        room = max(len(row) for row in self.boxes)
        boxes, valid = np.zeros((len(self.boxes), room, 4)), np.zeros((len(self.boxes), room), bool)
        for frame, row in enumerate(self.boxes):
            for slot, box in enumerate(row):
                if box is not None:
                    boxes[frame, slot], valid[frame, slot] = box, True
        return boxes, valid

    def labeled_tracks(self) -> LabeledTracks:
        """The tracks with their boxes, as they are written in the format of the MOT challenge."""
        tracks, found, (boxes, valid) = self.tracks(), self.found, self.box_table()
        count = len(tracks)
        frames = found.frames[:count] + (1 if found.frames[0] == 0 else 0)
        existence, types = np.minimum(tracks.existence, 1.0), np.where(valid, 0, -1)
        none = np.zeros(count, np.int64)
        detections = Detections(frames, found.times[:count], valid, boxes, existence, types, ("object",), none)
        return LabeledTracks(detections, np.where(valid, tracks.ids, -1))

    def metrics(self) -> dict[str, Any]:
        """The numbers of metrics.json: SI units, or the unit in the name."""
        tracks, found = self.tracks(), self.found
        lengths = np.unique(tracks.ids[tracks.valid], return_counts=True)[1]
        later = self.seconds[_COMPILING:]
        numbers: dict[str, Any] = {
            "frames": len(tracks),
            "frames_of_recording": len(found),
            "interrupted": self.interrupted,
            "detections": int(found.valid[: len(tracks)].sum()),
            "detections_left_out": int(found.left_out[: len(tracks)].sum()),
            "tracks": len(lengths),
            "track_frames": int(lengths.sum()),
            "track_frames_missed": int((tracks.detections[tracks.valid] < 0).sum()),
            "median_track_frames": float(np.median(lengths)) if len(lengths) else 0.0,
            "tracks_over_capacity": int(tracks.num_dropped.sum()),
            "seconds_with_compiling": sum(self.seconds),
            "frames_per_second": len(later) / max(sum(later), 1e-9) if later else None,
        }
        if self.truth is not None:
            numbers |= self._accuracy(tracks, self.truth)
        return results.finite(numbers)

    def _accuracy(self, tracks: Tracks, truth: LabeledTracks) -> dict[str, Any]:
        """Means of GOSPA and OSPA over frames; HOTA, MOTA and IDF1 of positions or boxes."""
        count, world = len(tracks), self.in_world
        cutoff = _POSITION_CUTOFF if world else _BOX_CUTOFF
        there = truth.detections
        ids, present, true_boxes = (values[:count] for values in (truth.ids, there.valid, there.boxes))
        mine, true = (tracks.places if world else tracks.places[..., :2]), self._true_positions(count)
        sets = jnp.asarray(mine, float), jnp.asarray(tracks.valid), jnp.asarray(true, float), jnp.asarray(present)
        gospa = jax.vmap(lambda *four: targets.gospa(*four, cutoff=cutoff))(*sets)
        ospa = jax.vmap(lambda *four: targets.ospa(*four, cutoff=cutoff))(*sets)
        similarity = mot_metrics.PointDistance(_POSITION_SCALE) if world else mot_metrics.BoxOverlap()
        one, other = (true, mine) if world else (true_boxes, self.box_table()[0])
        pairs = mot_metrics.compare(one, ids, present, other, tracks.ids, tracks.valid, similarity=similarity)
        hota, clear, idf1 = mot_metrics.hota(pairs).mean(), mot_metrics.clear_mot(pairs), mot_metrics.id_f1(pairs)
        unit = "m" if world else "px"
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
        """The report as HTML."""
        sections = [self._map(), self._counts()]
        sections.append(results.numbers_section(metrics))
        summary = f"{metrics['detections']} detections in {metrics['frames']} frames, {metrics['tracks']} tracks."
        if self.interrupted:
            summary += " Interrupted: the report ends with the last frame that was processed."
        return report.render_report(self.title, sections, summary=summary, highlights=_highlights(metrics))

    def _true_positions(self, count: int) -> np.ndarray:
        """True positions in the world, or centers of the boxes, of the first frames."""
        there = None if self.truth is None else self.truth.detections
        if there is None:
            return np.zeros((count, 0, 3))
        positions = there.positions if self.in_world and there.positions is not None else centers(there.boxes)
        return positions[:count]

    def _map(self) -> report.Section:
        tracks = self.tracks()
        count, truth = len(tracks), {}
        if self.truth is not None:
            truth = {"truth": self._true_positions(count), "truth_valid": self.truth.detections.valid[:count]}
        if self.in_world:
            camera = None if self.cameras is None else self.cameras[:count, :3, 3]
            figure = plots.draw_tracks(tracks.places, tracks.ids, tracks.valid, camera=camera, **truth)
            return report.Section("Tracks", "From above, in the frame of the first camera.", figure)
        axes = {"axes": (0, 1), "unit": "px", "downwards": True}
        figure = plots.draw_tracks(tracks.places[..., :2], tracks.ids, tracks.valid, **axes, **truth)
        return report.Section("Tracks", "Centers of the boxes in the image.", figure)

    def _counts(self) -> report.Section:
        counts = np.array([len(output) for output in self.outputs])
        true = None if self.truth is None else self.truth.detections.valid[: len(counts)].sum(axis=1)
        figure = plots.draw_counts(self.found.times[: len(counts)], counts, true)
        return report.Section("Number of targets", "Reported tracks in each frame.", figure)


def centers(boxes: Float64[np.ndarray, "*n 4"]) -> Float64[np.ndarray, "*n 2"]:
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
    return results.highlights(metrics, wanted)
