"""Commands and their arguments. Heavy modules are imported when a command runs, so that help is quick."""

from pathlib import Path
from typing import Annotated, Any

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
_Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="NAME=VALUE", help="An option, such as motion.pitch=0.01; may be repeated."),
]


_SHOW_HELP = "Print the default options as YAML and leave."


def _print_defaults(name: str) -> None:
    """Prints the default options of a command as YAML."""
    from importlib import import_module

    from jaxloc.cli import options

    command = import_module(f"jaxloc.cli.{name}.command")
    typer.echo(options.format_options(command.default_config()), nl=False)


def _show_option(name: str) -> Any:
    """The option that prints a command's default options and leaves, whatever else is given."""

    def show(wanted: bool) -> bool:
        if wanted:
            _print_defaults(name)
            raise typer.Exit()
        return wanted

    return typer.Option("--show-config", callback=show, is_eager=True, help=_SHOW_HELP)


def _arguments(out: Path, config: Path | None, settings: list[str] | None) -> Any:
    from jaxloc.cli.lifecycle import Arguments

    return Arguments(out, config, tuple(settings or ()))


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
    settings: _Set = None,
    show_config: Annotated[bool, _show_option("odometry")] = False,
) -> int:
    """Estimate the path of a stereo camera, with covariances.

    Writes trajectory.txt (KITTI rows, camera to world), trajectory.tum, covariance.csv, metrics.json, report.html and
    config.yaml.
    """
    from jaxloc.cli.odometry import command

    return command.run_recording(sequence, poses, _arguments(out, config, settings))


@app.command()
def demo(
    out: _Out = Path("jaxloc_demo"),
    config: _Config = None,
    settings: _Set = None,
    show_config: Annotated[bool, _show_option("odometry")] = False,
    frames: Annotated[int, typer.Option(min=2, help="Number of stereo frames.")] = 60,
    seed: Annotated[int, typer.Option(min=0, help="Of the street.")] = 0,
) -> int:
    """Run stereo odometry and tracking of moving objects on a synthetic street: no data needed."""
    from jaxloc.cli.odometry import command

    return command.run_demo(_arguments(out, config, settings), num_frames=frames, seed=seed)


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
    settings: _Set = None,
    show_config: Annotated[bool, _show_option("localize")] = False,
) -> int:
    """Localize a robot in a map by its laser scans.

    Writes trajectory.tum (times of the log, frame of the map), spread.csv, metrics.json, report.html and config.yaml.
    """
    from jaxloc.cli.localize import command

    return command.run_log(log, map_path, start, reference, _arguments(out, config, settings))


@app.command()
def track(
    sequence: Annotated[
        Path | None, typer.Argument(help="Stereo folder in KITTI layout: image_0, image_1, calib.txt, times.txt.")
    ] = None,
    detections: Annotated[
        Path | None,
        typer.Option(
            "--detections", metavar="FILE", help="Detections of any detector, in place of a SEQUENCE: KITTI or MOT."
        ),
    ] = None,
    poses: Annotated[
        Path | None, typer.Option("--poses", metavar="FILE", help="Camera poses as KITTI rows, camera to world.")
    ] = None,
    calib: Annotated[
        Path | None, typer.Option("--calib", metavar="FILE", help="KITTI tracking calibration, for u and v of tracks.")
    ] = None,
    form: Annotated[
        str, typer.Option("--format", metavar="NAME", help="Of --detections: auto, kitti or mot.")
    ] = "auto",
    tracker: Annotated[
        str, typer.Option("--tracker", metavar="NAME", help="For --detections: gmphd, jpda or gnn.")
    ] = "gmphd",
    truth: Annotated[
        Path | None,
        typer.Option("--truth", metavar="FILE", help="True tracks in the format of --detections, to be compared with."),
    ] = None,
    out: _Out = Path("out"),
    config: _Config = None,
    settings: _Set = None,
    show_config: Annotated[
        bool, typer.Option("--show-config", help="Print the default options as YAML and leave.")
    ] = False,
) -> int:
    """Track moving objects seen by a stereo camera, or the detections of any detector.

    Writes tracks.csv, metrics.json, report.html and config.yaml; of detections also tracks_mot.txt (frames from 1), of
    a stereo camera also trajectory.txt and images. Rows of tracks.csv are in m in the frame of the first camera; of
    MOT detections they are of the center of the box in px, and z, vz and var_z are empty.
    """
    if show_config:
        _print_defaults("track.stereo" if detections is None else "track.detections")
        return 0
    if (sequence is None) == (detections is None):
        raise typer.BadParameter("give either a SEQUENCE or --detections FILE")
    if detections is None:
        if any(given is not None for given in (calib, truth)) or (form, tracker) != ("auto", "gmphd"):
            raise typer.BadParameter("--calib, --format, --tracker and --truth go with --detections")
        from jaxloc.cli.track.stereo import command

        return command.run_recording(sequence, poses, _arguments(out, config, settings))
    from jaxloc.cli.track.detections import command

    for name, value, known in (("--format", form, command.FORMATS), ("--tracker", tracker, command.TRACKERS)):
        if value not in known:
            raise typer.BadParameter(f"{name} is {value!r}, must be one of {', '.join(known)}")
    inputs = command.Inputs(detections, form, poses, calib, truth, tracker)
    return command.run_detections(inputs, _arguments(out, config, settings))


@app.command()
def lane(
    path: Annotated[Path, typer.Argument(help="Image, folder of images, or video of a camera that looks ahead.")],
    camera: Annotated[
        Path,
        typer.Option("--camera", metavar="CAMERA.yaml", help="OpenCV's camera file, plus height_m (pitch_rad)."),
    ],
    speed: Annotated[
        float | None,
        typer.Option("--speed", metavar="M/S", min=0.0, help="Of the vehicle; else by the options."),
    ] = None,
    out: _Out = Path("out"),
    config: _Config = None,
    settings: _Set = None,
    show_config: Annotated[bool, _show_option("lane")] = False,
) -> int:
    """Estimate the position and heading of a vehicle in its lane, and the lane's curvature.

    Writes lane.csv (m left of the lane's center, rad, 1/m), borders.csv (columns of the lane's borders in the image),
    annotated images or a video, metrics.json, report.html and config.yaml.
    """
    from jaxloc.cli.lane import command

    return command.run_recording(path, camera, speed, _arguments(out, config, settings))


@app.command()
def calibrate(
    images: Annotated[list[Path], typer.Argument(help="Images of a chessboard by one camera, or folders of them.")],
    grid: Annotated[str, typer.Option("--grid", metavar="9x6", help="Inner corners of the board: along, down.")],
    square: Annotated[float, typer.Option("--square", metavar="M", help="Edge of a square, m.")],
    right: Annotated[
        list[Path] | None,
        typer.Option("--right", metavar="PATH", help="Images (or a folder) of the right camera of a stereo rig."),
    ] = None,
    out: _Out = Path("out"),
    config: _Config = None,
    settings: _Set = None,
    show_config: Annotated[bool, _show_option("calibrate")] = False,
) -> int:
    """Calibrate a camera, or a stereo rig, from images of a chessboard.

    Writes camera.yaml (OpenCV's format, with the parameters' covariance), of two cameras also right.yaml and
    stereo.yaml (with rectification), corners.csv, metrics.json, report.html and config.yaml.
    """
    from jaxloc.cli.calibrate import command

    return command.run_images(images, right, (grid, square), _arguments(out, config, settings))


@app.command()
def mosaic(
    frames: Annotated[Path, typer.Argument(help="Folder of images of a floor, in the order of their names.")],
    odometry: Annotated[
        Path,
        typer.Option("--odometry", metavar="FILE", help="Poses of the camera over the floor (TUM), a row an image."),
    ],
    camera: Annotated[
        Path,
        typer.Option("--camera", metavar="CAMERA.yaml", help="OpenCV's camera file, with height_m over the floor."),
    ],
    out: _Out = Path("out"),
    config: _Config = None,
    settings: _Set = None,
    show_config: Annotated[bool, _show_option("mosaic")] = False,
) -> int:
    """Make a mosaic of a floor from images and odometry.

    Writes mosaic.png, mosaic.yaml (resolution and origin), trajectory.tum, metrics.json, report.html and config.yaml.
    """
    from jaxloc.cli.mosaic import command

    return command.run_frames(frames, odometry, camera, _arguments(out, config, settings))
