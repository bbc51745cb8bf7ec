"""What was chosen in flight outlives the process, the configuration is never touched, and the latest word counts."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from own_board import OwnBoard

from magmav.choices import Choices, beside
from magmav.own_params import meant
from magmav.settings import Settings, knobs, load, with_value

S = 1_000_000_000
ON_THE_WIRE = [k for k in knobs() if k.param]


@pytest.fixture
def path(tmp_path):
    return beside(tmp_path / "magmav.sqlite", 7)


def held(path, configured=None):
    return Choices(path, configured or Settings()).settings()


def test_it_lies_beside_the_store(path):
    assert path.name == "magmav.sqlite-choices-7.json"
    assert held(path) == Settings() or repr(held(path)) == repr(Settings())


@pytest.mark.parametrize("knob", ON_THE_WIRE, ids=lambda k: k.param)
def test_every_setting_on_the_wire_is_kept_by_its_exact_value(path, knob):
    board = OwnBoard()
    for number in (board.value(knob.param), *(n for n in (0.0, 1.0, 2.0, 7.0, 20.0, 42.0, 150.0, 499.0))):
        if not board.set(knob.param, number):
            continue
        value = getattr(getattr(board.settings, knob.section), knob.key)
        Choices(path, Settings()).chose(knob.section, knob.key, value, 0)
        after = held(path)
        assert getattr(getattr(after, knob.section), knob.key) == value
        assert type(getattr(getattr(after, knob.section), knob.key)) is type(value)
        assert repr(with_value(after, knob.section, knob.key, knob.default)) == repr(Settings()), "and nothing else"


def test_choices_add_up_and_go_when_set_back(path):
    choices = Choices(path, Settings())
    choices.chose("gate", "residual_mg", 40.0, 0)
    choices.chose("learn", "on", False, 2 * S)
    assert (held(path).gate.residual_mg, held(path).learn.on) == (40.0, False)
    choices.chose("gate", "residual_mg", 30.0, 4 * S)
    assert (held(path).gate.residual_mg, held(path).learn.on) == (30.0, False)
    assert list(json.loads(path.read_text())["choices"]) == ["learn.on"]


def test_a_configuration_edited_later_is_heard_again_and_never_written(path, tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text("[gate]\nresidual_mg = 20.0  # my own note\n")
    Choices(path, load(mine)).chose("gate", "residual_mg", 40.0, 0)
    assert held(path, load(mine)).gate.residual_mg == 40.0
    assert mine.read_text() == "[gate]\nresidual_mg = 20.0  # my own note\n"
    mine.write_text("[gate]\nresidual_mg = 25.0\n")
    assert held(path, load(mine)).gate.residual_mg == 25.0
    Choices(path, load(mine)).chose("gate", "residual_mg", 50.0, 0)
    assert held(path, load(mine)).gate.residual_mg == 50.0, "and a choice after that counts in turn"


def test_what_the_command_line_says_for_one_run_wins_and_is_forgotten_after_it(path):
    Choices(path, Settings()).chose("wire", "imu_hz", 10.0, 0)
    no_requests = with_value(Settings(), "wire", "imu_hz", 0.0)
    assert held(path, no_requests).wire.imu_hz == 0.0
    assert held(path).wire.imu_hz == 10.0


def test_a_storm_is_written_once_a_second_and_its_last_word_is_kept(path):
    choices = Choices(path, Settings())
    written = set()
    for n in range(500):
        choices.chose("wire", "heading_hz", float(n % 20), n * S // 100)
        written.add(path.stat().st_ino)
    assert len(written) <= 6
    choices.poll(5 * S)
    assert held(path).wire.heading_hz == 499 % 20


def test_leaving_keeps_what_waits(path):
    choices = Choices(path, Settings())
    choices.chose("gate", "samples", 200, 0)
    choices.chose("gate", "samples", 300, 1)
    assert held(path).gate.samples == 200
    choices.keep()
    assert held(path).gate.samples == 300


def test_two_processes_do_not_undo_each_others_choices(path):
    one, other = Choices(path, Settings()), Choices(path, Settings())
    one.chose("gate", "samples", 200, 0)
    other.chose("learn", "on", False, 0)
    one.chose("wire", "imu_hz", 5.0, 2 * S)
    after = held(path)
    assert (after.gate.samples, after.learn.on, after.wire.imu_hz) == (200, False, 5.0)


@pytest.mark.parametrize(
    "text",
    [b"", b"{", b"[]", b"\xff\xfe", b'{"format":1}', b'{"format":1,"choices":[1]}', b'{"format":1,"choices":{"a":1}}'],
)
def test_a_file_that_cannot_be_understood_is_as_none(path, text):
    path.write_bytes(text)
    assert repr(held(path)) == repr(Settings())
    Choices(path, Settings()).chose("gate", "samples", 200, 0)
    assert held(path).gate.samples == 200


def test_a_value_out_of_limits_or_a_name_of_long_ago_is_left_out_and_the_rest_holds(path):
    kept = {
        "gate.samples": {"value": 5, "over": 100},
        "gate.nothing": {"value": 5, "over": 1},
        "vehicle.system": {"value": 9, "over": 0},
        "gate.residual_mg": {"value": 40.0, "over": 30.0},
        "learn.on": {"value": "perhaps", "over": True},
    }
    path.write_text(json.dumps({"format": 1, "choices": kept}))
    after = held(path)
    assert repr(after) == repr(with_value(Settings(), "gate", "residual_mg", 40.0))


def test_a_newer_format_is_left_alone(path):
    newer = json.dumps({"format": 2, "choices": {}})
    path.write_text(newer)
    choices = Choices(path, Settings())
    choices.chose("gate", "samples", 200, 0)
    assert path.read_text() == newer and "format 2" in choices.problem


def test_a_disk_that_fails_is_said_tried_again_and_leaves_nothing_half(tmp_path):
    path = beside(tmp_path / "gone" / "magmav.sqlite", 7)
    choices = Choices(path, Settings())
    choices.chose("gate", "samples", 200, 0)
    assert "No such file" in choices.problem
    path.parent.mkdir()
    choices.poll(2 * S)
    assert choices.problem == "" and held(path).gate.samples == 200
    assert os.listdir(path.parent) == [path.name]


def test_what_cannot_be_chosen_is_a_wrong_call(path):
    with pytest.raises(ValueError, match=r"vehicle\.system"):
        Choices(path, Settings()).chose("vehicle", "system", 3, 0)


_WRITER = """
import sys
from pathlib import Path
from magmav.choices import Choices
from magmav.settings import Settings
choices = Choices(Path(sys.argv[1]), Settings())
print("ready", flush=True)
n = 0
while True:
    n += 1
    choices.chose("gate", "samples", 20 + n % 9000, n * 2_000_000_000)
    choices.chose("gate", "residual_mg", 5.0 + (20 + n % 9000) % 50, n * 2_000_000_000 + 1_500_000_000)
"""


def test_killed_at_any_moment_the_file_is_whole(path):
    """SIGKILL while it writes as fast as it can; what is read afterwards is one of the values, never a part."""
    for pause_s in (0.0, 0.01, 0.03, 0.05):
        with subprocess.Popen([sys.executable, "-c", _WRITER, str(path)], stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None and writer.stdout.readline() == b"ready\n"
            time.sleep(pause_s)
            writer.send_signal(signal.SIGKILL)
        if path.exists():
            after = json.loads(path.read_text())
            assert after["format"] == 1 and set(after["choices"]) <= {"gate.samples", "gate.residual_mg"}
            assert held(path).gate.samples == after["choices"]["gate.samples"]["value"]
    assert path.exists()


@given(st.sampled_from(ON_THE_WIRE), st.floats(allow_nan=False, width=32))
@settings(max_examples=300, deadline=None)
def test_whatever_number_is_set_the_settings_stay_within_their_limits_and_say_it_back(knob, number):
    board = OwnBoard()
    before = board.value(knob.param)
    if board.set(knob.param, number):
        assert board.value(knob.param) == pytest.approx(number, rel=1e-6)
        value = getattr(getattr(board.settings, knob.section), knob.key)
        if knob.low is not None and knob.high is not None:
            assert knob.low <= value <= knob.high
    else:
        assert board.value(knob.param) == before


def test_a_float_of_the_wire_means_the_decimal_it_was_typed_as():
    board = OwnBoard()
    assert board.set("MMAG_GATE_FLD", 0.30000001192092896), "0.3 as 32 bits is the limit, not above it"
    assert board.settings.gate.field_share == 0.3
    assert not board.set("MMAG_GATE_FLD", 0.3001)
    assert meant("gate", "samples", 200.5) == 200.5 and not board.set("MMAG_GATE_N", 200.5)
    assert board.set("MMAG_SMOOTH", 2.0) and board.settings.heading.smooth == "fixed_lag"
    assert not board.set("MMAG_SMOOTH", 3.0) and not board.set("MMAG_SMOOTH", 0.5)


def test_what_has_no_name_on_the_wire_is_fixed_from_the_start():
    """Who and where we are, what kind of sensor and method, and the bench: not for a ground station to change."""
    fixed = {f"{k.section}.{k.key}" for k in knobs() if not k.param}
    assert fixed == {
        "vehicle.system", "vehicle.component", "place.lat_deg", "place.lon_deg", "place.alt_m", "compass.axes",
        "attitude.own", "learn.estimator", "learn.on_ground",
    }  # fmt: skip
