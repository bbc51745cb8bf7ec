"""One table for every knob: the file, the limits, the names on the wire."""

import math
from pathlib import Path

import pytest

from magmav.settings import Settings, SettingsError, as_toml, checked, knobs, load, with_value

CONFIG = Path(__file__).parent.parent / "config"


def written(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path


def test_the_default_file_is_the_table():
    assert (CONFIG / "default.toml").read_text() == as_toml()


def test_the_default_file_says_what_the_defaults_are():
    got = load(CONFIG / "default.toml")
    assert math.isnan(got.place.lat_deg)
    assert math.isnan(got.place.lon_deg)
    for k in knobs():
        value = getattr(getattr(got, k.section), k.key)
        default = getattr(getattr(Settings(), k.section), k.key)
        assert repr(value) == repr(default), k.key
        assert repr(k.default) == repr(default), k.key


def test_the_example_for_ardupilot_loads_and_changes_nothing_unasked():
    got = load(CONFIG / "ardupilot.toml")
    for k in knobs():
        assert repr(getattr(getattr(got, k.section), k.key)) == repr(k.default), k.key


def test_no_file_is_the_defaults(tmp_path):
    assert load(None).gate == Settings().gate
    assert load(written(tmp_path, "")).gate == Settings().gate


def test_a_few_keys_change_only_themselves(tmp_path):
    got = load(written(tmp_path, "[gate]\nsamples = 200\n[learn]\nestimator = 'taubin'\n"))
    assert (got.gate.samples, got.learn.estimator) == (200, "taubin")
    assert got.gate.residual_mg == Settings().gate.residual_mg
    assert got.wire == Settings().wire


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[gate]\nsampels = 200\n", "sampels"),
        ("[gait]\nsamples = 200\n", "gait"),
        ("[gate]\nsamples = 19\n", "gate.samples"),
        ("[gate]\nsamples = 10001\n", "gate.samples"),
        ("[gate]\nsamples = 'many'\n", "gate.samples"),
        ("[gate]\nsamples = 20.5\n", "gate.samples"),
        ("[gate]\naxis_sigma_mg = 1.9\n", "gate.axis_sigma_mg"),
        ("[gate]\naxis_sigma_mg = nan\n", "gate.axis_sigma_mg"),
        ("[wire]\nheading_hz = inf\n", "wire.heading_hz"),
        ("[vehicle]\nsystem = 256\n", "vehicle.system"),
        ("[learn]\nestimator = 'magic'\n", "magic"),
        ("[learn]\non = 1\n", "learn.on"),
        ("[place]\nlat_deg = 47.0\n", "lat_deg and lon_deg"),
        ("[place]\nlon_deg = 8.0\n", "lat_deg and lon_deg"),
        ("[place]\nlat_deg = 91.0\nlon_deg = 8.0\n", "not on Earth"),
        ("[place]\nlat_deg = 47.0\nlon_deg = -181.0\n", "not on Earth"),
        ("[place]\nlat_deg = inf\nlon_deg = 8.0\n", "not on Earth"),
        ("[gate\n", "mine.toml"),
        ("samples = 5\n", "samples"),
    ],
)
def test_what_cannot_be_used_is_refused_by_name(tmp_path, text, named):
    with pytest.raises(SettingsError) as error:
        load(written(tmp_path, text))
    assert named in str(error.value)
    assert "mine.toml" in str(error.value)


def test_a_file_that_is_not_there_or_no_text(tmp_path):
    with pytest.raises(SettingsError, match=r"none\.toml: cannot be read"):
        load(tmp_path / "none.toml")
    path = tmp_path / "binary.toml"
    path.write_bytes(b"\xff\xfe\x00[gate]")
    with pytest.raises(SettingsError, match=r"binary\.toml"):
        load(path)


def test_one_value_can_be_changed_by_name():
    got = with_value(Settings(), "gate", "residual_mg", 40.0)
    assert got.gate.residual_mg == 40.0
    assert Settings().gate.residual_mg == 30.0
    for section, key, value in (
        ("gate", "residual_mg", 61.0),
        ("gate", "residual_mg", math.nan),
        ("gate", "nothing", 1.0),
        ("none", "residual_mg", 1.0),
        ("learn", "estimator", "magic"),
    ):
        with pytest.raises(SettingsError, match=key):
            with_value(Settings(), section, key, value)
    assert checked(Settings(), "here") == Settings() or math.isnan(Settings().place.lat_deg)


def test_every_knob_on_the_wire_has_a_short_name_of_its_own():
    names = [k.param for k in knobs() if k.param]
    assert names
    assert len(set(names)) == len(names)
    assert all(n.startswith("MMAG_") and len(n) <= 16 and n == n.upper() for n in names)


def test_every_knob_has_a_meaning_and_its_default_lies_within_its_limits():
    for k in knobs():
        assert k.text, k.key
        assert k.kind in ("int", "float", "bool", "str"), k.key
        if isinstance(k.default, (int, float)) and not math.isnan(k.default):
            assert k.low is None or k.low <= k.default, k.key
            assert k.high is None or k.default <= k.high, k.key
        if k.kind in ("int", "float") and k.section != "place":
            assert k.low is not None, k.key
            assert k.high is not None, k.key


@pytest.mark.parametrize("k", [k for k in knobs() if k.low is not None], ids=lambda k: k.key)
def test_each_limit_is_kept(k):
    make = int if k.kind == "int" else float
    step = 1 if k.kind == "int" else 1e-6
    for good in (k.low, k.high):
        got = with_value(Settings(), k.section, k.key, make(good))
        assert getattr(getattr(got, k.section), k.key) == good
    for bad in (k.low - step, k.high + step):
        with pytest.raises(SettingsError, match=k.key):
            with_value(Settings(), k.section, k.key, make(bad))
