"""The command line: exit codes, one JSON document, and errors that name the culprit."""

from __future__ import annotations

import json
import socket

import pytest
from process_rig import magmav
from tlog_parity import flight

from magmav.cli import main, parser


@pytest.fixture
def told(capsys):
    """Run a command here; (exit code, JSON document)."""

    def run(*words):
        try:
            code = main([str(w) for w in words])
        except SystemExit as leave:
            code = leave.code
        out, err = capsys.readouterr()
        assert "Traceback" not in err
        (line,) = out.splitlines()
        return code, json.loads(line)

    return run


@pytest.fixture
def argv_json(monkeypatch):
    """argparse's own errors look at sys.argv for --json."""
    monkeypatch.setattr("sys.argv", ["magmav", "--json"])


@pytest.mark.parametrize(
    ("words", "culprit"),
    [
        (["replay", "--json"], "LOG"),
        (["replay", "x.tlog", "--json", "--sideways"], "--sideways"),
        (["upload", "udpin:127.0.0.1:0", "--json", "--compass", "4"], "--compass"),
        (["levitate", "--json"], "levitate"),
    ],
)
def test_wrong_arguments_are_exit_2_and_name_the_culprit(told, argv_json, words, culprit):
    code, result = told(*words)
    assert code == 2 == result["error"]["code"]
    assert culprit in result["error"]["text"]


@pytest.mark.parametrize(
    ("words", "culprit"),
    [
        (["--learn-for", "0"], "--learn-for"),
        (["--every", "-1"], "--every"),
        (["--lat", "47"], "lon"),
        (["--lat", "95", "--lon", "8"], "95"),
        (["--lat", "47", "--lon", "8", "--alt", "90000"], "alt_m"),
    ],
)
def test_values_out_of_range_are_exit_2(told, tmp_path, words, culprit):
    (tmp_path / "x.tlog").write_bytes(b"x")
    code, result = told("replay", tmp_path / "x.tlog", "--json", *words)
    assert code == 2
    assert culprit in result["error"]["text"]


@pytest.mark.parametrize(
    ("command", "option", "name", "wants"),
    [
        ("fit", "--report", "hill.bin", "reports want a name ending in .html"),
        ("fit", "--report", "report", "reports want a name ending in .html"),
        ("replay", "--plot", "hill.jpg", "pictures want a name ending in .png"),
        ("compare", "--plot", "hill.pdf", "pictures want a name ending in .png"),
        ("replay", "--records", "hill.txt", "records want a name ending in .jsonl, .json or .csv"),
    ],
)
def test_a_file_name_of_the_wrong_kind_is_exit_2_says_what_is_wanted_and_touches_nothing(
    told, tmp_path, command, option, name, wants
):
    (log := tmp_path / "x.tlog").write_bytes(b"".join(flight(1)))
    (out := tmp_path / name).write_bytes(b"mine")
    code, result = told(command, log, "--json", option, out)
    assert code == 2 and result["error"] == {"code": 2, "text": f"{out}: {wants}"}
    assert out.read_bytes() == b"mine"


@pytest.mark.parametrize(
    ("toml", "culprit"),
    [
        ("[gate]\nsurely = 1.0\n", "surely"),
        ("[gates]\n", "gates"),
        ("[gate]\naxis_sigma_mg = 99.0\n", "axis_sigma_mg"),
        ("[learn]\nestimator = 'oracle'\n", "oracle"),
        ("[learn\n", "settings.toml"),
    ],
)
def test_settings_file_with_a_mistake_is_exit_2_and_names_file_and_key(told, tmp_path, toml, culprit):
    (path := tmp_path / "settings.toml").write_text(toml)
    code, result = told("replay", tmp_path / "x.tlog", "--config", path, "--json")
    assert code == 2
    assert culprit in result["error"]["text"] and str(path) in result["error"]["text"]


def test_missing_settings_file_is_exit_2(told, tmp_path):
    code, result = told("replay", "x.tlog", "--config", tmp_path / "none.toml", "--json")
    assert code == 2 and "none.toml" in result["error"]["text"]


@pytest.mark.parametrize("command", ["run", "upload", "restore"])
@pytest.mark.parametrize(
    ("link", "code"),
    [("udpin:127.0.0.1:70000", 4), ("carrier:pigeon", 4), ("flight.tlog", 4), ("serial:/nowhere/tty:57600", 4)],
)
def test_link_that_cannot_be_is_exit_4(told, tmp_path, command, link, code):
    got, result = told(
        command, link, "--store", tmp_path / "s.sqlite", "--json", *["--for", "1"][: 2 * (command == "run")]
    )
    assert got == code == result["error"]["code"]
    assert link.split(":")[0] in result["error"]["text"]


def test_port_that_is_taken_is_exit_4_and_named(told, tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        code, result = told("run", f"udpin:127.0.0.1:{port}", "--store", tmp_path / "s.sqlite", "--json", "--for", "1")
    assert code == 4
    assert str(port) in result["error"]["text"]


@pytest.mark.parametrize("command", ["upload", "restore"])
def test_nobody_on_the_link_is_exit_4(told, tmp_path, command):
    code, result = told(command, "udpin:127.0.0.1:0", "--store", tmp_path / "s.sqlite", "--wait", "0.3", "--json")
    assert code == 4
    assert "no autopilot heard" in result["error"]["text"]


def test_upload_from_a_result_that_is_not_ready_is_refused_by_name(told, tmp_path):
    entry = {"compass": 1, "state": "LEARNING", "hard_iron_mg": None, "reasons": [{"code": "X", "text": "turn more"}]}
    (path := tmp_path / "result.json").write_text(json.dumps({"vehicles": [{"system": 1, "compasses": [entry]}]}))
    code, result = told("upload", "udpin:127.0.0.1:0", "--store", tmp_path / "s.sqlite", "--from", path, "--json")
    assert code == 1
    assert "turn more" in result["error"]["text"]


@pytest.mark.parametrize("text", [None, "not json", '{"vehicles": []}', "[]", '{"vehicles": [{}]}', "\xff"])
def test_upload_from_a_file_that_is_no_result_is_exit_3(told, tmp_path, text):
    path = tmp_path / "result.json"
    if text is not None:
        path.write_text(text, encoding="latin-1")
    code, result = told("upload", "udpin:127.0.0.1:0", "--store", tmp_path / "s.sqlite", "--from", path, "--json")
    assert code == 3
    assert str(path) in result["error"]["text"]


def test_history_of_nothing_is_empty_and_makes_no_file(told, tmp_path):
    code, result = told("history", "--store", tmp_path / "none.sqlite", "--json")
    assert code == 0 and result["writes"] == []
    assert list(tmp_path.iterdir()) == []


def test_settings_lists_every_knob_with_its_default(told):
    code, knobs = told("settings", "--json")
    assert code == 0
    found = {(k["section"], k["key"]): k for k in knobs}
    assert found["wire", "budget_bps"]["default"] == 500.0
    assert found["vehicle", "component"]["default"] == 191
    assert found["place", "lat_deg"]["default"] is None  # not given, never NaN in JSON


def test_settings_as_toml_are_read_back_as_the_defaults(capsys, tmp_path):
    from magmav.settings import Settings, load

    assert main(["settings"]) == 0
    (path := tmp_path / "all.toml").write_text(capsys.readouterr().out)
    assert str(load(path)) == str(Settings())  # NaN is not equal to itself, its text is


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as leave:
        parser().parse_args(["--help"])
    assert leave.value.code == 0
    text = capsys.readouterr().out
    for command in ("demo", "run", "sim", "replay", "upload", "restore", "history"):
        assert command in text


def test_error_for_people_goes_to_standard_error_alone(tmp_path):
    done = magmav("replay", tmp_path / "nowhere.tlog")
    assert done.code == 3 and done.out == ""
    assert done.err.startswith("magmav: ") and "nowhere.tlog" in done.err


def test_unknown_scenario_of_the_simulator_is_exit_3():
    done = magmav("sim", "no_such_flight", "--to", "udpout:127.0.0.1:9")
    assert done.code == 3
    assert "no_such_flight" in done.err and "Traceback" not in done.err
