"""magmav keeps a vehicle's compass calibrated while it flies, and says how sure it is.

Path     link -> mavlink.codec -> mavlink.decode -> core.assemble -> core.estimators -> core.gate -> mavlink -> link
         bytes   message          reading           Sample           Estimate           Verdict      message
Frames   b body (forward, right, down)   n earth (north, east, down)   l levelled: b with roll and pitch undone
Names    mag_b_mg is a field in b, milligauss.  R_bn takes n to b.  shape (3,) unless said.
Units    field mG, rates rad/s, angles rad, specific force m/s^2 (level and still: -g on z), time ns or s by name
Clocks   boot_ns is the vehicle's clock, for dt.  t_ns and now_ns are the link's arrival clock, for timeouts.
Sign     a hard iron is what you subtract.  Only mavlink/autopilot knows that ArduPilot adds and PX4 subtracts.

From a program: ``from magmav import replay, open_recording, Settings, world_magnetic_model, ESTIMATORS``. Importing
reads no file and opens nothing; names are fetched when first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_WHERE = {
    "replay": "magmav.library",
    "NothingToLearnFrom": "magmav.recording",
    "open_recording": "magmav.recording",
    "fit": "magmav.library",
    "FitOptions": "magmav.fitting",
    "Settings": "magmav.settings",
    "load_settings": "magmav.settings",
    "world_magnetic_model": "magmav.geomag",
    "Pipeline": "magmav.pipeline",
    "ESTIMATORS": "magmav.core.estimators",
    "Estimator": "magmav.core.estimators",
    "Estimate": "magmav.core.types",
    "Heading": "magmav.core.types",
    "Reason": "magmav.core.types",
    "Record": "magmav.core.types",
    "Sample": "magmav.core.types",
    "State": "magmav.core.types",
    "Verdict": "magmav.core.types",
    "RecordWriter": "magmav.view.records",
    "read_records": "magmav.view.records",
}
_AS = {"load_settings": "load"}

__all__ = ["__version__", *_WHERE]


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'magmav' has no attribute {name!r}")
    return getattr(import_module(_WHERE[name]), _AS.get(name, name))
