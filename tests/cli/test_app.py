"""Arguments, help, and extras that are not installed."""

import builtins
import subprocess
import sys

import pytest
import yaml

from jaxloc.cli import run


def test_bad_arguments_are_refused(pipeline, sequence, tmp_path, refused):
    refused(["odometry", tmp_path / "nowhere"], "nowhere: no such folder")
    refused(["odometry"], "(?i)missing argument")
    refused(["odometry", sequence, "--wrong"], "(?i)no such option")
    refused(["demo", "--frames", "one"], "(?i)invalid value")
    refused(["nothing"], "(?i)no such command")
    refused(["odometry", sequence, "--poses", tmp_path / "no.txt"], "no.txt: no such file")
    refused(["odometry", sequence, "--config", tmp_path / "no.yaml", "--out", tmp_path / "o"], "no.yaml: no such")
    file = tmp_path / "file"
    file.write_text("")
    refused(["odometry", sequence, "--out", file], "file: is a file, but the results need a folder")
    refused(["odometry", sequence, "--out", file / "deeper"], "file: is a file")


def test_help_and_version(capsys):
    import jaxloc

    assert run(["--version"]) == 0
    assert capsys.readouterr().out.strip() == f"jaxloc {jaxloc.__version__}"
    assert run([]) == 0
    text = capsys.readouterr().out
    assert "odometry" in text and "demo" in text
    assert run(["odometry", "--help"]) == 0


@pytest.mark.parametrize("module", ["typer", "matplotlib", "jinja2", "yaml", "cattrs"])
def test_missing_extras_are_explained(pipeline, sequence, tmp_path, refused, monkeypatch, module):
    original = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name.split(".")[0] == module:
            raise ImportError(name, name=module)
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    for name in [name for name in sys.modules if name.startswith("jaxloc.cli.")]:
        monkeypatch.delitem(sys.modules, name)
    out = tmp_path / "out"
    refused(["odometry", sequence, "--out", out], r'pip install "jaxloc\[cli\]"')
    assert not out.exists()


def test_help_as_a_module_imports_nothing_heavy():
    code = (
        "import sys; from jaxloc.cli import run; assert run(['--help']) == 0; "
        "assert not {'jax', 'numpy', 'cv2', 'matplotlib'} & set(sys.modules), sorted(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, timeout=60)
    done = subprocess.run([sys.executable, "-m", "jaxloc", "--version"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout.startswith("jaxloc ")


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (["odometry"], "keyframe_frames"),
        (["demo"], "keyframe_frames"),
        (["localize"], "num_particles"),
        (["track"], "flow"),
        (["track", "--detections", "x.txt"], "confirmation"),
        (["lane"], "lane_width"),
        (["calibrate"], "radial"),
        (["mosaic"], "neighbors"),
    ],
)
def test_default_options_are_printed_as_yaml(capsys, arguments, name):
    assert run([*arguments, "--show-config"]) == 0
    assert name in yaml.safe_load(capsys.readouterr().out)
