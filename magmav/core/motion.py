"""Tilt and turning at any moment: from the autopilot's attitude, or, where there is none, from gyro and accelerometer.

Heading is only ever integrated from body rates (over gaps in a slow telemetry stream, from the attitude's own yaw
steps): the autopilot's yaw follows the compass that is being judged, so its value is never used.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from magmav.core.lately import Heard, Lately
from magmav.core.marg_attitude import Carried, MargAttitude
from magmav.core.motion_run import RATES_HOLD_S, MotionRun
from magmav.core.own_frame import carried, levelled, matrix, of_attitude, stepped
from magmav.core.rotation import (
    cross_matrix,
    euler_rates,
    euler_rates_at,
    level_from_body,
    tilt_from_force,
    wrap_pi,
)
from magmav.core.tilt_doubt import TiltDoubt
from magmav.core.types import ZERO3, AttitudeReading, InertialReading, Mat3, Vec3

_FRESH_NS = 600_000_000  # an attitude older than this is not extrapolated (estimation.md section 5)
_LOST_S = 5.0
_RECENT = 12
_TILT_TAU_S = 3.0  # accelerometer corrects the gyro's tilt with this time constant
_G = 9.80665


OWN_TILTS = ("marg_gn", "marg_gd", "complementary")
"""What can give the tilt of a vehicle that sends no attitude: the solvers of core.marg_attitude, or _OwnTilt."""


class MotionState(NamedTuple):
    """Tilt, body rate and integrated heading at one moment."""

    roll_rad: float
    pitch_rad: float
    yaw_rad: float  # integrated, unwrapped, arbitrary zero; comparable only within one epoch
    rate_b_rads: Vec3
    source: str
    epoch: int
    bridged: bool  # the yaw step over a long gap is still good
    body_from_own: Mat3  # from a frame level with the earth, carried along by the gyro; good at every attitude
    own_tilt_rad: float = 0.0  # sigma about each level axis of a tilt that is OWN
    every_s: float = 0.0  # between the last two readings it is from


class Motion:
    """Keeps the latest tilt of one vehicle.

    own : which of OWN_TILTS gives it where no attitude comes.
    """

    def __init__(self, own: str = "complementary") -> None:
        self.seen_attitude = False
        self._lately = Lately()
        self._epoch = 0
        self._every_s = 0.0
        self._inertial_ns: int | None = None
        self._inertial_every_s = 0.0
        self._asked: tuple[int, MotionState | None] | None = None  # compasses of one moment ask the same
        if own not in OWN_TILTS:
            raise ValueError(f"own: want one of {', '.join(OWN_TILTS)}, got {own!r}")
        self._own: _OwnTilt | MargAttitude = _OwnTilt()
        if own != "complementary":
            self._own = MargAttitude("gn" if own == "marg_gn" else "gd")

    def attitude(self, r: AttitudeReading) -> bool:
        """Take one attitude; False when it is a duplicate or late.

        Turning about the vertical comes from the gyro alone (over long gaps from the attitude's own step). The own
        frame is turned on by the gyro, then made level with the attitude by the shortest way: no angle is singular,
        and a tail-sitter standing on its tail is like any other.
        """
        if not self._lately.before(r.boot_ns):
            return False
        self._hear(r)
        return True

    def _hear(self, r: AttitudeReading) -> Heard:
        last = self._lately.newest()
        x, y, z = r.rate_b_rads.tolist()
        cr, sr, cp, sp = math.cos(r.roll_rad), math.sin(r.roll_rad), math.cos(r.pitch_rad), math.sin(r.pitch_rad)
        euler = euler_rates_at(cr, sr, cp, sp, x, y, z)
        dt = math.inf if last is None else (r.boot_ns - last.boot_ns) / 1e9
        self._every_s = min(dt, _LOST_S)
        if last is None:
            yaw, frame = 0.0, of_attitude(r.roll_rad, r.pitch_rad, 0.0)
        elif dt <= RATES_HOLD_S:
            yaw = last.yaw_rad + 0.5 * (last.euler_rads[2] + euler[2]) * dt
            p, q, w = last.rate_b_rads
            frame = carried(last.own_frame, (0.5 * (p + x), 0.5 * (q + y), 0.5 * (w + z)), dt)
            frame = levelled(frame, (-sp, cp * sr, cp * cr))
        else:
            was, now = last.reading, of_attitude(r.roll_rad, r.pitch_rad, r.yaw_rad)
            yaw, frame = last.yaw_rad, now
            if dt <= _LOST_S:
                yaw += wrap_pi(r.yaw_rad - was.yaw_rad)
                frame = stepped(last.own_frame, of_attitude(was.roll_rad, was.pitch_rad, was.yaw_rad), now)
            else:
                self._epoch += 2
                self._lately.clear()
        out = Heard(r.boot_ns, r, (x, y, z), euler, yaw, frame)
        self._lately.add(out)
        self._asked, self.seen_attitude = None, True
        return out

    def follows(self, r: MotionRun) -> bool:
        """Is it later than all that was heard?"""
        return self._lately.before(r.first_ns)

    def run(self, r: MotionRun) -> None:
        """Take many at once, where they follow."""
        columns, self._asked = r.attitudes, None
        row = r.begin
        while row < r.end and not self._lately.goes_on(r, row):
            self._lately.go(r, row, self._hear(columns.reading(row, r.system)))
            row += 1
        if row < r.end:
            self._every_s = self._lately.until(r.end)
        latest, before = r.inertial_ns
        if latest >= 0:
            before = before if before >= 0 or self._inertial_ns is None else self._inertial_ns
            if 0 <= before < latest:
                self._inertial_every_s = min((latest - before) / 1e9, _LOST_S)
            self._inertial_ns = latest
            self._own.seed(columns.reading(r.before_inertial, r.system))

    def inertial(self, r: InertialReading) -> None:
        """Take accelerometer and gyro. While attitudes come, they only mark where own tilt would start from."""
        self._asked = None
        if self._inertial_ns is not None and r.boot_ns > self._inertial_ns:
            self._inertial_every_s = min((r.boot_ns - self._inertial_ns) / 1e9, _LOST_S)
        self._inertial_ns = r.boot_ns
        last = self._lately.newest()
        if last is not None and r.boot_ns - last.boot_ns <= _FRESH_NS:
            self._own.seed(last.reading)
        else:
            self._own.step(r)

    def field(self, field_b_mg: Vec3, age_s: float, sigma_rad: float) -> None:
        """Take a calibrated magnetometer value, (3,) mG, age_s old: it moves own yaw, never tilt or turning.

        sigma_rad : of the heading it gives.
        """
        if isinstance(self._own, MargAttitude):
            self._own.field(field_b_mg, age_s, sigma_rad)
            self._asked = None

    def magnetic_yaw(self, boot_ns: int) -> float | None:
        """Own yaw from magnetic north, rad in [0, 2 pi); None where attitudes come or own yaw is not known."""
        return self._own.magnetic_yaw(boot_ns) if isinstance(self._own, MargAttitude) else None

    @property
    def rate_rads(self) -> float:
        """Length of the newest body rate, rad/s, 0 when nothing is known."""
        last = self._lately.newest()
        x, y, z = self._own.rate_b_rads.tolist() if last is None else last.rate_b_rads
        return math.hypot(x, y, z)

    def at(self, boot_ns: int) -> MotionState | None:
        """Tilt and turning at a boot time close to the newest reading; None when nothing is fresh enough."""
        if self._asked is None or self._asked[0] != boot_ns:
            heard = self._lately.nearest(boot_ns, _FRESH_NS)
            self._asked = boot_ns, self._by_own(boot_ns) if heard is None else self._by(heard, boot_ns)
        return self._asked[1]

    def yaw_at(self, boot_ns: int) -> tuple[float, int] | None:
        """Yaw and epoch of ``at``."""
        heard = self._lately.nearest(boot_ns, _FRESH_NS)
        if heard is not None:
            return heard.yaw_rad + heard.euler_rads[2] * ((boot_ns - heard.boot_ns) / 1e9), self._epoch
        own = self._own.at(boot_ns)
        return None if own is None else (own.yaw_rad, own.epoch)

    def _by(self, heard: Heard, boot_ns: int) -> MotionState:
        a, age, (dr, dp, dy) = heard.reading, (boot_ns - heard.boot_ns) / 1e9, heard.euler_rads
        return MotionState(
            a.roll_rad + dr * age,
            a.pitch_rad + dp * age,
            heard.yaw_rad + dy * age,
            a.rate_b_rads,
            "ATTITUDE",
            self._epoch,
            True,
            matrix(carried(heard.own_frame, heard.rate_b_rads, age)),
            0.0,
            self._every_s,
        )

    def _by_own(self, boot_ns: int) -> MotionState | None:
        own = self._own.at(boot_ns)
        if own is None:
            return None
        return MotionState(
            own.roll_rad,
            own.pitch_rad,
            own.yaw_rad,
            own.rate_b_rads,
            "OWN",
            own.epoch,
            False,
            matrix(of_attitude(own.roll_rad, own.pitch_rad, own.yaw_rad)),
            own.tilt_sigma_rad,
            self._inertial_every_s,
        )


class _OwnTilt:
    """Tilt from a gyro that carries the down direction along, and an accelerometer that slowly corrects it."""

    def __init__(self) -> None:
        self._down_b = np.zeros(3)
        self._boot_ns: int | None = None
        self._source = ""
        self.rate_b_rads: Vec3 = ZERO3
        self._yaw_rad = 0.0
        self._epoch = 1
        self._doubt = TiltDoubt(_TILT_TAU_S, 0.03)

    def seed(self, a: AttitudeReading) -> None:
        """Start from the autopilot's tilt, should its attitudes end here."""
        if a.boot_ns != self._boot_ns:
            self._down_b = level_from_body(a.roll_rad, a.pitch_rad)[2]
            self._boot_ns, self.rate_b_rads = a.boot_ns, a.rate_b_rads

    def step(self, r: InertialReading) -> None:
        """Propagate by the gyro, pull towards the accelerometer's down while nothing else accelerates."""
        if self._source and r.source != self._source:
            return
        start = tilt_from_force(r.force_b_mss)
        if start is None or (self._boot_ns is not None and r.boot_ns <= self._boot_ns):
            return
        strength = float(np.linalg.norm(r.force_b_mss))
        down = -r.force_b_mss / strength
        dt = 0.0 if self._boot_ns is None else (r.boot_ns - self._boot_ns) / 1e9
        self._source = r.source
        if self._boot_ns is None or dt > 1.0:
            self._down_b = down
            self._epoch += 2
            self._doubt = TiltDoubt(_TILT_TAU_S, 0.03)
        else:
            roll, pitch = self._tilt()
            self._yaw_rad += euler_rates(roll, pitch, 0.5 * (self.rate_b_rads + r.rate_b_rads))[2] * dt
            x, y, z = 0.5 * (self.rate_b_rads + r.rate_b_rads) * dt
            moved = self._down_b - cross_matrix(x, y, z) @ self._down_b
            trust = math.exp(-(((strength - _G) / (0.1 * _G)) ** 2))
            pull = matrix(of_attitude(roll, pitch, self._yaw_rad)).T @ (down - moved)
            self._doubt.step((float(pull[0]), float(pull[1])), trust, self.rate_b_rads, dt)
            moved += trust * (1.0 - math.exp(-dt / _TILT_TAU_S)) * (down - moved)
            self._down_b = moved / np.linalg.norm(moved)
        self._boot_ns, self.rate_b_rads = r.boot_ns, r.rate_b_rads

    def _tilt(self) -> tuple[float, float]:
        return tilt_from_force(-self._down_b) or (0.0, 0.0)

    def at(self, boot_ns: int) -> Carried | None:
        """Tilt at a boot time within 0.2 s of the last reading."""
        if self._boot_ns is None or abs(boot_ns - self._boot_ns) > 200_000_000:
            return None
        age = (boot_ns - self._boot_ns) / 1e9
        roll, pitch = self._tilt()
        dr, dp, dy = euler_rates(roll, pitch, self.rate_b_rads)
        yaw = self._yaw_rad + dy * age
        return Carried(roll + dr * age, pitch + dp * age, yaw, self.rate_b_rads, self._epoch, self._doubt.sigma_rad)
