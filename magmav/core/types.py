"""Every record that travels, frozen and checked once, where it is made.

Vectors are float64 arrays of shape (3,), read-only, body axes (forward, right, down) unless the name says
otherwise: ``_b_`` body, ``_n_`` north-east-down, ``_l_`` levelled (body with roll and pitch undone).
Field strength is in milligauss (``_mg``), angles and rates in radians, specific force in m/s^2.
``boot_ns`` is the vehicle's own clock; ``t_ns`` and ``now_ns`` are arrival times of the link.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magmav.core.reasons import Reason as Reason

Vec3 = NDArray[np.float64]
Mat3 = NDArray[np.float64]


def vec3(value: object, name: str) -> Vec3:
    """A finite, read-only float64 array of shape (3,); ValueError naming the culprit otherwise."""
    out = np.array(value, dtype=np.float64)
    if out.shape != (3,) or not all(map(math.isfinite, out.tolist())):  # numpy's isfinite takes thrice as long
        raise ValueError(f"{name}: want 3 finite numbers, got {value!r}")
    return shut(out)


def shut(made: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same array, read-only: for what was just made of numbers that are finite, and is nobody else's."""
    made.setflags(write=False)  # cheaper than flags.writeable
    return made


def mat3(value: object, name: str) -> Mat3:
    """A finite, read-only float64 array of shape (3, 3); ValueError naming the culprit otherwise."""
    out = np.array(value, dtype=np.float64)
    if out.shape != (3, 3) or not all(map(math.isfinite, out.ravel().tolist())):
        raise ValueError(f"{name}: want a finite 3 x 3 matrix, got {value!r}")
    out.setflags(write=False)
    return out


ZERO3 = vec3((0, 0, 0), "zero")
IDENTITY3 = mat3(np.eye(3), "identity")


# ---------------------------------------------------------------- readings: what one message said


@dataclass(frozen=True, slots=True, eq=False)
class MagReading:
    """One magnetometer triple as it was sent, already in mG and body axes, corrected or not by the sender."""

    system: int
    compass: int  # 1, 2 or 3
    source: str  # message name, so that one compass seen through two messages is not two compasses
    boot_ns: int
    field_b_mg: Vec3  # PX4's logged sensor_mag alone is in the sensor's own axes, see mavlink/autopilot/px4
    device_id: int = 0  # where the message says it


@dataclass(frozen=True, slots=True, eq=False)
class InertialReading:
    """Accelerometer (specific force, so level and still is -g on z) and gyro of one IMU, body axes."""

    system: int
    source: str
    boot_ns: int
    force_b_mss: Vec3
    rate_b_rads: Vec3


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeReading:
    """The autopilot's attitude. Yaw is true north, and on most vehicles follows the compass: never a measurement."""

    system: int
    source: str
    boot_ns: int
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    rate_b_rads: Vec3


@dataclass(frozen=True, slots=True)
class PositionReading:
    """Where the vehicle is (GLOBAL_POSITION_INT, or GPS_RAW_INT with a 3-D fix)."""

    system: int
    source: str
    boot_ns: int
    lat_deg: float
    lon_deg: float
    alt_m: float  # above mean sea level


@dataclass(frozen=True, slots=True)
class MotionReading:
    """How the vehicle moves over ground; height is above home and only as good as the sender's home."""

    system: int
    boot_ns: int
    north_mps: float
    east_mps: float
    height_m: float


@dataclass(frozen=True, slots=True)
class CurrentReading:
    """Battery current; the sender knows it (unknown is no reading)."""

    system: int
    source: str
    ampere: float


@dataclass(frozen=True, slots=True)
class ThrottleReading:
    """Throttle as a share of full, 0 to 1."""

    system: int
    share: float


@dataclass(frozen=True, slots=True)
class TimeReading:
    """The vehicle's boot clock against UNIX time, when it knows it."""

    system: int
    boot_ns: int
    unix_ns: int


@dataclass(frozen=True, slots=True)
class VehicleReading:
    """An autopilot's heartbeat."""

    system: int
    component: int
    autopilot: int  # MAV_AUTOPILOT
    kind: int  # MAV_TYPE
    armed: bool
    status: int  # MAV_STATE


class Landed(IntEnum):
    """MAV_LANDED_STATE, the values that say something."""

    ON_GROUND = 1
    IN_AIR = 2
    TAKING_OFF = 3
    LANDING = 4


@dataclass(frozen=True, slots=True)
class LandedReading:
    """EXTENDED_SYS_STATE when the landed state is known."""

    system: int
    state: Landed


@dataclass(frozen=True, slots=True)
class ParamReading:
    """One parameter the autopilot says it holds, float32 widened; index 65535 marks an echo."""

    system: int
    component: int
    name: str
    value: float
    index: int
    count: int


@dataclass(frozen=True, slots=True)
class CalibrationReading:
    """The calibration an autopilot says it applies to one compass (PX4's MAG_CAL_REPORT), in its own units and axes."""

    system: int
    compass: int
    offsets: tuple[float, float, float]
    matrix: tuple[float, float, float, float, float, float]  # xx, yy, zz, xy, xz, yz


Reading = (
    MagReading
    | InertialReading
    | AttitudeReading
    | PositionReading
    | MotionReading
    | CurrentReading
    | ThrottleReading
    | TimeReading
    | VehicleReading
    | LandedReading
    | ParamReading
    | CalibrationReading
)


# ---------------------------------------------------------------- what core is given and gives back


class EarthField(NamedTuple):
    """The Earth's field where the vehicle is, mG, true north-east-down."""

    north_mg: float
    east_mg: float
    down_mg: float


FieldModel = Callable[[float, float, float, int], EarthField | None]
"""(latitude deg, longitude deg, altitude m, UNIX ns) -> field, or None outside the model's years."""


@dataclass(frozen=True, slots=True, eq=False)
class Shaping:
    """What the autopilot does after adding offsets: truth = matrix @ (sensor - hard iron) + motor.

    matrix : (3, 3), scale and soft-iron matrix in one.  motor_b_mg : (3,), mG, what the autopilot adds last.
    Fitted through, never changed (users.md N16).
    """

    matrix: Mat3
    motor_b_mg: Vec3


NO_SHAPING = Shaping(IDENTITY3, ZERO3)


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One fresh magnetometer value with the motion that belongs to it. Estimators see nothing else.

    mag_b_mg is the sensor's own field, body axes, with all the autopilot's corrections undone. It was measured age_s
    before boot_ns (an autopilot sends an average over its refresh interval, some time later): rate_b_rads and the tilt
    are those of the measurement; lead_rad is how far the heading went on from there to boot_ns. yaw_step_rad is the
    change of heading since the previous sample of this compass, from body rates only. gap is True where that step
    cannot be trusted (first sample, silence, reboot).
    """

    system: int
    compass: int
    boot_ns: int
    dt_s: float
    mag_b_mg: Vec3
    shaping: Shaping
    rate_b_rads: Vec3
    roll_rad: float
    pitch_rad: float
    yaw_step_rad: float
    lead_rad: float
    age_s: float
    gap: bool
    tilt_from: str  # "ATTITUDE" or "OWN"
    learn: bool  # False on time that teaches nothing: on the ground, settling after a parameter change
    axes: int = 3  # 2: a two-axis compass; the z of mag_b_mg means nothing, and the matrix does not mix it in
    model_mg: tuple[float, float] | None = None  # the world model's field here, horizontal and down; None: no position
    body_from_own: Mat3 | None = None  # from a frame level with the earth that the gyro carries along; None: make it
    throttle: float | None = None  # share of full, 0 to 1; None where nobody says
    own_tilt_rad: float = math.radians(5.0)  # sigma of the tilt, about each level axis, where it is OWN
    by_hand: bool = False  # taught while disarmed, of a vehicle that flies: turned in somebody's hands
    tilt_every_s: float = 0.0  # between the readings the tilt is from: what lies between two is guessed at


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What one estimator believes about one compass.

    hard_iron_b_mg : (3,) mG, the sensor's own axes, at mean power, SUBTRACT it (ArduPilot adds its negative).
    covariance_mg2 : (3, 3) with everything used; own_sigma_mg : (3,) from motion alone, without the field model.
    field_l_mg : (2,) horizontal and downward field the data imply, mG; residual_mg : RMS of the fit, mG.
    step_nis : normalised innovation squared per axis, averaged over the last seconds (1 is ideal).
    says_b : of which of the sensor's axes the method says anything at all; where not, value and sigma mean nothing.
    """

    hard_iron_b_mg: Vec3
    covariance_mg2: Mat3
    own_sigma_mg: Vec3
    horizontal_mg: float
    down_mg: float
    residual_mg: float
    step_nis: float
    samples: int
    changed_ago_s: float  # seconds since the last sudden change was accepted; large when never
    delay_s: float = 0.0  # of the compass, beyond Sample.age_s, as far as the method can tell
    # truth is soft_iron_b @ (shaping.matrix @ (sensor - hard iron) + motor)
    soft_iron_b: Mat3 = field(default_factory=lambda: IDENTITY3)
    says_b: tuple[bool, bool, bool] = (True, True, True)
    throttle_b_mg: Vec3 = field(default_factory=lambda: ZERO3)  # what full throttle adds to matrix @ sensor, body axes
    throttle_mean: float = 0.0  # the throttle at which hard_iron_b_mg holds
    # no sigma is published under this: a real flight (thor75) missed its batch fit by 12 to 19 mG in z
    floor_mg: tuple[float, float, float] = (1.5, 1.5, 5.5)
    apart: float = 0.0  # sigmas between this and a second opinion, in the direction in which they are most


@dataclass(frozen=True, slots=True)
class Heading:
    """Heading of the corrected compass. A value whose flag is False means nothing and is never shown."""

    valid: bool
    true_valid: bool
    magnetic_rad: float
    true_rad: float
    sigma_rad: float


class AxisState(Enum):
    """How well one axis of the hard iron is known."""

    OBSERVED = "OBSERVED"
    FROM_MODEL = "FROM_MODEL"
    NOT_OBSERVED = "NOT_OBSERVED"


class State(IntEnum):
    """MMAG_STATE."""

    NO_DATA = 0
    LEARNING = 1
    READY = 2
    REFUSED = 3


@dataclass(frozen=True, slots=True)
class Verdict:
    """May this estimate be written to the vehicle, and why (not)."""

    state: State
    axes: tuple[AxisState, AxisState, AxisState]
    reasons: tuple[Reason, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """What was known after one sample: the one thing views see."""

    t_ns: int
    system: int
    compass: int
    device_id: int  # 0 when not known
    boot_ns: int
    age_s: float  # the field was measured this long before boot_ns
    mag_b_mg: Vec3
    corrected_b_mg: Vec3  # after the estimate
    stored_b_mg: Vec3  # after what the autopilot holds, as it streams it
    roll_rad: float
    pitch_rad: float
    estimate: Estimate
    offsets_mg: Vec3  # as ArduPilot would add them
    sigma_mg: Vec3
    heading: Heading
    stored_heading: Heading
    verdict: Verdict
    learnt: bool  # this sample moved the estimate
    relative: bool = False  # stored offsets or device id unknown: offsets_mg is a change of whatever is stored
    axes: int = 3  # 2: a two-axis compass; the z of mag_b_mg means nothing, that of corrected_b_mg comes from the dip
    published: Heading = Heading(False, False, 0.0, 0.0, 0.0)  # what goes out: heading, or smoothed as the settings say
    published_boot_ns: int = 0  # the time published belongs to
    throttle: float | None = None  # share of full


# ---------------------------------------------------------------- writing to a vehicle


class UploadResult(Enum):
    """How a write ended. The number is MMAG_RESULT."""

    ALL_NEW = 2
    ALL_OLD = 3
    WRITTEN_UNPROVEN = 4
    PENDING_RESTORE = 5
    REFUSED = -1


@dataclass(frozen=True, slots=True)
class Change:
    """A wish to change one compass's offsets, and what it was based on. Values are float32 exact.

    names, old and new run in parallel, in the autopilot's own names, units and frame. shift_b_mg is how the
    corrected stream must move once the change works, body axes, mG. device_name is the parameter holding device_id.
    """

    system: int
    compass: int
    device_name: str
    device_id: int
    names: tuple[str, ...]
    old: tuple[float, ...]
    new: tuple[float, ...]
    shift_b_mg: tuple[float, float, float]
    shift_sigma_mg: tuple[float, float, float]
    step_mg: tuple[float, ...]  # |new - old| per name in mG, for the limits
