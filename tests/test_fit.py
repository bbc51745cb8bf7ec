"""magmav fit of simulated flights on file: what it learns, names, refuses and writes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from magmav_sim import Simulation, load_scenario
from magmav_sim.correction import Correction
from magmav_sim.recorder import Recorder, unattended

import magmav
from magmav.cli import main
from magmav.fitting.parameters import as_param, as_qgc
from magmav.view.fit import fit_view
from magmav.view.table import to_text

KINDS = ("tlog", "bin", "ulg")
ASK = magmav.FitOptions(soft_iron=True, scale=True, motor=True)


def about_down(degrees):
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return ((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0))


def flown(folder, scenario, kinds=("bin",), seconds=100.0, parameters=None, **compass):
    """The first compass of a scenario's flight, changed as asked, on file; the paths."""
    plan = unattended(load_scenario(scenario))
    ours = [msgspec.structs.replace(plan.compasses[0], **compass)]
    autopilot = msgspec.structs.replace(plan.autopilot, parameters=plan.autopilot.parameters | (parameters or {}))
    sim = Simulation(msgspec.structs.replace(plan, compasses=ours, autopilot=autopilot))
    paths = [folder / f"{scenario}.{kind}" for kind in kinds]
    with Recorder(sim, paths):
        sim.advance(seconds)
    return paths


def only(result):
    (vehicle,) = result["vehicles"]
    (compass,) = vehicle["compasses"]
    return compass


def codes(parts):
    return [p["code"] for p in parts]


@pytest.fixture(scope="module")
def eights(tmp_path_factory):
    return flown(tmp_path_factory.mktemp("eights"), "figure8", KINDS)


@pytest.fixture(scope="module")
def three(eights):
    return {path.suffix[1:]: magmav.fit(path) for path in eights}


@pytest.fixture(scope="module")
def motor_log(tmp_path_factory):
    (path,) = flown(tmp_path_factory.mktemp("motor"), "motor", seconds=120.0)
    return path


@pytest.fixture(scope="module")
def motor(motor_log):
    return magmav.fit(motor_log, options=ASK)


@pytest.fixture(scope="module")
def bent(tmp_path_factory):
    """Soft iron of up to 10 percent, over a stored matrix that is not the identity, with a scale."""
    stored = {"COMPASS_DIA_X": 1.05, "COMPASS_DIA_Y": 0.97, "COMPASS_DIA_Z": 1.01, "COMPASS_ODI_X": 0.02}
    stored |= {"COMPASS_SCALE": 1.02, "COMPASS_OFS_X": -150.0, "COMPASS_OFS_Y": 90.0, "COMPASS_OFS_Z": -200.0}
    (path,) = flown(tmp_path_factory.mktemp("bent"), "soft_iron", seconds=115.0, parameters=stored)
    return path, stored


# ---------------------------------------------------------------- AT-14a, AT-14c


def test_AT_14a_the_three_formats_agree_within_3_mg_through_fit(three):
    offsets = np.array([only(three[kind])["fit"]["new_offsets_mg"] for kind in KINDS])
    irons = np.array([only(three[kind])["fit"]["hard_iron_mg"] for kind in KINDS])
    assert np.ptp(offsets, axis=0).max() < 3.0, offsets
    assert np.ptp(irons, axis=0).max() < 3.0, irons
    true = np.array(load_scenario("figure8").compasses[0].hard_iron_mg)
    for kind in KINDS:
        fit = only(three[kind])["fit"]
        assert (np.abs(np.array(fit["hard_iron_mg"]) - true) < 3.0 * np.array(fit["sigma_mg"])).all(), kind


def without_parameters(path):
    """A tlog (v2 frames) with every PARAM_VALUE taken out."""
    data, out, at, taken = path.read_bytes(), bytearray(), 0, 0
    while at < len(data):
        assert data[at + 8] == 0xFD
        end = at + 8 + 12 + data[at + 9] + (13 if data[at + 10] & 1 else 0)
        if int.from_bytes(data[at + 15 : at + 18], "little") == 22:
            taken += 1
        else:
            out += data[at:end]
        at = end
    assert taken > 10
    bare = path.with_name("bare.tlog")
    bare.write_bytes(bytes(out))
    return bare


def test_AT_14c_without_parameters_only_the_change_is_known_and_nothing_is_written(eights, three, capsys, tmp_path):
    bare = without_parameters(eights[0])
    fit = only(magmav.fit(bare))["fit"]
    assert fit["relative"] and fit["old_offsets_mg"] is None and fit["new_offsets_mg"] is None
    assert "RELATIVE_ONLY" in codes(fit["reasons"]) and fit["state"] != "READY"
    assert fit["parameters"]["changed"] == fit["parameters"]["new"] == {}
    assert any("only the change is known" in text for text in fit["advice"])
    with_them = only(three["tlog"])["fit"]  # the stored offsets are zero, so the change is the same
    level = np.array(fit["change_mg"][:2]) - np.array(with_them["change_mg"][:2])
    assert np.abs(level).max() < 1.0
    assert main(["fit", str(bare), "--params", str(tmp_path / "a.param")]) == 0
    assert (tmp_path / "a.param").read_text() == ""
    assert "change " in capsys.readouterr().out


# ---------------------------------------------------------------- AT-15, through fit


def test_AT_15a_fit_refuses_a_compass_at_right_angles_and_prints_what_to_set(tmp_path):
    """Turned by 90 degrees in yaw, while COMPASS_ORIENT says it is not."""
    (path,) = flown(tmp_path, "soft_iron", seconds=115.0, soft=about_down(-90.0))
    entry = only(result := magmav.fit(path))
    fit = entry["fit"]
    assert fit["state"] == "REFUSED" and codes(fit["reasons"])[0] == "MOUNTING_WRONG"
    assert fit["parameters"]["new"] == fit["parameters"]["changed"] == {}
    found = fit["mounting"]["found"]
    assert found["rotation"] == "YAW_90" and found["angle_deg"] == pytest.approx(90.0, abs=5.0)
    assert found["set"] == {"name": "COMPASS_ORIENT", "value": 2, "means": "YAW_90"}
    assert fit["mounting"]["stored_orientation"]["value"] == 0.0
    assert "YAW_90" in to_text(fit_view({"logs": [result]}))


def test_AT_1d_fit_prints_the_deviation_card_of_its_json(three):
    text = to_text(fit_view({"logs": [three["bin"]]}))
    rows = only(three["bin"])["fit"]["deviation"]
    assert len(rows) == 8 and "Deviation" in text
    lines = [line for line in text.splitlines() if " -> " in line and "\u00b1" in line]
    for line, row in zip(lines, rows, strict=True):
        before, after, sigma = (round(row[f"{name}_deg"], 1) + 0.0 for name in ("before", "after", "sigma"))
        assert f"{row['heading_deg']:.0f} " in line and f"{before:+.1f} -> {after:+.1f} \u00b1 {sigma:.1f}" in line


def test_AT_15b_thirty_degrees_are_said_to_be_thirty_and_not_hidden_in_the_offsets(tmp_path):
    (path,) = flown(tmp_path, "soft_iron", seconds=115.0, soft=about_down(30.0))
    fit = only(magmav.fit(path))["fit"]
    found = fit["mounting"]["found"]
    assert found["rotation"] is None and found["angle_deg"] == pytest.approx(30.0, abs=5.0)
    assert "crooked" in found["text"] and fit["parameters"]["changed"] == {}
    assert fit["state"] == "REFUSED" and codes(fit["reasons"])[0] == "MOUNTING_WRONG"


# ---------------------------------------------------------------- AT-10


def test_AT_10a_the_slope_within_a_fifth_and_the_iron_at_zero_current_within_10_mg(motor):
    spec = load_scenario("motor").compasses[0]
    fit = only(motor)["fit"]
    assert fit["motor"]["of"] == "current" and fit["motor"]["earned"]
    slope, true = np.array(fit["motor"]["mg_per_unit"]), np.array(spec.motor_mg_per_a)
    assert np.linalg.norm(slope - true) < 0.2 * np.linalg.norm(true)
    assert fit["hard_iron_at"] == "zero power"
    assert np.abs(np.array(fit["hard_iron_mg"]) - np.array(spec.hard_iron_mg)).max() < 10.0
    assert only(motor)["hard_iron_mg"] == fit["hard_iron_mg"]


def test_AT_10a_what_is_written_takes_the_motors_away_at_every_current(motor):
    """By the simulated autopilot's own correction, which shares no code with ours."""
    spec, fit = load_scenario("motor").compasses[0], only(motor)["fit"]
    changed = fit["parameters"]["changed"]
    assert changed["COMPASS_MOTCT"] == 2.0
    offsets, motors = ([changed[f"COMPASS_{w}_{a}"] for a in "XYZ"] for w in ("OFS", "MOT"))
    correction = Correction(None, tuple(offsets), 0.0, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), tuple(motors), 2)
    for ampere in (0.0, 10.0, 20.0, 40.0):
        read = np.array(spec.hard_iron_mg) + ampere * np.array(spec.motor_mg_per_a)
        assert np.linalg.norm(correction.apply(tuple(read), 0.0, ampere)) < 20.0


def test_AT_10b_where_no_power_is_known_that_is_said_and_the_iron_is_that_of_average_power(motor_log, monkeypatch):
    from magmav.core.types import CurrentReading, ThrottleReading
    from magmav.logs.dataflash_readings import DataflashRecording

    readings = DataflashRecording.in_runs
    powers = (CurrentReading, ThrottleReading)
    monkeypatch.setattr(
        DataflashRecording, "in_runs", lambda self: (r for r in readings(self) if not isinstance(r[1], powers))
    )
    fit = only(magmav.fit(motor_log, options=ASK))["fit"]
    assert fit["hard_iron_at"] == "average power" and not fit["motor"]["earned"]
    assert any("could not be tested" in text and "average power" in text for text in fit["advice"])
    assert "COMPASS_MOT_X" not in fit["parameters"]["new"]


def test_AT_10c_a_field_that_moves_with_current_is_said_in_so_many_words(motor, eights):
    fit = only(motor)["fit"]
    assert fit["motor"]["correlation"] > 0.7
    assert any(text.startswith("moves with current: fix wiring or use motor compensation") for text in fit["advice"])


# ---------------------------------------------------------------- AT-16


def test_AT_16a_by_default_only_offsets_change_and_the_rest_is_fitted_through(bent):
    path, stored = bent
    fit = only(magmav.fit(path))["fit"]
    assert set(fit["parameters"]["new"]) <= {f"COMPASS_OFS_{a}" for a in "XYZ"}
    assert fit["soft_iron"] is None and fit["scale"] is None
    for axis, old in zip("XYZ", (stored[f"COMPASS_OFS_{a}"] for a in "XYZ"), strict=True):
        was = fit["parameters"]["old"].get(f"COMPASS_OFS_{axis}", old)
        assert was == np.float32(old)


def correction_of(values):
    """The simulator's ArduPilot with these stored values."""

    def three(what):
        return tuple(float(values[f"COMPASS_{what}_{a}"]) for a in "XYZ")

    mode = int(values["COMPASS_MOTCT"])
    return Correction(None, three("OFS"), values["COMPASS_SCALE"], three("DIA"), three("ODI"), three("MOT"), mode)


@pytest.mark.parametrize("options", [magmav.FitOptions(), magmav.FitOptions(soft_iron=True)], ids=["plain", "soft"])
def test_AT_16b_the_file_and_what_stays_reproduce_the_predicted_field(bent, options):
    """Closure: what the file says, read back as text, through the simulator's ArduPilot, against the prediction."""
    result = magmav.fit(bent[0], options=options)
    entry = only(result)
    new = entry["fit"]["parameters"]["new"]
    if options.soft_iron:
        assert entry["fit"]["soft_iron"]["earned"] and {"COMPASS_DIA_X", "COMPASS_ODI_Z"} <= set(new)
    read_back = {n: float(np.float32(v)) for n, v in (line.split(",") for line in as_param(new).splitlines())}
    assert read_back == new
    correction = correction_of(entry["stored"] | read_back)
    columns = result.arrays[1, 1]
    made = np.array([correction.apply(tuple(v), 0.0, 0.0) for v in columns["sensor_b_mg"].tolist()])
    off = np.abs(made - columns["after_b_mg"])
    assert off.max() < (2.0 if options.soft_iron else 1e-3)
    assert entry["fit"]["parameters"]["closure_mg"] == pytest.approx(off[columns["taught"]].max(), abs=1e-3)


def test_soft_iron_that_was_asked_for_is_found_and_makes_the_field_round(bent):
    spec = load_scenario("soft_iron").compasses[0]
    (path, _) = bent
    plain, asked = only(magmav.fit(path))["fit"], only(magmav.fit(path, options=magmav.FitOptions(soft_iron=True)))
    assert asked["fit"]["residual_mg"]["after"] < plain["residual_mg"]["after"]
    new = asked["stored"] | asked["fit"]["parameters"]["new"]
    matrix = new["COMPASS_SCALE"] * np.array(
        [
            [new["COMPASS_DIA_X"], new["COMPASS_ODI_X"], new["COMPASS_ODI_Y"]],
            [new["COMPASS_ODI_X"], new["COMPASS_DIA_Y"], new["COMPASS_ODI_Z"]],
            [new["COMPASS_ODI_Y"], new["COMPASS_ODI_Z"], new["COMPASS_DIA_Z"]],
        ]
    )
    whole = matrix @ np.array(spec.soft)
    np.testing.assert_allclose(whole / np.cbrt(np.linalg.det(whole)), np.eye(3), atol=0.03)


def test_soft_iron_and_scale_that_are_not_there_are_not_written(motor):
    fit = only(motor)["fit"]
    assert not fit["soft_iron"]["earned"] and not fit["scale"]["earned"]
    assert "chi squared" in fit["soft_iron"]["evidence"] and "world model" in fit["scale"]["evidence"]
    assert not {n for n in fit["parameters"]["new"] if "DIA" in n or "SCALE" in n}


# ---------------------------------------------------------------- AT-4a and the document


def test_AT_4a_the_document_holds_what_a_report_must(three):
    result = three["bin"]
    fit = only(result)["fit"]
    assert fit["old_offsets_mg"] == [0.0, 0.0, 0.0] and fit["change_mg"] == fit["new_offsets_mg"]
    assert fit["residual_mg"]["held_out_after"] < fit["residual_mg"]["held_out_before"]
    assert [row["heading_deg"] for row in fit["deviation"]] == [45.0 * i for i in range(8)]
    assert all(row["sigma_deg"] > 0.0 for row in fit["deviation"])
    assert fit["heading"]["reference"] == "ATT yaw" and "scored on what came after" in fit["heading"]["held_out"]["how"]
    assert result["file"]["kind"] == "dataflash" and len(result["file"]["sha256"]) == 64
    assert result["made_by"] == {"magmav": magmav.__version__, "at": None}
    begin, end = fit["span_s"]
    assert 10.0 < begin < 20.0 < 80.0 < end < 90.0
    assert {c["code"] for c in fit["cut"]} >= {"GROUND"}
    series = fit["series"]
    assert len(series["t_s"]) == len(series["field_after_mg"]) == len(series["heading_deg"]) <= 600
    assert len(series["offsets_mg"]) == len(series["offsets_t_s"])
    assert sum(d["n"] for d in fit["coverage"]["directions"]) > 300
    json.dumps(result, allow_nan=False)


def test_the_same_log_gives_the_same_document(eights, three):
    assert magmav.fit(eights[1]) == three["bin"]


def test_parameter_files_are_what_each_ground_station_reads(motor, motor_log, tmp_path):
    changed = only(motor)["fit"]["parameters"]["changed"]
    words = ["fit", str(motor_log), "--motor", "--json"]
    for ending in (".param", ".params"):
        assert main([*words, "--params", str(tmp_path / f"new{ending}")]) == 0
    plain = dict(line.split(",") for line in (tmp_path / "new.param").read_text().splitlines())
    assert {n: float(np.float32(v)) for n, v in plain.items()} == changed
    rows = [line for line in (tmp_path / "new.params").read_text().splitlines() if not line.startswith("#")]
    cells = [row.split("\t") for row in rows]
    assert all(c[0] == "1" and c[1] == "1" and c[4] == ("2" if c[2] == "COMPASS_MOTCT" else "9") for c in cells)
    assert {c[2]: float(np.float32(c[3])) for c in cells} == changed


@pytest.mark.parametrize("value", [0.1, -181.36575, 1e-7, 2.0, 16777216.0, -0.0])
def test_a_number_in_a_file_is_the_same_32_bit_float_again(value):
    exact = float(np.float32(value))
    for text in (as_param({"A": exact}).split(",")[1], as_qgc({"A": exact}, 1).splitlines()[-1].split("\t")[3]):
        assert np.float32(text) == np.float32(value) and math.copysign(1, float(text)) == math.copysign(1, value)


def test_a_replay_of_a_path_gives_its_records_as_arrays(eights):
    result = magmav.replay(eights[1])
    columns = result.arrays[1, 1]
    assert only(result)["samples"] == len(columns["boot_s"]) == len(columns["sensor_b_mg"])
    assert columns["corrected_b_mg"].shape == (len(columns["boot_s"]), 3)
    assert (np.diff(columns["boot_s"]) > 0.0).all()


def test_a_compass_that_does_not_exist_is_refused_by_number(eights):
    with pytest.raises(ValueError, match="want 1, 2 or 3, got 4"):
        magmav.fit(eights[0], options=magmav.FitOptions(compasses=(4,)))


def test_a_file_that_is_no_log_is_refused_with_its_name(tmp_path: Path, capsys):
    bad = tmp_path / "bad.bin"
    bad.write_bytes(b"\xa3\x95nonsense" * 50)
    assert main(["fit", str(bad), "--json"]) == 3
    assert "bad.bin" in json.loads(capsys.readouterr().out)["error"]["text"]
