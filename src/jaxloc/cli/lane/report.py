"""What a run of lane following says of itself: numbers for metrics.json and the page of the report."""

from typing import Any

import numpy as np
from jaxtyping import UInt8

from jaxloc.cli import results
from jaxloc.data.road_images import LaneRecording
from jaxloc.evaluation import plots, report
from jaxloc.features.opencv.backend import load

_MOST_PICTURES = 12
_SMALL = 480  # columns of an image in the report
_WARN = 1.0  # s before a line is crossed


class Record:
    """What a run has given so far.

    Args:
        recording: the images.
        pitch: as it was estimated; None if the camera's file told it.
        used: pitch that the run begins with, rad.
    """

    def __init__(self, recording: LaneRecording, pitch: Any | None, used: float):
        self.recording, self.pitch, self.used = recording, pitch, used
        self.interrupted = False
        self.names: list[str] = []
        self.times: list[float] = []
        self.steps: list[Any] = []
        self._pictures: dict[int, np.ndarray] = {}

    def add(self, name: str, time: float | None, step: Any, picture: UInt8[np.ndarray, "h w 3"]) -> None:
        """Adds an image."""
        every = max(1, -(-len(self.recording) // _MOST_PICTURES))
        if len(self.steps) % every == 0:
            height = round(picture.shape[0] * _SMALL / picture.shape[1])
            small = load().resize(picture, (_SMALL, height), interpolation=load().INTER_AREA)
            self._pictures[len(self.steps)] = small[..., ::-1]
        self.names.append(name)
        self.times.append(float(len(self.times)) if time is None else time)
        self.steps.append(step)

    def metrics(self) -> dict[str, Any]:
        """The numbers of metrics.json: SI units, or the unit in the name."""
        seen = [step for step in self.steps if step.ok]
        lanes = np.array([step.lane for step in seen]).reshape(-1, 4)
        sigma = np.array([np.sqrt(max(step.covariance[0, 0], 0.0)) for step in seen])
        estimated = self.pitch is not None and self.pitch.ok
        sources = ("start", "borders", "template", "prediction")
        return results.finite(
            {
                "frames": len(self.steps),
                "frames_of_recording": len(self.recording),
                "frames_ok": len(seen),
                "not_ok": [name for name, step in zip(self.names, self.steps, strict=True) if not step.ok],
                "interrupted": self.interrupted,
                "sources": {name: sum(step.source == name for step in self.steps) for name in sources},
                "pitch_rad": self.used,
                "pitch_estimated": estimated,
                "pitch_assumed": self.pitch is not None and not estimated,
                "pitch_sigma_rad": self.pitch.sigma if self.pitch is not None and estimated else None,
                "median_offset_m": float(np.median(lanes[:, 0])) if len(seen) else None,
                "median_curvature_per_m": float(np.median(lanes[:, 2])) if len(seen) else None,
                "median_sigma_offset_m": float(np.median(sigma)) if len(seen) else None,
                "median_width_m": float(np.median([step.width for step in seen])) if len(seen) else None,
                "median_confidence": float(np.median([step.confidence for step in seen])) if len(seen) else None,
                "least_time_to_crossing_s": float(min(step.crossing for step in seen)) if len(seen) else None,
                "departure_warnings": sum(step.crossing < _WARN for step in seen),
            }
        )

    def page(self, metrics: dict[str, Any]) -> str:
        """The page."""
        text = "The borders that the estimate implies; orange where it is only predicted."
        sections = [report.Section("Images", text, self._gallery(), raster=True)]
        sections += self._curves()
        if metrics["not_ok"]:
            rows = tuple((name,) for name in metrics["not_ok"])
            text = "Images in which the lane was not seen; the numbers of their rows are predicted."
            sections.append(report.Section("Not seen", text, table=report.Table(("image",), rows)))
        sections.append(report.Section("Numbers", "SI units, or the unit in the name.", table=results.table(metrics)))
        summary = f"{metrics['frames_ok']} of {metrics['frames']} images show the lane. {_pitch_words(metrics)}"
        if self.interrupted:
            summary += " Interrupted: the report ends with the last image that was looked at."
        title = f"Lane: {self.recording.path.name}"
        return report.render_report(title, sections, summary=summary, highlights=_highlights(metrics))

    def _gallery(self) -> Any:
        from matplotlib.figure import Figure

        columns = min(3, len(self._pictures))
        rows = -(-len(self._pictures) // columns)
        aspect = self.recording.shape[0] / self.recording.shape[1]
        figure = Figure(figsize=(10.0, rows * (10.0 / columns * aspect + 0.3)), layout="constrained", facecolor="white")
        for place, (number, picture) in enumerate(self._pictures.items(), start=1):
            plot = figure.add_subplot(rows, columns, place)
            plot.imshow(picture)
            plot.set_title(self.names[number], fontsize=7)
            plot.set_axis_off()
        return figure

    def _curves(self) -> list[report.Section]:
        if len(self.steps) < 2:
            return []
        times, seen = np.array(self.times), np.array([step.ok for step in self.steps])
        lanes = np.array([step.lane for step in self.steps])
        wanted = (
            ("Offset", "Left of the center of the lane.", 0, 1.0, "offset (m)"),
            ("Heading", "Against the lane, counter-clockwise.", 1, 1e3, "heading (mrad)"),
            ("Curvature", "Positive bends left.", 2, 1e3, "curvature (1/km)"),
        )
        sections = []
        for title, text, index, scale, label in wanted:
            values, sigma = scale * lanes[:, index], scale * self._sigmas(index)
            curves = {"seen": np.where(seen, values, np.nan), "predicted": np.where(seen, np.nan, values)}
            curves |= {"standard deviation": np.where(seen, sigma, np.nan)}
            sections.append(report.Section(title, text, plots.draw_curves(times, curves, label)))
        confidence = {"confidence": np.array([step.confidence for step in self.steps])}
        figure = plots.draw_curves(times, confidence, "confidence")
        return [*sections, report.Section("Confidence", "0 where the lane is not seen.", figure)]

    def _sigmas(self, index: int) -> np.ndarray:
        return np.sqrt(np.maximum([step.covariance[index, index] for step in self.steps], 0.0))


def _pitch_words(metrics: dict[str, Any]) -> str:
    degrees = np.degrees(metrics["pitch_rad"])
    if metrics["pitch_estimated"]:
        return f"The camera's file has no pitch_rad: estimated from the vanishing point, {degrees:.2f} degrees down."
    if metrics["pitch_assumed"]:
        return "The camera's file has no pitch_rad, and no vanishing point was found: taken as zero."
    return f"Pitch {degrees:.2f} degrees down, by the camera's file."


def _highlights(metrics: dict[str, Any]) -> tuple[report.Highlight, ...]:
    wanted = (
        ("frames_ok", "images with a lane", "{:d}"),
        ("median_offset_m", "median offset", "{:+.2f} m"),
        ("median_sigma_offset_m", "its uncertainty", "{:.3f} m"),
        ("median_width_m", "lane width", "{:.2f} m"),
        ("departure_warnings", "departure warnings", "{:d}"),
    )
    shown = [(label, form.format(metrics[name])) for name, label, form in wanted if metrics.get(name) is not None]
    return tuple(report.Highlight(label, value) for label, value in shown)
