"""Metrics and report of a floor mosaic."""

from typing import Any

import numpy as np
from jaxtyping import Float64

from jaxloc.cli import results
from jaxloc.evaluation import plots, report
from jaxloc.poses.planar import relative_poses

_MOST_COLUMNS = 1200  # of the mosaic in the report


class Record:
    """Results of a run.

    Args:
        names: of the images.
        times: their stamps, s.
        odometry: (x, y, heading) of the camera by odometry, m and rad.
        built: the mosaic.
    """

    def __init__(self, names: tuple[str, ...], times: np.ndarray, odometry: Float64[np.ndarray, "n 3"], built: Any):
        self.names, self.times, self.odometry, self.built = names, times, odometry, built
        self.interrupted = False

    def residuals(self, *, closes: bool) -> np.ndarray:
        """Number of the later image and distance of each accepted registration from the final poses, px."""
        poses, resolution = self.built.poses, float(self.built.mosaic.raster.resolution)
        rows = []
        for pair in self.built.pairs:
            if pair.ok and pair.closes == closes:
                final = relative_poses(poses[pair.first][None], poses[pair.second][None])
                error = relative_poses(final, pair.motion[None])[0]
                rows.append((pair.second, np.hypot(error[0], error[1]) / resolution))
        return np.array(rows).reshape(-1, 2)

    def metrics(self) -> dict[str, Any]:
        """The numbers of metrics.json: SI units, or the unit in the name."""
        built, raster = self.built, self.built.mosaic.raster
        accepted = [pair for pair in built.pairs if pair.ok]
        steps = np.linalg.norm(np.diff(built.poses[:, :2], axis=0), axis=1)
        moved = np.linalg.norm(built.poses[:, :2] - built.before_closure[:, :2], axis=1)
        sigma = np.sqrt(np.maximum(built.covariances[:, 0, 0] + built.covariances[:, 1, 1], 0.0))
        left = [row[1] for closes in (False, True) for row in self.residuals(closes=closes)]
        return results.finite(
            {
                "images": len(self.names),
                "images_used": int(built.used.sum()),
                "left_out": [self.names[number] for number in built.left_out],
                "registrations": len(accepted),
                "registrations_refused": len(built.pairs) - len(accepted),
                "loop_closures": sum(pair.closes for pair in accepted),
                "graph_solved": bool(built.ok),
                "interrupted": self.interrupted,
                "resolution_m": float(raster.resolution),
                "rows": int(raster.shape[0]),
                "columns": int(raster.shape[1]),
                "distance_m": float(steps.sum()),
                "area_m2": float(np.asarray(built.mosaic.known).sum() * float(raster.resolution) ** 2),
                "median_residual_px": float(np.median(left)) if left else None,
                "max_residual_px": float(np.max(left)) if left else None,
                "moved_by_closure_px": float(moved.max() / float(raster.resolution)),
                "max_sigma_m": float(sigma[built.used].max()) if built.used.any() else None,
            }
        )

    def page(self, metrics: dict[str, Any]) -> str:
        """The report as HTML."""
        figure = plots.draw_map_path(self._image(), self.built.poses, self.odometry, self.built.used)
        text = "The mosaic with the path of the camera; the reference is its odometry, dots are images left out."
        sections = [report.Section("Mosaic", text, figure, raster=True)]
        sections += self._residual_sections()
        if metrics["left_out"]:
            rows = tuple((str(number), self.names[number]) for number in self.built.left_out)
            text = "Images that could not be registered; their poses are those of the odometry."
            sections.append(report.Section("Left out", text, table=report.Table(("number", "image"), rows)))
        sections.append(results.numbers_section(metrics))
        summary = f"{metrics['images_used']} of {metrics['images']} images, {metrics['loop_closures']} loop closures."
        return report.render_report("Floor mosaic", sections, summary=summary, highlights=_highlights(metrics))

    def _image(self) -> plots.MapImage:
        mosaic = self.built.mosaic
        every = max(1, -(-max(mosaic.raster.shape) // _MOST_COLUMNS))
        values, known = (np.asarray(part)[::every, ::every] for part in (mosaic.values, mosaic.known))
        gray = np.where(known, np.clip(values / 255.0, 0.0, 1.0), 1.0)
        x, y = (float(number) for number in mosaic.raster.origin)
        return plots.MapImage(gray, (x, y, 0.0), every * float(mosaic.raster.resolution))

    def _residual_sections(self) -> list[report.Section]:
        begin = self.times - self.times[0]
        curves = {}
        for closes, name in ((False, "neighbors"), (True, "loop closures")):
            rows, values = self.residuals(closes=closes), np.full(len(self.names), np.nan)
            for number, error in rows:
                values[int(number)] = np.fmax(values[int(number)], error)
            curves[name] = values
        sigma = np.sqrt(np.maximum(self.built.covariances[:, 0, 0] + self.built.covariances[:, 1, 1], 0.0))
        return [
            report.Section(
                "Residuals",
                "Distance between each registration and the final poses.",
                plots.draw_curves(begin, curves, "residual (px)"),
            ),
            report.Section(
                "Uncertainty",
                "Standard deviation of each pose relative to the first image, by the pose graph.",
                plots.draw_curves(begin, {"position": 1e3 * sigma}, "sigma (mm)"),
            ),
        ]


def _highlights(metrics: dict[str, Any]) -> tuple[report.Highlight, ...]:
    wanted = (
        ("images_used", "images joined", "{:d}"),
        ("loop_closures", "loop closures", "{:d}"),
        ("median_residual_px", "median residual", "{:.3f} px"),
        ("moved_by_closure_px", "moved by closure", "{:.2f} px"),
        ("area_m2", "floor", "{:.2f} m2"),
    )
    return results.highlights(metrics, wanted)
