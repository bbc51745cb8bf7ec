"""Every reason a result or a refusal can carry: one vocabulary for log, wire, JSON and page."""

from __future__ import annotations

from enum import Enum


class Reason(Enum):
    """Every reason a result or a refusal can carry: a stable name, a number for the wire, a plain sentence."""

    NO_COMPASS = (1, "no magnetometer data seen")
    NO_ATTITUDE = (2, "no ATTITUDE: tilt comes from accelerometer and gyro")
    NO_POSITION = (3, "no position: expected field and declination unknown, heading is magnetic")
    RELATIVE_ONLY = (4, "stored offsets or device id unknown: result is a change relative to them")
    ASSUMED_DEFAULT = (5, "matrix, scale or motor terms not seen: autopilot defaults assumed")
    NOT_FLYING = (6, "waiting for take-off: nothing on the ground makes it ready")
    TOO_LITTLE_DATA = (7, "not enough distinct samples yet")
    X_NOT_OBSERVED = (8, "forward axis not observed: turn the vehicle")
    Y_NOT_OBSERVED = (9, "right axis not observed: turn the vehicle")
    Z_NOT_OBSERVED = (10, "down axis not observed: only tilting shows it, it stays as stored")
    Z_FROM_MODEL = (11, "down axis rests on the field model, not on motion")
    STILL_MOVING = (12, "estimate still changing more than its sigma")
    JUST_CHANGED = (13, "field changed suddenly a moment ago, learning again")
    FIELD_NOT_EARTHLIKE = (
        14,
        "corrected field strength does not fit the Earth's: magnet or steel near compass",
    )
    RESIDUAL_TOO_LARGE = (15, "readings scatter too much around the fit")
    HEADING_UNSURE = (16, "heading sigma too large")
    HORIZONTAL_WEAK = (17, "horizontal field under 100 mG: a compass is weak here")
    PARAMETERS_CHANGED = (18, "compass parameters changed: offsets are followed exactly, all else begins anew")
    STALE = (19, "no fresh magnetometer data")
    FROZEN = (20, "magnetometer value never changes: sensor stuck")
    TWO_AXES = (22, "two axes used: the third comes from the dip of the place; without a position no heading")
    MOUNTING_WRONG = (23, "compass is mounted turned against the vehicle: see causes")
    SCALE_WRONG = (24, "compass shows the wrong strength of field: see causes")
    OPINIONS_DIFFER = (
        25,
        "another opinion, the field's length alone or the world model, differs by more than chance",
    )
    NO_CALIBRATION = (21, "no calibration that is ready for this compass")
    ARMED = (30, "vehicle is armed")
    NOT_LANDED = (31, "vehicle is not known to be on the ground")
    HEARTBEAT_OLD = (32, "no heartbeat in the last 1.2 s over this route")
    SECOND_WRITER = (33, "another calibration or learning mode is active")
    DEVICE_CHANGED = (34, "device id differs from the one estimated")
    OFFSETS_CHANGED = (35, "stored offsets changed since the estimate")
    BEYOND_LIMIT = (36, "an offset is beyond the allowed range")
    CONFIRM_CHANGE = (37, "change above 150 mG wants the confirmation code")
    UNKNOWN_PARAM = (38, "autopilot did not answer for a parameter")
    NOT_OBSERVED = (39, "no axis is observed well enough to write")
    NOTHING_TO_DO = (40, "stored offsets already are the right ones")
    BUSY = (41, "another upload or restore is running")
    UNPROVEN = (42, "corrected field did not move as predicted: old values restored")
    NO_STREAM = (43, "no magnetometer stream to prove the change with")
    WRONG_VEHICLE = (44, "not the vehicle this was made for")
    NO_SNAPSHOT = (45, "no earlier values on record to restore")
    SECOND_ROUTE = (46, "the same autopilot is claimed over a second route")
    LINK_LOST = (47, "link to the vehicle was lost")
    NOT_SUPPORTED = (48, "upload to this autopilot is not supported yet")
    NOT_RECORDED = (49, "the change could not be put on record first")
    MAPPING_UNCLEAR = (50, "not clear which stored parameters belong to this compass")
    TOO_SMALL = (56, "change is too small: this autopilot takes it up only when it restarts")
    REBOOT_TO_APPLY = (57, "written and read back, but no stream of this autopilot can prove it: reboot it")
    NOT_COMMITTED = (
        58,
        "stored, but the autopilot will still say not calibrated: commit the device id by hand, then reboot",
    )
    PERHAPS_NOT_COMMITTED = (
        59,
        "stored, but never calibrated before: the autopilot may still say not calibrated",
    )

    LINK_SIGNED_READ_ONLY = (64, "the vehicle signs its messages and no key is held here: only listening")

    def __init__(self, number: int, text: str) -> None:
        self.number = number
        self.text = text
