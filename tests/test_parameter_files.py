"""The parameter files of a fit, value by value, and as each ground station's own rules read them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from magmav_sim.parameters import INT8, INT32, REAL32, Parameters
from magmav_sim.px4_table import rows
from parameter_entry import ARDUPILOT, PX4, entry

from magmav.fitting.parameters import file_of


def test_what_mission_planner_and_mavproxy_get_is_a_line_of_name_comma_value_each() -> None:
    assert file_of(entry(ARDUPILOT), ".param") == (
        "COMPASS_OFS_X,-181.36575\nCOMPASS_OFS_Y,0.1\nCOMPASS_DIA_X,1.05\nCOMPASS_MOT_Z,1e-07\nCOMPASS_MOTCT,2\n"
    )
    assert file_of(entry(PX4), ".parm") == "CAL_MAG0_XOFF,0.18136576\nCAL_MAG0_YODIAG,-0.0\nCAL_MAG_COMP_TYP,1\n"


def test_what_qgroundcontrol_gets_is_its_own_format_with_the_system_and_each_parameters_own_type() -> None:
    head = "# Onboard parameters for Vehicle 7\n#\n# magmav fit of flight.bin\n#\n"
    head += "# Vehicle-Id Component-Id Name Value Type\n"
    assert file_of(entry(ARDUPILOT, 7), ".params") == head + (
        "7\t1\tCOMPASS_OFS_X\t-181.36575\t9\n7\t1\tCOMPASS_OFS_Y\t0.1\t9\n7\t1\tCOMPASS_DIA_X\t1.05\t9\n"
        "7\t1\tCOMPASS_MOT_Z\t1e-07\t9\n7\t1\tCOMPASS_MOTCT\t2\t2\n"
    )
    assert file_of(entry(PX4, 7), ".params") == head + (
        "7\t1\tCAL_MAG0_XOFF\t0.18136576\t9\n7\t1\tCAL_MAG0_YODIAG\t-0.0\t9\n7\t1\tCAL_MAG_COMP_TYP\t1\t6\n"
    )


def as_qgroundcontrol(text: str, system: int, kinds: dict[str, int]) -> dict[str, float]:
    """By the rules of its ParameterManager.cc: another system id stops it, another type leaves a parameter out."""
    out: dict[str, float] = {}
    for line in text.split("\n"):
        cells = line.split("\t")
        if line.startswith("#") or len(cells) != 5:
            continue
        if int(cells[0]) != system:
            return {}
        if cells[1] == "1" and kinds[cells[2]] == int(cells[4]):
            out[cells[2]] = float(cells[3]) if cells[4] == "9" else int(cells[3])
    return out


def as_mission_planner(text: str) -> dict[str, float]:
    """By the rules of its ParamFile.cs: parts between blanks, commas and tabs, two of them; doubles."""
    parts = [line.replace(",", " ").split() for line in text.splitlines() if not line.startswith("#")]
    return {two[0]: float(two[1]) for two in parts if len(two) == 2}


def kinds_of(changed: dict[str, float]) -> dict[str, int]:
    """MAV_PARAM_TYPE of each as the simulated autopilots tell it."""
    table = Parameters(rows()) if next(iter(changed)).startswith("CAL_") else Parameters()
    return {name: table.kind(name) for name in changed}


@pytest.mark.parametrize("changed", [ARDUPILOT, PX4])
@pytest.mark.parametrize("system", [1, 255])
def test_each_ground_station_reads_every_value_to_the_last_bit(changed: dict[str, float], system: int) -> None:
    kinds = kinds_of(changed)
    assert set(kinds.values()) in ({REAL32, INT8}, {REAL32, INT32})
    for got in (
        as_qgroundcontrol(file_of(entry(changed, system), ".params"), system, kinds),
        as_mission_planner(file_of(entry(changed, system), ".param")),
    ):
        assert {n: np.float32(v).tobytes() for n, v in got.items()} == {
            n: np.float32(v).tobytes() for n, v in changed.items()
        }


@settings(max_examples=60, deadline=None)
@given(value=st.floats(-1e9, 1e9, width=32), source=st.text(max_size=30))
def test_no_value_and_no_file_name_makes_another_line(value: float, source: str) -> None:
    whole = {"COMPASS_OFS_X": value}
    text = file_of(entry(whole, 1, source), ".params")
    assert len(text.splitlines()) == 6
    got = as_qgroundcontrol(text, 1, {"COMPASS_OFS_X": REAL32})
    assert np.float32(got["COMPASS_OFS_X"]).tobytes() == np.float32(value).tobytes()


def test_a_file_is_for_one_vehicle() -> None:
    both = entry(ARDUPILOT, 1)
    both["vehicles"] += entry(ARDUPILOT, 2)["vehicles"]
    with pytest.raises(ValueError, match=r"flight\.bin: vehicles \[1, 2\] both change; one file is for one vehicle"):
        file_of(both, ".param")
    assert file_of(entry({}), ".param") == ""
