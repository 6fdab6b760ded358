"""Metrics and report of a camera calibration."""

from typing import Any

import numpy as np

from jaxloc.cli import results
from jaxloc.evaluation import report

_SIDES = ("left", "right")


class Record:
    """A finished calibration.

    Args:
        searches: corners found in the images, one for each camera.
        result: of the pipeline.
    """

    def __init__(self, searches: list[Any], result: Any):
        self.searches = searches
        self.result = result
        self.interrupted = False

    def skipped(self) -> list[str]:
        """A line for each image that was not used."""
        pairs = [pair for found in self.searches for pair in zip(found.paths, found.reasons, strict=True)]
        return [f"{path}: {reason}" for path, reason in pairs if reason]

    def turned(self) -> list[str]:
        """Right images in which the board was found from another end than in the left ones."""
        if self.result.turned is None:
            return []
        pairs = zip(self.searches[1].paths, self.result.turned, strict=True)
        return [str(path) for path, turned in pairs if turned]

    def metrics(self) -> dict[str, Any]:
        """The numbers of metrics.json: SI units, or the unit in the name."""
        used = [sum(corners is not None for corners in found.corners) for found in self.searches]
        squares = [(side.rms**2, count) for side, count in zip(self.result.sides, used, strict=True)]
        numbers: dict[str, Any] = {
            "images": sum(len(found.paths) for found in self.searches),
            "boards_used": sum(used),
            "skipped": self.skipped(),
            "turned": self.turned(),
            "rms_px": float(np.sqrt(sum(square * count for square, count in squares) / sum(used))),
            "steps": int(self.result.estimate.num_steps),
        }
        for side, name in zip(self.result.sides, self._names(), strict=True):
            values, sigmas = np.asarray(side.parameters.values), np.asarray(side.parameters.sigmas())
            numbers[f"{name}camera"] = dict(zip(side.parameters.names, values.tolist(), strict=True))
            numbers[f"{name}sigma"] = dict(zip(side.parameters.names, sigmas.tolist(), strict=True))
            numbers[f"{name}rms_px"] = side.rms
        if self.result.rectification is not None:
            translation = np.asarray(self.result.estimate.value.T_left_right.translation)
            numbers["baseline_m"] = float(np.linalg.norm(translation))
            numbers["rectified"] = bool(self.result.rectification.ok)
        return results.finite(numbers)

    def page(self, metrics: dict[str, Any]) -> str:
        """The report as HTML."""
        sections = []
        for side, found, name in zip(self.result.sides, self.searches, self._names(), strict=True):
            title = name.replace("_", " ").capitalize()
            text = "Values with one standard deviation; fixed parameters have none."
            sections.append(report.Section(f"{title}Parameters".strip(), text, table=_parameters(side)))
            text = "Predicted minus measured corners. Errors without a pattern are noise."
            sections.append(report.Section(f"{title}Residuals".strip(), text, _scatter(side, found)))
            text = "Root mean square of the distance between predicted and found corners."
            sections.append(report.Section(f"{title}Boards".strip(), text, table=_boards(side, found)))
        numbers = {key: value for key, value in metrics.items() if not isinstance(value, dict | list)}
        sections.append(results.numbers_section(numbers))
        first = self.result.sides[0].parameters
        focal, sigma = float(first.values[0]), float(first.sigmas()[0])
        highlights = (
            report.Highlight("reprojection error", f"{metrics['rms_px']:.3f} px"),
            report.Highlight("focal length", f"{focal:.1f} ± {sigma:.1f} px"),
            report.Highlight("boards", str(metrics["boards_used"])),
        )
        skipped = metrics["skipped"]
        summary = f"{metrics['boards_used']} of {metrics['images']} images used."
        if skipped:
            summary += " Skipped: " + "; ".join(skipped) + "."
        if metrics["turned"]:
            summary += f" Boards found from the other end, and turned: {'; '.join(metrics['turned'])}."
        title = "Stereo calibration" if len(self.searches) == 2 else "Camera calibration"
        return report.render_report(title, sections, summary=summary, highlights=highlights)

    def _names(self) -> tuple[str, ...]:
        return ("",) if len(self.searches) == 1 else tuple(f"{name}_" for name in _SIDES)


def _parameters(side: Any) -> report.Table:
    numbers = side.parameters
    rows = []
    for name, value, sigma in zip(numbers.names, np.asarray(numbers.values), np.asarray(numbers.sigmas()), strict=True):
        rows.append((name, f"{value:.6g}", f"{sigma:.2g}" if sigma > 0 else "fixed"))
    return report.Table(("parameter", "value", "standard deviation"), tuple(rows))


def _boards(side: Any, found: Any) -> report.Table:
    rows = []
    for path, reason, rms in zip(found.paths, found.reasons, side.board_rms, strict=True):
        rows.append((path.name, reason or f"{rms:.3f}"))
    return report.Table(("image", "rms (px)"), tuple(rows))


def _scatter(side: Any, found: Any) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.0), layout="constrained", facecolor="white")
    scatter, field = figure.subplots(1, 2)
    for corners, errors in zip(found.corners, side.errors, strict=True):
        if corners is not None:
            scatter.plot(errors[:, 0], errors[:, 1], ".", markersize=3, alpha=0.7)
            field.quiver(corners[:, 0], corners[:, 1], errors[:, 0], errors[:, 1], angles="xy", width=0.002)
    for axis, words in ((scatter, ("error right (px)", "error down (px)")), (field, ("column (px)", "row (px)"))):
        axis.set_xlabel(words[0])
        axis.set_ylabel(words[1])
        axis.set_aspect("equal", adjustable="box")
        axis.grid(True, color="#e6e8eb", linewidth=0.8)
    field.set_xlim(0, found.shape[1])
    field.set_ylim(found.shape[0], 0)
    return figure
