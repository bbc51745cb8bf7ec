"""A compass calibration as ArduPilot stores it, said in PX4's terms: the same field out of the same sensor.

    ArduPilot   body = scale M (R sensor + OFS) + MOT x           mG, x throttle or ampere
    PX4         body = R S (sensor + COMP p - OFF)                gauss, p throttle or kiloampere
(autopilots.md 2.1 and 4.2.) So S = R' scale M R, OFF = -R' OFS, COMP p = S^-1 R' MOT x; R is the mounting.
"""

from __future__ import annotations

import numpy as np

from magmav_sim.correction import stored_correction
from magmav_sim.parameters import Parameters, compass_name

_GAUSS_PER_MG = 1e-3
_AMPERE_PER_KILOAMPERE = 1e3
_LEAST_SCALE, _MOST_SCALE = 1 / 1.5, 1.5
_PRIORITY = (75, 50, 25)  # ArduPilot's order of compasses, as the highest goes first with PX4


def px4_parameters(parameters: Parameters, compasses: int) -> dict[str, int | float]:
    """CAL_MAG* of the first compasses, int where PX4 has int32, else float.

    A motor term behind a matrix that cannot be inverted is left out: no COMP does the same.
    """
    mode = int(parameters["COMPASS_MOTCT"])
    out: dict[str, int | float] = {"CAL_MAG_COMP_TYP": mode if mode in (1, 2) else 0}
    for number in range(1, compasses + 1):
        held = stored_correction(parameters, number)
        name = f"CAL_MAG{number - 1}_"
        external = parameters[compass_name("EXTERNAL", number)] > 0
        to_body = np.eye(3) if held.rotation is None else np.array(held.rotation)
        matrix = np.eye(3)
        if held.diagonal != (0.0, 0.0, 0.0):
            (dx, dy, dz), (xy, xz, yz) = held.diagonal, held.off_diagonal
            matrix = np.array([[dx, xy, xz], [xy, dy, yz], [xz, yz, dz]])
        if _LEAST_SCALE <= held.scale <= _MOST_SCALE:
            matrix = matrix * held.scale
        shape = to_body.T @ matrix @ to_body
        offset = -to_body.T @ np.array(held.offsets_mg) * _GAUSS_PER_MG
        motor = to_body.T @ np.array(held.motor_mg) * _GAUSS_PER_MG * (_AMPERE_PER_KILOAMPERE if mode == 2 else 1.0)
        sound = np.linalg.matrix_rank(shape) == 3
        comp = np.linalg.solve(shape, motor) if sound and out["CAL_MAG_COMP_TYP"] else np.zeros(3)
        rotation = 0 if held.rotation is None else int(parameters[compass_name("ORIENT", number)])
        out[name + "ID"] = int(parameters[compass_name("DEV_ID", number)])
        out[name + "ROT"] = rotation if external else -1
        out[name + "PRIO"] = _PRIORITY[number - 1]
        for i, axis in enumerate("XYZ"):
            out[f"{name}{axis}OFF"] = float(offset[i])
            out[f"{name}{axis}SCALE"] = float(shape[i, i])
            out[f"{name}{axis}COMP"] = float(comp[i])
        for axis, (i, j) in zip("XYZ", ((0, 1), (0, 2), (1, 2)), strict=True):
            out[f"{name}{axis}ODIAG"] = float(shape[i, j])
    return out
