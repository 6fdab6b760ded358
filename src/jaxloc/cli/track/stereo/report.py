"""Metrics and report of moving objects seen by a stereo camera."""

from typing import Any

import numpy as np

from jaxloc.cli import results
from jaxloc.evaluation import plots, report

_WARM_UP = 3  # frames that compile


class Record:
    """Outputs of a run so far.

    Attributes:
        title: of the report.
        outputs: of the pipeline.
        figures: numbers and figures of annotated frames.
        interrupted: whether the run ended early.
    """

    def __init__(self, title: str):
        self.title = title
        self.outputs: list[Any] = []
        self.figures: list[Any] = []
        self.interrupted = False

    def add(self, output: Any) -> None:
        """Adds a frame."""
        self.outputs.append(output)

    def paths(self) -> dict[int, np.ndarray]:
        """Frame number, position and velocity of every track: "n 7"."""
        rows: dict[int, list[np.ndarray]] = {}
        for output in self.outputs:
            for track in output.tracks:
                rows.setdefault(track.label, []).append(np.r_[output.index, track.state])
        return {label: np.array(path) for label, path in rows.items()}

    def timings(self) -> dict[str, np.ndarray]:
        """Seconds of each stage, without the frames that compile."""
        warm = [output.timings for output in self.outputs[_WARM_UP:] if "filter" in output.timings]
        return {name: np.array([one[name] for one in warm]) for name in (warm[0] if warm else {})}

    def metrics(self) -> dict[str, Any]:
        """The numbers of metrics.json: SI units, or the unit in the name."""
        paths, timings = self.paths(), self.timings()
        spent = sum(np.median(values) for values in timings.values())
        speeds = [float(np.median(np.linalg.norm(path[:, 4:], axis=1))) for path in paths.values()]
        places = np.array([np.asarray(output.odometry.pose.translation) for output in self.outputs])
        return results.finite(
            {
                "frames": len(self.outputs),
                "distance_m": float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()),
                "tracks": len(paths),
                "track_frames": sum(len(path) for path in paths.values()),
                "objects_measured": sum(len(output.objects) for output in self.outputs),
                "median_speed_m_s": float(np.median(speeds)) if speeds else None,
                "frames_per_second": 1.0 / spent if spent else None,
                "stages_ms": {name: 1e3 * float(np.median(values)) for name, values in timings.items()},
                "interrupted": self.interrupted,
            }
        )

    def page(self, metrics: dict[str, Any]) -> str:
        """The report as HTML."""
        places = np.array([np.asarray(output.odometry.pose.translation) for output in self.outputs])
        text = "Path of the camera and tracks of moving objects, in the frame of the first camera."
        sections = [report.Section("Seen from above", text, plots.draw_tracks(*self._tracks(), camera=places))]
        text = "Moving points (dots), measured objects (boxes), and tracks with their speed."
        for index, figure in self.figures:
            sections.append(report.Section(f"Frame {index}", text, figure, raster=True))
            text = ""
        if self.timings():
            text = f"Time of each stage; the first {_WARM_UP} frames, which compile, are left out."
            sections.append(report.Section("Timings", text, plots.draw_timings(self.timings())))
        sections.append(report.Section("Tracks", table=self._table()))
        sections.append(results.numbers_section(metrics))
        summary = f"{metrics['frames']} frames, {metrics['tracks']} tracks of moving objects."
        if self.interrupted:
            summary += " Interrupted: the report ends with the last frame that was processed."
        return report.render_report(self.title, sections, summary=summary)

    def _tracks(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions, numbers and validity of tracks by frame, padded."""
        room = max((len(output.tracks) for output in self.outputs), default=0)
        places, ids = np.zeros((len(self.outputs), room, 3)), np.full((len(self.outputs), room), -1)
        for i, output in enumerate(self.outputs):
            for j, track in enumerate(output.tracks):
                places[i, j], ids[i, j] = track.state[:3], track.label
        return places, ids, ids >= 0

    def _table(self) -> report.Table:
        rows = []
        for label, path in sorted(self.paths().items()):
            speeds = np.linalg.norm(path[:, 4:], axis=1)
            rows.append((str(label), f"{path[0, 0]:.0f}-{path[-1, 0]:.0f}", str(len(path)), f"{np.median(speeds):.1f}"))
        return report.Table(("track", "frames", "seen in", "median speed, m/s"), tuple(rows))
