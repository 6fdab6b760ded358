"""The commands and their arguments. Everything heavy is imported when a command runs, so that help is quick."""

from pathlib import Path
from typing import Annotated

import typer

from jaxloc import __version__

app = typer.Typer(
    name="jaxloc",
    help="Robot localization and tracking: recordings in, trajectories and reports out.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

_Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results; made if it is not there.")]
_Config = Annotated[
    Path | None,
    typer.Option("--config", metavar="FILE", help="YAML file with options, such as an earlier config.yaml."),
]


def _show_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(f"jaxloc {__version__}")
        raise typer.Exit()
    return wanted


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and leave.")
    ] = False,
) -> None:
    """Robot localization and tracking: recordings in, trajectories and reports out."""


@app.command()
def odometry(
    sequence: Annotated[
        Path, typer.Argument(help="Stereo folder in KITTI layout: image_0, image_1, calib.txt, times.txt.")
    ],
    poses: Annotated[
        Path | None, typer.Option("--poses", metavar="FILE", help="True poses as KITTI rows, to measure the error.")
    ] = None,
    out: _Out = Path("out"),
    config: _Config = None,
) -> int:
    """Estimate the path of a stereo camera, with covariances.

    Writes trajectory.txt (KITTI rows, camera to world), trajectory.tum, covariance.csv, metrics.json, report.html and
    config.yaml.
    """
    from jaxloc.cli import odometry as command

    return command.run_recording(sequence, poses, out, config)


@app.command()
def demo(
    out: _Out = Path("jaxloc_demo"),
    config: _Config = None,
    frames: Annotated[int, typer.Option(min=2, help="Number of stereo frames.")] = 60,
    seed: Annotated[int, typer.Option(min=0, help="Which street.")] = 0,
) -> int:
    """Drive along a synthetic street and write a report: no data needed."""
    from jaxloc.cli import odometry as command

    return command.run_demo(out, config, num_frames=frames, seed=seed)


@app.command()
def localize(
    log: Annotated[Path, typer.Argument(help="CARMEN laser log (FLASER or ROBOTLASER1), plain, .gz or .bz2.")],
    map_path: Annotated[
        Path, typer.Option("--map", metavar="MAP.yaml", help="Occupancy map in the format of the ROS map server.")
    ],
    start: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--start", metavar="X Y THETA", help="Pose at the first scan, m and rad; anywhere by default."),
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option("--reference", metavar="FILE", help="Poses in the map (TUM format), to measure the error."),
    ] = None,
    out: _Out = Path("out"),
    config: _Config = None,
) -> int:
    """Find a robot in a map by its laser, and follow it.

    Writes trajectory.tum (times of the log, frame of the map), spread.csv, metrics.json, report.html and config.yaml.
    """
    from jaxloc.cli import localize as command

    return command.run_log(log, map_path, start, reference, out, config)
