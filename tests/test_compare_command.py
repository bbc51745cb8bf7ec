"""`magmav compare` at the command line: a scenario by name, refusals by name, and the picture of what was fitted."""

import json
import struct

import numpy as np
import pytest

from magmav.cli import main
from magmav.commands.recordings import by_boot
from magmav.view.plot_compare import Cloud, levelled, plot_compare, thinned
from magmav.view.records import ViewError


@pytest.mark.long
def test_a_scenario_is_flown_and_judged_by_its_truth(capsys, tmp_path):
    png = tmp_path / "c.png"
    assert main(["compare", "figure8", "--only", "bullock,taubin", "--json", "--plot", str(png)]) == 0
    out = capsys.readouterr()
    result = json.loads(out.out)
    assert result["source"] == "figure8"
    for compass, truth in zip(result["vehicles"][0]["compasses"], IRON_MG, strict=True):
        assert compass["reference"] == "the simulator's truth"
        for row in compass["estimators"]:
            assert row["offsets_mg"] == pytest.approx([-v for v in truth], abs=12.0)
            assert row["second_half"]["rms_deg"] < 2.0 < 30.0 < compass["uncalibrated"]["second_half"]["rms_deg"]
    assert struct.unpack(">II", png.read_bytes()[16:24]) > (1000, 500)


IRON_MG = ((180.0, -120.0, 240.0), (-150.0, 90.0, -200.0))
"""What config/scenarios/figure8.toml puts into its two compasses."""


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["no_such_flight"], 3, "no_such_flight"),
        (["figure8", "--only", "oracle"], 2, "oracle"),
        (["figure8", "--reference", "no_such.csv"], 2, "figure8"),
        (["no_such.tlog", "--seed", "3"], 2, "--seed"),
        (["nodir/figure8"], 3, "nodir"),
        (["figure8", "--plot", "c.jpg", "--only", "kasa"], 2, "c.jpg"),
    ],
)
def test_what_cannot_be_done_is_refused_by_name(words, code, says, capsys):
    assert main(["compare", *words, "--json"]) == code
    error = json.loads(capsys.readouterr().out)["error"]
    assert error["code"] == code and says in error["text"]


def test_a_flight_with_a_reboot_is_judged_by_the_boot_that_taught(capsys):
    assert main(["compare", "reboot_in_flight", "--only", "kalman", "--json"]) == 0
    first = capsys.readouterr().out
    (compass,) = json.loads(first)["vehicles"][0]["compasses"][:1]
    assert compass["estimators"][0]["in_sample"]["rms_deg"] < 6.0 < compass["uncalibrated"]["in_sample"]["rms_deg"]


def test_truth_is_cut_where_the_vehicle_started_anew(tmp_path):
    (tmp_path / "truth.csv").write_text("boot_time_s,roll_deg\n1.0,0\n2.0,0\n0.5,7\n0.6,7\n")
    first, second = by_boot(tmp_path / "truth.csv")
    assert first.read_text() == "boot_time_s,roll_deg\n1.0,0\n2.0,0\n"
    assert second.read_text() == "boot_time_s,roll_deg\n0.5,7\n0.6,7\n"


def cloud(n=900, iron=(120.0, -60.0, 200.0), seed=1):
    """A level turn with 20 degrees of constant bank: in the levelled plane an exact circle about the levelled iron."""
    turn = np.linspace(0.0, 2.0 * np.pi, n)
    roll, pitch = np.full(n, np.radians(20.0)), np.zeros(n)
    ahead, right, down = 200.0 * np.cos(turn), -200.0 * np.sin(turn), np.full(n, 430.0)
    y = right * np.cos(roll) + down * np.sin(roll)
    z = down * np.cos(roll) - right * np.sin(roll)
    return Cloud(np.column_stack([ahead, y, z]) + iron, roll, pitch)


def test_levelling_takes_the_bank_out():
    c = cloud()
    flat = levelled(c.sensor_b_mg - (120.0, -60.0, 200.0), c)
    assert np.hypot(*flat.T) == pytest.approx(200.0)


def entry(offsets):
    row = {"name": "m", "offsets_mg": offsets}
    return {"source": "x", "vehicles": [{"system": 1, "compasses": [{"compass": 1, "estimators": [row]}]}]}


def test_the_drawn_circle_is_the_one_of_the_method_and_holds_the_points(tmp_path):
    c = cloud()
    figure = plot_compare(tmp_path / "c.png", entry([-120.0, 60.0, -200.0]), {(1, 1): c})
    first = figure.axes[0]
    points = next(line for line in first.lines if line.get_label() == "points").get_xydata()
    ring = next(line for line in first.lines if line.get_label() == "m").get_xydata()
    middle = ring[:-1].mean(axis=0)
    assert np.hypot(*(points - middle).T) == pytest.approx(200.0, abs=0.5)
    assert np.hypot(*(ring - middle).T) == pytest.approx(200.0, abs=0.5)


def test_a_method_that_does_not_know_the_down_axis_draws_no_sphere(tmp_path):
    c = cloud()
    knows = plot_compare(tmp_path / "a.png", entry([-120.0, 60.0, -200.0]), {(1, 1): c})
    not_z = plot_compare(tmp_path / "b.png", entry([-120.0, 60.0, None]), {(1, 1): c})
    assert [len(a.lines) for a in knows.axes] > [len(a.lines) for a in not_z.axes]
    assert "no method" in not_z.axes[1].get_title(loc="left")


def test_many_points_are_thinned_evenly():
    many = cloud(50_000)
    assert 1000 < len(thinned(many).sensor_b_mg) <= 5000
    assert thinned(many).sensor_b_mg.mean(axis=0) == pytest.approx(many.sensor_b_mg.mean(axis=0), abs=0.5)


def test_a_picture_wants_a_png(tmp_path):
    with pytest.raises(ViewError, match="png"):
        plot_compare(tmp_path / "c.pdf", entry(None), {})
