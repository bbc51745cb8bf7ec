"""Runs MAVProxy's own magfit (GPL-3.0-or-later, a program of its own) on one flight. Not part of magmav.

    python mavproxy.py FLIGHT.npz [plain|elliptical]        prints one JSON object

Called by the Python of the environment MAVProxy lives in. Its window is not needed: wx is a stand-in that draws
nothing. The fit gets at most 300 values, as its own --reduce would give it: it takes minutes otherwise.
"""

import contextlib
import json
import math
import sys
import types
from types import SimpleNamespace

import numpy as np


class _Nothing(types.ModuleType):
    """Any name asked of it is a class without content."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


for module in ("wx", "wx.lib", "wx.lib.agw", "wx.grid", "wx.dataview"):
    sys.modules[module] = _Nothing(module)

MOST = 300
LIMITS = {"OffsetMax": 1500, "ScaleMin": 1.0, "ScaleMax": 1.0, "DiagonalMin": 0.8, "DiagonalMax": 1.2,
          "OffDiagMin": -0.2, "OffDiagMax": 0.2, "CMOT": False, "CMOT NoChange": False, "CMOT Max": 10.0}  # fmt: skip


def fit(magfit, vector, flight, until_s, elliptical):
    """Offsets as ArduPilot adds them become a hard iron; the matrix is what follows."""
    rows = np.flatnonzero(flight["t_s"] <= until_s)
    rows = rows[:: max(1, math.ceil(len(rows) / MOST))]
    if len(rows) < 20:
        raise ValueError("too little data")
    magfit.earth_field = vector(*flight["model_n_mg"])
    magfit.declination = math.degrees(math.atan2(flight["model_n_mg"][1], flight["model_n_mg"][0]))
    magfit.margs = {**LIMITS, "Elliptical": elliptical}
    magfit.old_corrections = magfit.Correction()
    roll, pitch = np.degrees(flight["roll_rad"]), np.degrees(flight["pitch_rad"])
    magfit.data = [
        (
            SimpleNamespace(MagX=float(m[0]), MagY=float(m[1]), MagZ=float(m[2])),
            SimpleNamespace(Roll=float(roll[i]), Pitch=float(pitch[i]), Yaw=0.0),
            None,
        )
        for i, m in ((i, flight["mag_mg"][i]) for i in rows)
    ]
    try:
        c = magfit.fit_WWW()
    except SystemExit:
        raise ValueError("fit failed") from None
    d, o = c.diag, c.offdiag
    matrix = c.scaling * np.array(((d.x, o.x, o.y), (o.x, d.y, o.z), (o.y, o.z, d.z)))
    return {"hard_iron_mg": [-c.offsets.x, -c.offsets.y, -c.offsets.z], "matrix": matrix.tolist()}


def main():
    with contextlib.redirect_stdout(sys.stderr):
        from MAVProxy.modules.lib import magfit
        from pymavlink.rotmat import Vector3

        flight = dict(np.load(sys.argv[1]))
        out = {}
        elliptical = sys.argv[2:] == ["elliptical"]
        name = "mavproxy_ell" if elliptical else "mavproxy"
        for t in flight["checkpoints_s"]:
            try:
                answer = fit(magfit, Vector3, flight, t, elliptical)
            except (ValueError, ArithmeticError) as error:
                answer = {"error": str(error)}
            out.setdefault(name, []).append(answer)
    print(json.dumps(out))


if __name__ == "__main__":
    main()
