"""Metrics and report of lane following."""

from typing import Any

import numpy as np
from jaxtyping import UInt8

from jaxloc.cli import results
from jaxloc.data.road_images import LaneRecording
from jaxloc.evaluation import plots, report
from jaxloc.features.opencv.backend import load

_MOST_IMAGES = 12
_SMALL = 480  # columns of an image in the report
_WARN = 1.0  # s before a line is crossed


class Record:
    """Outputs of a run so far.

    Args:
        recording: the images.
        pitch: estimated pitch; None if the camera's file has one.
        used: pitch that the run begins with, rad.
    """

    def __init__(self, recording: LaneRecording, pitch: Any | None, used: float):
        self.recording, self.pitch, self.used = recording, pitch, used
        self.interrupted = False
        self.names: list[str] = []
        self.times: list[float] = []
        self.outputs: list[Any] = []
        self._images: dict[int, np.ndarray] = {}

    def add(self, name: str, time: float | None, output: Any, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Adds an image."""
        every = max(1, -(-len(self.recording) // _MOST_IMAGES))
        if len(self.outputs) % every == 0:
            height = round(image.shape[0] * _SMALL / image.shape[1])
            small = load().resize(image, (_SMALL, height), interpolation=load().INTER_AREA)
            self._images[len(self.outputs)] = small[..., ::-1]
        self.names.append(name)
        self.times.append(float(len(self.times)) if time is None else time)
        self.outputs.append(output)

    def metrics(self) -> dict[str, Any]:
        """The numbers of metrics.json: SI units, or the unit in the name."""
        measured = [output for output in self.outputs if output.ok]
        lanes = np.array([output.lane for output in measured]).reshape(-1, 4)
        sigma = np.array([np.sqrt(max(output.covariance[0, 0], 0.0)) for output in measured])
        estimated = self.pitch is not None and self.pitch.ok
        sources = ("start", "borders", "template", "prediction")
        return results.finite(
            {
                "frames": len(self.outputs),
                "frames_of_recording": len(self.recording),
                "frames_ok": len(measured),
                "not_ok": [name for name, output in zip(self.names, self.outputs, strict=True) if not output.ok],
                "interrupted": self.interrupted,
                "sources": {name: sum(output.source == name for output in self.outputs) for name in sources},
                "pitch_rad": self.used,
                "pitch_estimated": estimated,
                "pitch_assumed": self.pitch is not None and not estimated,
                "pitch_sigma_rad": self.pitch.sigma if self.pitch is not None and estimated else None,
                "median_offset_m": float(np.median(lanes[:, 0])) if len(measured) else None,
                "median_curvature_per_m": float(np.median(lanes[:, 2])) if len(measured) else None,
                "median_sigma_offset_m": float(np.median(sigma)) if len(measured) else None,
                "median_width_m": float(np.median([output.width for output in measured])) if len(measured) else None,
                "median_confidence": float(np.median([output.confidence for output in measured]))
                if len(measured)
                else None,
                "least_time_to_crossing_s": float(min(output.crossing for output in measured))
                if len(measured)
                else None,
                "departure_warnings": sum(output.crossing < _WARN for output in measured),
            }
        )

    def page(self, metrics: dict[str, Any]) -> str:
        """The report as HTML."""
        text = "Borders of the estimated lane; orange where it is only predicted."
        sections = [report.Section("Images", text, self._gallery(), raster=True)]
        sections += self._curves()
        if metrics["not_ok"]:
            rows = tuple((name,) for name in metrics["not_ok"])
            text = "Images in which the lane was not measured; the values of their rows are predicted."
            sections.append(report.Section("Not measured", text, table=report.Table(("image",), rows)))
        sections.append(results.numbers_section(metrics))
        summary = (
            f"{metrics['frames_ok']} of {metrics['frames']} images with a measured lane. {_describe_pitch(metrics)}"
        )
        if self.interrupted:
            summary += " Interrupted: the report ends with the last image that was processed."
        title = f"Lane: {self.recording.path.name}"
        return report.render_report(title, sections, summary=summary, highlights=_highlights(metrics))

    def _gallery(self) -> Any:
        from matplotlib.figure import Figure

        columns = min(3, len(self._images))
        rows = -(-len(self._images) // columns)
        aspect = self.recording.shape[0] / self.recording.shape[1]
        figure = Figure(figsize=(10.0, rows * (10.0 / columns * aspect + 0.3)), layout="constrained", facecolor="white")
        for place, (number, image) in enumerate(self._images.items(), start=1):
            plot = figure.add_subplot(rows, columns, place)
            plot.imshow(image)
            plot.set_title(self.names[number], fontsize=7, parse_math=False)
            plot.set_axis_off()
        return figure

    def _curves(self) -> list[report.Section]:
        if len(self.outputs) < 2:
            return []
        times, measured = np.array(self.times), np.array([output.ok for output in self.outputs])
        lanes = np.array([output.lane for output in self.outputs])
        wanted = (
            ("Offset", "Distance to the left of the center of the lane.", 0, 1.0, "offset (m)"),
            ("Heading", "Relative to the lane, counter-clockwise.", 1, 1e3, "heading (mrad)"),
            ("Curvature", "Positive to the left.", 2, 1e3, "curvature (1/km)"),
        )
        sections = []
        for title, text, index, scale, label in wanted:
            values, sigma = scale * lanes[:, index], scale * self._sigmas(index)
            curves = {"measured": np.where(measured, values, np.nan), "predicted": np.where(measured, np.nan, values)}
            curves |= {"standard deviation": np.where(measured, sigma, np.nan)}
            sections.append(report.Section(title, text, plots.draw_curves(times, curves, label)))
        confidence = {"confidence": np.array([output.confidence for output in self.outputs])}
        figure = plots.draw_curves(times, confidence, "confidence")
        return [*sections, report.Section("Confidence", "0 where the lane is not measured.", figure)]

    def _sigmas(self, index: int) -> np.ndarray:
        return np.sqrt(np.maximum([output.covariance[index, index] for output in self.outputs], 0.0))


def _describe_pitch(metrics: dict[str, Any]) -> str:
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
    return results.highlights(metrics, wanted)
