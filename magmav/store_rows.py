"""What the store keeps, and how it is written into rows and read back: JSON in which every float32 survives exactly."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from magmav.core.types import AxisState, Change, Reason, State, UploadResult, Verdict
from magmav.mavlink.kept import Keeping


@dataclass(frozen=True, slots=True)
class Write:
    """One write to a vehicle; result None: cut short. Upload(change, ..., undoes=id) undoes it.

    vehicle : who it was made to, see ``mavlink.uid.key``.  boot_ms : the autopilot's boot clock when it ended, None
    where it was not known.  kept : what was found after the next reboot, None before.
    """

    id: int
    unix_ns: int
    vehicle: str
    change: Change
    undoes: int | None
    result: UploadResult | None
    reasons: tuple[Reason, ...]
    undone: bool  # its old values were brought back later
    boot_ms: int | None = None
    kept: Keeping | None = None


@dataclass(frozen=True, slots=True)
class SavedEstimate:
    """The latest answer for one compass: what an upload would change, and how good it is.

    offsets_mg, sigma_mg : (x, y, z), mG, body axes, as ArduPilot would add them.
    """

    unix_ns: int
    vehicle: str
    change: Change
    verdict: Verdict
    offsets_mg: tuple[float, float, float]
    sigma_mg: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Learnt:
    """What one flight taught about one compass, whether it was written or not.

    unix_ns : when it began, None where nobody knew the date.  device_id : 0 where it is not known.
    source : "live" or "fit".  origin : what tells this flight from others: take-off time, or the recording's sha256.
    old_offsets_mg, new_offsets_mg, change_mg, sigma_mg : (x, y, z), mG, body axes, as ArduPilot would add them; None
    where the stored ones are not known.  old, new : the parameters a write would have changed.
    card : (heading, error before, error after) of a level vehicle on eight headings, degrees.
    heading : {"reference", "before_rms_deg", "after_rms_deg"} of the flight itself, where something measured it.
    """

    unix_ns: int | None
    system: int
    compass: int
    device_id: int
    vehicle: str
    source: str
    origin: str
    name: str
    state: str
    reasons: tuple[str, ...]
    axes: tuple[str, ...]
    old_offsets_mg: tuple[float, ...] | None
    new_offsets_mg: tuple[float, ...] | None
    change_mg: tuple[float, ...] | None
    sigma_mg: tuple[float, ...]
    old: dict[str, float]
    new: dict[str, float]
    card: tuple[tuple[float | None, ...], ...] = ()
    heading: dict[str, Any] | None = None
    id: int = 0


WRITE_COLUMNS = "id, unix_ns, vehicle, change, undoes, result, reasons, undone, boot_ms, kept"
LEARNT_COLUMNS = "unix_ns, system, compass, device_id, vehicle, source, origin"
ESTIMATE_COLUMNS = "unix_ns, vehicle, change, verdict, offsets_mg, sigma_mg"


def pack(change: Change) -> str:
    """JSON; Python writes doubles so that they read back the same."""
    return json.dumps(asdict(change), allow_nan=False)


def unpack(text: str) -> Change:
    """The change again. ValueError, KeyError or TypeError for what is none."""
    held: dict[str, Any] = json.loads(text)
    fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in held.items()}
    return Change(**fields)


def write_of(row: Sequence[Any]) -> Write:
    """A row of WRITE_COLUMNS."""
    number, unix_ns, vehicle, change, undoes, result, reasons, undone, boot_ms, kept = row
    named = tuple(Reason[name] for name in json.loads(reasons))
    ended = None if result is None else UploadResult[result]
    found = None if kept is None else Keeping[kept]
    return Write(number, unix_ns, vehicle, unpack(change), undoes, ended, named, bool(undone), boot_ms, found)


def estimate_row(estimate: SavedEstimate) -> tuple[Any, ...]:
    """Values of ESTIMATE_COLUMNS."""
    verdict = {
        "state": estimate.verdict.state.name,
        "axes": [axis.name for axis in estimate.verdict.axes],
        "reasons": [reason.name for reason in estimate.verdict.reasons],
    }
    offsets, sigma = json.dumps(estimate.offsets_mg), json.dumps(estimate.sigma_mg)
    return estimate.unix_ns, estimate.vehicle, pack(estimate.change), json.dumps(verdict), offsets, sigma


def estimate_of(row: Sequence[Any]) -> SavedEstimate:
    """A row of ESTIMATE_COLUMNS."""
    unix_ns, vehicle, change, verdict, offsets_mg, sigma_mg = row
    said = json.loads(verdict)
    x, y, z = (AxisState[name] for name in said["axes"])
    judged = Verdict(State[said["state"]], (x, y, z), tuple(Reason[name] for name in said["reasons"]))
    return SavedEstimate(unix_ns, vehicle, unpack(change), judged, _three(offsets_mg), _three(sigma_mg))


def learnt_row(learnt: Learnt) -> tuple[Any, ...]:
    """Values of LEARNT_COLUMNS, and the rest as JSON."""
    held = asdict(learnt)
    del held["id"]
    return *(held.pop(name) for name in LEARNT_COLUMNS.split(", ")), json.dumps(held, allow_nan=False)


def learnt_of(row: Sequence[Any]) -> Learnt:
    """A row of id, LEARNT_COLUMNS and the JSON."""
    number, *columns, text = row
    rest = {k: _tuples(v) for k, v in json.loads(text).items()}
    return Learnt(**dict(zip(LEARNT_COLUMNS.split(", "), columns, strict=True)), **rest, id=number)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _three(text: str) -> tuple[float, float, float]:
    x, y, z = map(float, json.loads(text))
    return x, y, z
