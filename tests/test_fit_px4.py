"""What fit writes of soft iron and motors for PX4, CAL_MAGn_?SCALE, ?ODIAG and ?COMP: closed form, and from a .ulg."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from magmav_sim import Simulation, load_scenario
from magmav_sim.recorder import Recorder, unattended

import magmav
from magmav.core.types import ParamReading
from magmav.fitting.parameters import NewParameters, as_the_autopilot_would, both, shaped
from magmav.fitting.terms import Terms
from magmav.mavlink.autopilot.px4 import Px4Calibrations

DEVICE, OTHER = 396825, 262153
# The columns are where the sensor's axes point in the body: yaw 90, and rolled over.
TURNS = {0: np.eye(3), 2: np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), 8: np.diag([1, -1, -1])}
PAIRS = ((0, 1), (0, 2), (1, 2))  # of XODIAG, YODIAG, ZODIAG


def triple(what: str, values: Any) -> dict[str, float]:
    return {f"CAL_MAG1_{axis}{what}": float(np.float32(v)) for axis, v in zip("XYZ", values, strict=True)}


def stored(rotation: int, matrix: np.ndarray, off_g: Any, comp: Any, kind: float) -> dict[str, float]:
    """Slot 1 is this compass's; slot 0 another's."""
    told = {"CAL_MAG0_ID": float(OTHER), "CAL_MAG1_ID": float(DEVICE), "CAL_MAG1_ROT": float(rotation)}
    told |= {"CAL_MAG2_ID": 0.0, "CAL_MAG3_ID": 0.0, "CAL_MAG_COMP_TYP": kind}
    told |= triple("OFF", off_g) | triple("SCALE", np.diag(matrix)) | triple("COMP", comp)
    return told | triple("ODIAG", [matrix[i, j] for i, j in PAIRS])


def case_of(told: dict[str, float]) -> Any:
    """All that ``shaped`` asks of a case."""
    held = Px4Calibrations()
    for name, value in told.items():
        held.param(ParamReading(1, 1, name, value, 65535, 0))
    held.sensor(1, DEVICE, "sensor_mag")
    boot = SimpleNamespace(calibrations=held)
    return SimpleNamespace(compass=1, told=SimpleNamespace(boot=boot), matrix=held.shaping(1).matrix)


def terms(bend: np.ndarray, per_unit_mg: Any = (0.0, 0.0, 0.0), of: str | None = None) -> Terms:
    return Terms(bend, np.array(per_unit_mg), of, None, None, None)


def as_px4(values: dict[str, float], raw_mg: np.ndarray, power: float) -> np.ndarray:
    """body = R S (raw + power COMP - OFF), gauss (PX4's Magnetometer.hpp); (N, 3) mG of (N, 3) mG in sensor axes."""
    off, comp, diagonal, rest = (np.array([values[f"CAL_MAG1_{a}{w}"] for a in "XYZ"]) for w in
                                 ("OFF", "COMP", "SCALE", "ODIAG"))  # fmt: skip
    matrix = np.diag(diagonal)
    for value, (i, j) in zip(rest, PAIRS, strict=True):
        matrix[i, j] = matrix[j, i] = value
    turn = TURNS[int(values["CAL_MAG1_ROT"])] @ matrix
    out: np.ndarray = 1000.0 * (raw_mg / 1000.0 + power * comp - off) @ turn.T
    return out


def test_a_body_matrix_comes_out_in_the_axes_of_a_sensor_turned_by_90_degrees_in_yaw() -> None:
    """Its x axis points right and its y axis back: XX is the body's YY, XY minus its XY, XZ its YZ, YZ minus its XZ."""
    bend = np.array([[1.10, 0.02, -0.04], [0.02, 0.95, 0.03], [-0.04, 0.03, 1.05]])
    new = shaped(case_of(stored(2, np.eye(3), (0.1, 0.2, 0.3), (0, 0, 0), 0.0)), terms(bend))
    assert new is not None
    assert new.new == triple("SCALE", (0.95, 1.10, 1.05)) | triple("ODIAG", (-0.02, 0.03, 0.04))
    assert new.old == triple("SCALE", (1, 1, 1)) | triple("ODIAG", (0, 0, 0)) and new.changed == new.new


def test_a_motor_term_is_in_gauss_in_sensor_axes_per_kiloampere_or_full_throttle_and_added_before_the_scale() -> None:
    """1 mG/A is 1 G/kA; what power adds is taken away, so the sign turns; behind a scale of 2 half of it does."""
    told = stored(2, 2.0 * np.eye(3), (0, 0, 0), (0, 0, 0), 0.0)
    by_current = shaped(case_of(told), terms(np.eye(3), (1.0, 2.0, -3.0), "current"))
    assert by_current is not None
    # Body x is the sensor's -y, body y its x.
    assert by_current.new == triple("COMP", (-1.0, 0.5, 1.5)) | {"CAL_MAG_COMP_TYP": 2.0}
    by_throttle = shaped(case_of(told), terms(np.eye(3), (100.0, 200.0, -300.0), "throttle"))
    assert by_throttle is not None
    assert by_throttle.new == triple("COMP", (-0.1, 0.05, 0.15)) | {"CAL_MAG_COMP_TYP": 1.0}


@pytest.mark.parametrize("rotation", sorted(TURNS))
@pytest.mark.parametrize(("of", "kind", "per"), [(None, 0.0, 0.0), ("throttle", 1.0, 1.0), ("current", 2.0, 1e-3)])
@pytest.mark.parametrize("held_kind", [0.0, 1.0, 2.0])
def test_what_is_written_gives_the_predicted_field_at_every_power(
    rotation: int, of: str | None, kind: float, per: float, held_kind: float
) -> None:
    """Over stored scales, off-diagonals and motor terms that are not the identity. Both PX4's formula and ours."""
    rng = np.random.default_rng(7 * rotation + int(10 * kind + held_kind))
    shape, level = (np.eye(3) + 0.5 * (e + e.T) for e in rng.uniform(-0.1, 0.1, (2, 3, 3)))
    comp = rng.uniform(-0.5, 0.5, 3)
    told = stored(rotation, shape, rng.uniform(-0.4, 0.4, 3), comp, held_kind)
    case = case_of(told)
    bend = level @ np.linalg.inv(case.matrix)  # so that what is stored in the end is symmetric
    per_unit = rng.uniform(-3.0, 3.0, 3) / (1.0 if of == "current" else 0.02) if of else np.zeros(3)
    new = shaped(case, terms(bend, per_unit, of))
    if of is not None and held_kind not in (0.0, kind):
        assert new is None, "PX4 knows one kind of power at a time"
        return
    assert new is not None
    assert set(new.new) == {f"CAL_MAG1_{a}{w}" for a in "XYZ" for w in ("SCALE", "ODIAG", *["COMP"] * bool(of))} | (
        {"CAL_MAG_COMP_TYP"} if of else set()
    )
    raw = rng.uniform(-600.0, 600.0, (40, 3))
    for power in (0.0, 0.4, 30.0) if of == "current" else (0.0, 0.4, 1.0):
        unit = power * {0.0: 0.0, 1.0: 1.0, 2.0: 1e-3}[held_kind]  # what PX4 multiplies the stored term with
        wanted = (as_px4(told, raw, unit) - power * per_unit) @ bend.T
        got = as_px4(told | new.new, raw, power * per if of else unit)
        np.testing.assert_allclose(got, wanted, atol=1e-3)
        body, many = raw @ TURNS[rotation].T, np.full(len(raw), power)
        if held_kind or of:
            ours = as_the_autopilot_would(12, 1, DEVICE, told | new.new, body, many, many)
            np.testing.assert_allclose(ours, wanted, atol=1e-3)


def test_nothing_is_written_for_a_release_without_off_diagonal_terms() -> None:
    told = {n: v for n, v in stored(0, np.eye(3), (0, 0, 0), (0, 0, 0), 0.0).items() if "ODIAG" not in n}
    assert shaped(case_of(told), terms(np.diag([1.1, 1.0, 0.9]))) is None
    only_motor = shaped(case_of(told), terms(np.eye(3), (1.0, 0.0, 0.0), "current"))
    assert only_motor is not None and "CAL_MAG1_XCOMP" in only_motor.new
    without = {n: v for n, v in told.items() if n != "CAL_MAG_COMP_TYP"}
    assert shaped(case_of(without), terms(np.eye(3), (1.0, 0.0, 0.0), "current")) is None


def test_offsets_and_shape_are_one_set_and_only_what_differs_is_in_the_file() -> None:
    one = NewParameters({"CAL_MAG1_XOFF": 0.25, "CAL_MAG1_YOFF": 0.5}, {"CAL_MAG1_XOFF": 0.125, "CAL_MAG1_YOFF": 0.5})
    other = shaped(case_of(stored(0, np.eye(3), (0, 0, 0), (0, 0, 0), 0.0)), terms(np.diag([1.5, 1.0, 1.0])))
    assert other is not None
    assert both(one, other).changed == {"CAL_MAG1_XOFF": 0.125, "CAL_MAG1_XSCALE": 1.5}


@pytest.mark.long
def test_soft_iron_of_a_ulg_is_written_in_px4s_names_and_makes_the_field_round(tmp_path: Path) -> None:
    plan = unattended(load_scenario("soft_iron"))
    spec = plan.compasses[0]
    path = tmp_path / "bent.ulg"
    with Recorder(sim := Simulation(msgspec.structs.replace(plan, compasses=[spec])), [path]):
        sim.advance(115.0)
    result = magmav.fit(path, options=magmav.FitOptions(soft_iron=True))
    ((compass,),) = (vehicle["compasses"] for vehicle in result["vehicles"])
    fit = compass["fit"]
    assert fit["soft_iron"]["earned"] and fit["parameters"]["autopilot"] == "px4"
    new = fit["parameters"]["new"]
    names = [f"CAL_MAG0_{a}{what}" for what in ("SCALE", "ODIAG") for a in "XYZ"]
    assert set(names) < set(new) and {n for n in new if n.endswith("OFF")} == {f"CAL_MAG0_{a}OFF" for a in "XYZ"}
    assert fit["parameters"]["closure_mg"] < 2.0
    (xx, yy, zz), (xy, xz, yz) = ([new[f"CAL_MAG0_{a}{what}"] for a in "XYZ"] for what in ("SCALE", "ODIAG"))
    whole = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ np.array(spec.soft)
    np.testing.assert_allclose(whole / np.cbrt(np.linalg.det(whole)), np.eye(3), atol=0.03)
