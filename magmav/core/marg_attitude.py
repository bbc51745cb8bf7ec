"""Own attitude of a vehicle that sends none: a gyro carries it along, the solvers of core.marg correct it.

The accelerometer corrects the tilt, the calibrated magnetometer the yaw, each by a step of the chosen solver. The two
never meet: the compass is calibrated with this very tilt, so a magnetometer that moved the tilt would confirm its own
error. With the direct reference the settled tilt is the accelerometer's anyway (seed-methods.md section 3, fact 2);
here that holds on the way there too, because the tilt sees only the accelerometer's rows of the error, and of the
six-row step on (own down, field) only the part about down is used. Turning is reported from the gyro alone, likewise.

The figures below were chosen on four recordings of a hand-moved IMU with optical truth (BROAD 02, 32, 34, 36).
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from magmav.core import marg
from magmav.core.marg import Array, Quaternion
from magmav.core.rotation import body_from_earth, euler_from_quaternion, tilt_from_force, wrap_pi, wrap_tau
from magmav.core.tilt_doubt import TiltDoubt
from magmav.core.types import ZERO3, AttitudeReading, InertialReading, Vec3, vec3

Solver = Literal["gn", "gd"]

_G = 9.80665
_DOWN_N = np.array((0.0, 0.0, 1.0))
_TILT_TAU_S = 3.0  # the accelerometer corrects the gyro's tilt with this time constant
_YAW_TAU_S = 5.0  # and the magnetometer its yaw
_YAW_CLIP = 2.0  # a field that disagrees by more sigmas than this pulls no harder than at this
_YAW_TRIAL_S = 10.0  # but only once the yaw has had this long to find its place
_FORCE_TAU_S = 1.0  # force is averaged over this in earth axes, where gravity stands still and a push comes and goes
_WIDTH = 0.1  # share of g off which trust in the accelerometer falls to 1/e
_LAG_S = 0.012  # a gyro is filtered: its rates come this late (measured on all four; ArduPilot's 20 Hz filter: 11 ms)
_LOST_S = 1.0  # after a longer silence the tilt starts again from the accelerometer
_FRESH_NS = 200_000_000
_YAW_HOLD_NS = 30_000_000_000  # the gyro alone holds a yaw this long


class Carried(NamedTuple):
    """An own attitude at one moment. yaw_rad is integrated from the gyro alone, unwrapped, its zero arbitrary."""

    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    rate_b_rads: Vec3
    epoch: int  # odd; yaws compare only within one epoch
    tilt_sigma_rad: float  # about each level axis


class _Rest:
    """Learns the gyro's bias while the vehicle lies still, where the mean rate can be nothing else.

    In motion the tilt's corrections look like a bias too: learnt there it cost 0.5 to 1.5 degrees of tilt on BROAD.
    """

    STEADY_RADS, STEADY_MSS, BIAS_RADS = 0.01, 0.3, 0.01
    MEAN_S, SETTLE_S, MEMORY_S = 0.5, 1.5, 10.0

    def __init__(self) -> None:
        self.bias_b_rads: Vec3 = ZERO3
        self._rate: Array = ZERO3
        self._force: Array = ZERO3
        self._still_s = 0.0
        self._learnt_s = 0.0

    def see(self, r: InertialReading, dt_s: float) -> None:
        """Take one reading, dt_s after the last; 0 starts the means anew."""
        weight = 1.0 - math.exp(-dt_s / self.MEAN_S) if dt_s > 0.0 else 1.0
        self._rate = self._rate + weight * (r.rate_b_rads - self._rate)
        self._force = self._force + weight * (r.force_b_mss - self._force)
        still = (
            dt_s > 0.0
            and math.dist(r.rate_b_rads, self._rate) < self.STEADY_RADS
            and math.dist(r.force_b_mss, self._force) < self.STEADY_MSS
            and math.hypot(*self._rate) < self.BIAS_RADS  # faster may be a slow turn
        )
        self._still_s = self._still_s + dt_s if still else 0.0
        if self._still_s > self.SETTLE_S:
            self._learnt_s = min(self._learnt_s + dt_s, self.MEMORY_S)
            self.bias_b_rads = self.bias_b_rads + dt_s / self._learnt_s * (self._rate - self.bias_b_rads)


class MargAttitude:
    """Roll, pitch and magnetic yaw from gyro, accelerometer and, once it is calibrated, magnetometer.

    solver : "gn" Gauss-Newton, "gd" gradient descent. Both are scaled to the same time constants near the answer; far
    off, Gauss-Newton is faster, and gradient descent turns the yaw slower by the square of the field's level share.
    """

    def __init__(self, solver: Solver = "gn") -> None:
        if solver not in ("gn", "gd"):
            raise ValueError(f"solver: want gn or gd, got {solver!r}")
        self._newton = solver == "gn"
        self.rate_b_rads: Vec3 = ZERO3  # bias taken off
        self._rest = _Rest()
        self._q: Quaternion = np.array((1.0, 0.0, 0.0, 0.0))  # north is wherever the gyro's own zero is
        self._force_n = -_G * _DOWN_N
        self._yaw_rad = 0.0
        self._epoch = 1
        self._boot_ns: int | None = None
        self._source = ""
        self._seed: AttitudeReading | None = None
        self._north_rad: float | None = None  # azimuth of magnetic north in those own axes
        self._field_ns = 0
        self._field_s = 0.0  # since the yaw was first known
        self._doubt = TiltDoubt(_TILT_TAU_S, 0.0)

    def seed(self, a: AttitudeReading) -> None:
        """Start from the autopilot's tilt, should its attitudes end here."""
        self._seed = a

    def step(self, r: InertialReading) -> None:
        """Carry on by the gyro, correct the tilt by the accelerometer. Free fall and other IMUs are not used."""
        if self._source and r.source != self._source:
            return
        self._take_seed()
        if tilt_from_force(r.force_b_mss) is None or (self._boot_ns is not None and r.boot_ns <= self._boot_ns):
            return
        dt = 0.0 if self._boot_ns is None else (r.boot_ns - self._boot_ns) / 1e9
        self._source = r.source
        begin = self._boot_ns is None or dt > _LOST_S
        self._rest.see(r, 0.0 if begin else dt)
        if begin:
            self._begin(*(tilt_from_force(r.force_b_mss) or (0.0, 0.0)))
            self._force_n = marg.matrix(self._q) @ r.force_b_mss
            self._north_rad = None
        else:
            before = self._own_yaw(self._q)
            self._predict(r, dt)
            self._correct_tilt(dt)
            self._yaw_rad += wrap_pi(self._own_yaw(self._q) - before)
        self._boot_ns = r.boot_ns
        self.rate_b_rads = vec3(r.rate_b_rads - self._rest.bias_b_rads, "rate")

    def field(self, field_b_mg: Array, age_s: float, sigma_rad: float) -> None:
        """Take a calibrated magnetometer value, (3,) mG, measured age_s before the last reading: it moves the yaw only.

        sigma_rad : of the heading it gives. At first the yaw is the mean of what comes; then a disturbance is clipped.
        Nothing happens where down and field lie on one line (a magnetic pole).
        """
        if self._boot_ns is None:
            return
        now_b = marg.matrix(marg.turned(-self.rate_b_rads * (age_s - _LAG_S))) @ field_b_mg
        p = marg.pair(-(marg.matrix(self._q).T @ _DOWN_N), now_b)
        if p is None:
            return
        if self._north_rad is None or self._boot_ns - self._field_ns > _YAW_HOLD_NS:
            self._north_rad = wrap_pi(self._own_yaw(self._q) - self._own_yaw(marg.closed_form(p)))
            self._field_s = 0.0
        else:
            dt = (self._boot_ns - self._field_ns) / 1e9
            self._field_s += dt
            share = 1.0 - math.exp(-min(dt, 1.0) / _YAW_TAU_S)
            if self._field_s < _YAW_TAU_S:
                share = max(share, dt / self._field_s if dt > 0.0 else 0.0)
            q = marg.multiply(marg.turned(-self._north_rad * _DOWN_N), self._q)
            J, E = marg.jacobian(q, p), marg.error(q, p, marg.direct_reference(p))
            turn = float(self._turn(q, J, E, share)[2])
            if self._field_s > _YAW_TRIAL_S:
                limit = share * _YAW_CLIP * sigma_rad
                turn = max(-limit, min(limit, turn))
            self._north_rad = wrap_pi(self._north_rad - turn)
        self._field_ns = self._boot_ns

    def at(self, boot_ns: int) -> Carried | None:
        """Attitude at a boot time within 0.2 s of the last reading."""
        q = self._near(boot_ns)
        if q is None:
            return None
        roll, pitch, yaw = euler_from_quaternion(*q.tolist()) or (0.0, 0.0, 0.0)
        yaw = self._yaw_rad + wrap_pi(yaw - self._own_yaw(self._q))
        return Carried(roll, pitch, yaw, self.rate_b_rads, self._epoch, self._doubt.sigma_rad)

    def magnetic_yaw(self, boot_ns: int) -> float | None:
        """Yaw from magnetic north, rad in [0, 2 pi), at a boot time within 0.2 s of the last reading.

        None before the first field, after a silence, and 30 s after the last field.
        """
        q = self._near(boot_ns)
        if q is None or self._north_rad is None or boot_ns - self._field_ns > _YAW_HOLD_NS:
            return None
        return wrap_tau(self._own_yaw(q) - self._north_rad)

    # ------------------------------------------------------------ inside

    @staticmethod
    def _own_yaw(q: Quaternion) -> float:
        w, x, y, z = q.tolist()
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    def _near(self, boot_ns: int) -> Quaternion | None:
        """The attitude carried from the last rates' own time to boot_ns."""
        self._take_seed()
        if self._boot_ns is None or abs(boot_ns - self._boot_ns) > _FRESH_NS:
            return None
        age_s = (boot_ns - self._boot_ns) / 1e9 + _LAG_S
        return marg.multiply(self._q, marg.turned(self.rate_b_rads * age_s))

    def _take_seed(self) -> None:
        a, self._seed = self._seed, None
        if a is None or a.boot_ns == self._boot_ns:
            return
        # The attitude is of its own time, ours of the gyro's, a little earlier.
        self._q = marg.from_matrix(body_from_earth(a.roll_rad, a.pitch_rad, self._yaw_rad).T)
        self._q = marg.multiply(self._q, marg.turned(-_LAG_S * a.rate_b_rads))
        self._force_n = -_G * _DOWN_N
        self._boot_ns, self.rate_b_rads, self._north_rad = a.boot_ns, a.rate_b_rads, None

    def _begin(self, roll_rad: float, pitch_rad: float) -> None:
        self._q = marg.from_matrix(body_from_earth(roll_rad, pitch_rad, self._yaw_rad).T)
        self._epoch += 2
        self._doubt = TiltDoubt(_TILT_TAU_S, 0.0)

    def _predict(self, r: InertialReading, dt: float) -> None:
        """Turn by the mean of two rates; where their axis moves, by the second term of its coning series as well."""
        last, now = self.rate_b_rads, r.rate_b_rads - self._rest.bias_b_rads
        self._q = marg.multiply(self._q, marg.turned(0.5 * dt * (last + now) + dt * dt / 12.0 * marg.cross(last, now)))
        seen_n = marg.matrix(self._q) @ r.force_b_mss
        self._force_n = self._force_n + (1.0 - math.exp(-dt / _FORCE_TAU_S)) * (seen_n - self._force_n)

    def _correct_tilt(self, dt: float) -> None:
        """One step on the accelerometer's rows, weaker while it does not measure 1 g."""
        strength = math.hypot(*self._force_n)
        if strength < 1e-3:
            return
        down_b = -(marg.matrix(self._q).T @ self._force_n) / strength
        trust = math.exp(-(((strength / _G - 1.0) / _WIDTH) ** 2))
        E = _DOWN_N + self._force_n / strength
        self._doubt.step((float(E[0]), float(E[1])), trust, self.rate_b_rads, dt)
        turn = self._turn(self._q, marg.row_jacobian(self._q, down_b), E, trust * (1.0 - math.exp(-dt / _TILT_TAU_S)))
        turn[2] = 0.0
        back = marg.turned(turn)
        self._q = marg.unit(marg.multiply(back, self._q))
        self._force_n = marg.matrix(back) @ self._force_n

    def _turn(self, q: Quaternion, J: Array, E: Array, share: float) -> Vec3:
        """Rotation vector (3,) rad, earth axes: a share of the solver's step from q.

        Four times mu is the rate at which gradient descent turns a single row (fact 3), hence the quarter.
        """
        if self._newton:
            return share * marg.turn_between(q, marg.gauss_newton(q, J, E))
        return marg.turn_between(q, marg.descend(q, J, E, 0.25 * share))
