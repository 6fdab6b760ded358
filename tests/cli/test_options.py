"""Options from files and from the command line: what is read, and about thirty hostile files."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from jaxtyping import Array, Float

import jaxloc as jl
from jaxloc.beliefs import KullbackLeibler, MahalanobisDistance
from jaxloc.cli import options, run
from jaxloc.data import DataError
from jaxloc.features import opencv

NAMES = (
    "calibration",
    "detection_tracking",
    "floor_mosaic",
    "lane_following",
    "localization",
    "moving_objects",
    "odometry",
)


@pytest.mark.slow
def test_options_come_from_a_file_or_from_an_earlier_run(pipeline, sequence, tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("threshold: 3\nkernel:\n  scale: 0.5\n")
    out = tmp_path / "out"
    assert run(["odometry", str(sequence), "--out", str(out), "--config", str(mine)]) == 0
    assert pipeline.used.threshold == 3.0 and pipeline.used.kernel.scale == 0.5
    pipeline.used = None
    assert run(["demo", "--frames", "6", "--out", str(tmp_path / "demo"), "--config", str(out / "config.yaml")]) == 0
    assert pipeline.used.threshold == 3.0 and pipeline.used.kernel.scale == 0.5


@pytest.mark.slow
def test_options_from_the_command_line_come_last(pipeline, sequence, tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text("threshold: 3\nnum_features: 7\n")
    settings = ["--set", "kernel.scale=0.25", "--set", "threshold=4", "--config", str(mine)]
    assert run(["odometry", str(sequence), "--out", str(tmp_path / "out"), *settings]) == 0
    assert (pipeline.used.num_features, pipeline.used.threshold, pipeline.used.kernel.scale) == (7, 4.0, 0.25)


HOSTILE = [
    ("nothing: 1", r"no option nothing; there are num_features, threshold, kernel"),
    ("treshold: 1", r"no option treshold \(did you mean threshold\?\); there are"),
    ("kernel: {width: 1}", r"no option kernel.width; there are scale"),
    ("kernel: 3", r"kernel must be a mapping"),
    ("kernel:", r"kernel must be a mapping"),
    ("threshold: many", r"threshold is 'many', must be a number"),
    ("threshold: .nan", r"threshold is nan, must be finite"),
    ("threshold: -.inf", r"threshold is -inf, must be finite"),
    ("threshold: true", r"threshold is True, must be a number"),
    ("threshold: '2.0'", r"threshold is '2.0', must be a number"),
    ("threshold: [2.0]", r"threshold is \[2.0\], must be a number"),
    ("threshold:", r"threshold is None, must be a number"),
    ("threshold: 2020-01-01", r"threshold is datetime.date\(2020, 1, 1\), must be a number"),
    ("threshold: 1" + 400 * "0", r"threshold is a huge number, must be finite"),
    ("num_features: 1.5", r"num_features is 1.5, must be a whole number"),
    ("num_features: yes", r"num_features is True, must be a whole number"),
    ("num_features: 99999999999999999999", r"num_features is a huge number, must fit into 64 bits"),
    ("num_features: 1" + 5000 * "0", r"no valid YAML"),
    ("- 1", r"the file must be a mapping"),
    ("just words", r"the file must be a mapping"),
    ("1: 2", r"no option 1; there are"),
    ("a: [", r"no valid YAML"),
    ("a: b: c", r"no valid YAML"),
    ("\x07", r"no valid YAML"),
    ("threshold: 1\nthreshold: 2", r"threshold is given twice"),
    ("threshold: !!bool x", r"no valid YAML: a value that does not fit its tag"),
    ("threshold: !!int ''", r"no valid YAML: a value that does not fit its tag"),
    ("threshold: !!float x", r"no valid YAML: a value that does not fit its tag"),
    ("threshold: !!timestamp x", r"no valid YAML"),
    ("threshold: 2020-13-45", r"no valid YAML"),
    ("threshold: !!binary x", r"no valid YAML"),
    ("threshold: !!python/object/apply:os.system [ls]", r"no valid YAML"),
    ("threshold: " + 5000 * "[", r"nested too deeply"),
    ("threshold: " + 5000 * "{a: ", r"nested too deeply"),
    (5000 * "- ", r"nested too deeply"),
    ("? {a: 1}\n: 2", r"no valid YAML"),
    ("a: &a [x]\nb: [*a, *a]", r"aliases are not allowed"),
    ("a: &a [x, x]\n" + "".join(f"a{i}: &a{i} [*a, *a]\n" for i in range(30)), r"aliases are not allowed"),
    ("a: &a [*a]", r"aliases are not allowed"),
    (" " * (1 << 20) + "a: 1", r"too large for such a file"),
    (b"threshold: \xff\xfe", r"is no text file"),
    (b"\x00\x00", r"no valid YAML"),
]


@pytest.mark.parametrize(("text", "match"), HOSTILE, ids=range(len(HOSTILE)))
def test_bad_options_are_refused(pipeline, sequence, tmp_path, refused, text, match):
    mine = tmp_path / "mine.yaml"
    mine.write_bytes(text if isinstance(text, bytes) else text.encode())
    out = tmp_path / "out"
    refused(["odometry", sequence, "--config", mine, "--out", out], f"mine.yaml: .*{match}")
    assert not out.exists() and pipeline.used is None


@pytest.mark.parametrize(
    ("setting", "match"),
    [
        ("threshold", "is 'threshold', must be like name=value"),
        ("=3", "is '=3', must be like name=value"),
        ("kernel..scale=3", "must be like name=value"),
        ("kernel.scle=3", r"no option kernel.scle \(did you mean scale\?\); there are scale"),
        ("threshold=[", "no valid YAML"),
        ("threshold=*a", "aliases are not allowed"),
        ("threshold=x", "threshold is 'x', must be a number"),
    ],
)
def test_bad_settings_are_refused(pipeline, sequence, tmp_path, refused, setting, match):
    refused(["odometry", sequence, "--set", setting, "--out", tmp_path / "out"], f"error: --set: .*{match}")
    assert not (tmp_path / "out").exists() and pipeline.used is None


def test_folders_and_devices_are_no_files(tmp_path):
    for path in (tmp_path, "/dev/zero"):
        with pytest.raises(DataError, match="is no file"):
            options.read_options(jl.pipelines.odometry.Config(), type(tmp_path)(path))


@pytest.mark.parametrize("name", NAMES)
def test_the_printed_options_of_every_pipeline_are_read_back(tmp_path, name):
    default = getattr(jl.pipelines, name).Config()
    path = tmp_path / "a.yaml"
    path.write_text(options.format_options(default))
    found = options.read_options(default, path)
    assert eqx.tree_equal(found, default) is True and type(found) is type(default)


def test_records_that_are_a_choice():
    default = jl.pipelines.moving_objects.Config()

    def read(*settings):
        return options.read_options(default, None, settings)

    assert read("odometry.detector=ORB").odometry.detector == opencv.ORB()
    assert read("odometry.detector=ORB", "odometry.detector.levels=4").odometry.detector == opencv.ORB(levels=4)
    assert read("odometry.detector.radius=5").odometry.detector == opencv.ShiTomasi(radius=5)
    assert read("merge={type: KullbackLeibler, threshold: 2}").merge == KullbackLeibler(2.0)
    with pytest.raises(DataError, match=r"merge.type is 'Kulback' .*; there are KullbackLeibler, MahalanobisDistance"):
        read("merge=Kulback")
    with pytest.raises(DataError, match="no option merge.levels; there are threshold"):
        read("merge.levels=4")


class Arrays(eqx.Module):
    number: float | Float[Array, ""] = 1.0
    scalar: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.ones(()))
    vector: Float[Array, "2"] = eqx.field(default_factory=lambda: jnp.ones(2))
    pair: tuple[int, float] = (1, 2.0)
    maybe: float | None = None


def test_numbers_that_are_arrays(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("number: 2\nscalar: 3\nvector: [4, 5.5]\npair: [6, 7]\nmaybe: 8\n")
    found = options.read_options(Arrays(), path)
    assert found.number == 2.0 and found.pair == (6, 7.0) and found.maybe == 8.0
    assert isinstance(found.scalar, jax.Array) and float(found.scalar) == 3.0
    np.testing.assert_array_equal(found.vector, [4.0, 5.5])
    assert yaml.safe_load(options.format_options(found)) == {
        "number": 2.0,
        "scalar": 3.0,
        "vector": [4.0, 5.5],
        "pair": [6, 7.0],
        "maybe": 8.0,
    }
    assert options.read_options(found, None, ["maybe=null"]).maybe is None
    for setting in ("vector=[1]", "vector=[1, x]", "vector=[[1], [2, 3]]", "scalar=[1, 2]", "pair=[1]", "maybe=x"):
        with pytest.raises(DataError, match=f"--set: {setting.split('=')[0]}"):
            options.read_options(Arrays(), None, [setting])
    wide = options.read_options(Arrays(number=MahalanobisDistance(jnp.array(3.0)).threshold), None, [])
    assert float(wide.number) == 3.0


def test_errors_of_a_record_are_one_line():
    with pytest.raises(DataError, match="^--set: blend is 2.0, must lie between 0 and 1$"):
        options.read_options(jl.pipelines.lane_following.Config(), None, ["blend=2"])
    with pytest.raises(DataError, match="^--set: confirmation: frames is 0, must be at least 1$"):
        options.read_options(jl.pipelines.detection_tracking.Config(), None, ["confirmation.frames=0"])
