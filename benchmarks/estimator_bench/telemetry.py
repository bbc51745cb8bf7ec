"""What an autopilot would send of a true flight: readings with the errors of sensors, attitude, clocks and link.

The autopilot is an ArduPilot whose stored offsets are zero, so that what the sensor carries is what must be learnt. Its
tilt wanders slowly and is misled by acceleration; its yaw follows its own uncalibrated compass with a time constant of
8 s, as AHRS do: whoever takes that yaw for a measurement is led astray.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator_bench.flights import STEP_S, Truth, followed, recursive, rotations, true_flight
from estimator_bench.motions import GRAVITY_MSS, Array
from estimator_bench.scenarios import STEP_AT_S, Scenario
from magmav.core.types import (
    AttitudeReading,
    CurrentReading,
    InertialReading,
    Landed,
    LandedReading,
    MagReading,
    MotionReading,
    ParamReading,
    PositionReading,
    Reading,
    ThrottleReading,
    TimeReading,
    VehicleReading,
    vec3,
)
from magmav.geomag import world_magnetic_model

BOOT_S = 20.0  # boot time at the beginning of a flight
UNIX_AT_BOOT_NS = 1_780_000_000 * 10**9  # the end of May 2026
SITES = {
    "Quito": (-0.18, -78.47, 2850.0),
    "Delhi": (28.61, 77.21, 216.0),
    "Boulder": (40.01, -105.27, 1655.0),
    "Zurich": (47.38, 8.54, 408.0),
    "Canberra": (-35.28, 149.13, 578.0),
    "Tromso": (69.65, 18.96, 10.0),
}
MODEL_ERROR_MG = 3.0
TILT_SIGMA_RAD, TILT_TAU_S = math.radians(0.45), 15.0
MISLED_RAD_PER_G, MISLED_TAU_S = math.radians(1.0), 2.0
GYRO_BIAS_RADS, GYRO_NOISE_RADS = math.radians(0.4), math.radians(0.15)
FORCE_NOISE_MSS = 0.15
_YAW_TAU_S = 8.0
_OUTLIER_MG = (150.0, 500.0)
_LATENCY_S = 0.02

Index = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """What was drawn for this flight: field of the place and of its model, north-east-down mG; the sensor's iron.

    The sensor sees (I + soft) @ field_b + iron_b(t) + throttle_b * throttle.  iron_b_mg (N, 3) over the truth's times.
    """

    site: str
    place: tuple[float, float, float]
    field_n_mg: Array
    model_n_mg: Array
    iron_b_mg: Array
    soft: Array
    throttle_b_mg: Array
    gyro_bias_b_rads: Array
    noise_mg: float


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """One flight as the companion meets it, and the truth behind it.

    readings : (t_ns, reading) in the order of arrival.  heard : indices into the truth of the compass values that
    arrived and were no outliers, by the moment they were measured.  reported_C_bn (N, 3, 3): the attitude as the
    autopilot believes it.
    """

    scenario: Scenario
    seed: int
    truth: Truth
    errors: Errors
    readings: list[tuple[int, Reading]]
    heard: Index
    reported_C_bn: Array
    mean_throttle: float

    def iron_at(self, t_s: float) -> Array:
        """Hard iron at a time of flight with the motors at their mean, (3,) mG: what an offset should take away."""
        i = min(max(round(t_s / STEP_S), 0), len(self.errors.iron_b_mg) - 1)
        return np.asarray(self.errors.iron_b_mg[i] + self.mean_throttle * self.errors.throttle_b_mg)


def fly(scenario: Scenario, seed: int) -> Flight:
    """The flight of this scenario and seed."""
    if scenario.jsbsim is not None:
        from estimator_bench.jsbsim_flights import jsbsim_flight

        truth = jsbsim_flight(scenario.jsbsim, seed)
    else:
        truth = true_flight(scenario.motion, scenario.kind, seed, scenario.start)
    return sent(scenario, seed, truth)


def sent(scenario: Scenario, seed: int, truth: Truth) -> Flight:
    """What is sent of a true flight."""
    errors = _drawn(scenario, seed, truth)
    r = np.random.default_rng([seed, 103])
    sensor = _sensor(scenario, truth, errors)
    C_hat = _believed(truth, errors, sensor, r)
    link = scenario.link
    out: list[tuple[float, int, Reading]] = []  # arrival s, order, reading
    heard: list[int] = []

    def put(t_s: float, reading: Reading, lossy: bool = True) -> bool:
        lost = lossy and r.random() < link.loss
        if not lost:
            delay = _LATENCY_S + abs(r.normal(0.0, link.arrival_jitter_s))
            out.append((t_s + delay, len(out), reading))
        return not lost

    for t_s, reading in _slow(scenario, truth, errors, r):
        put(t_s, reading, lossy=not isinstance(reading, ParamReading))
    for i in _every(truth, link.imu_hz, 0.0):
        t_s = float(truth.t_s[i])
        boot_ns = _stamp(t_s, link.stamp_jitter_s, r)
        measured, value = _measure(scenario, errors, sensor, i, r)
        wild = r.random() < link.outliers
        if wild:
            way = r.normal(size=3)
            value = value + way / np.linalg.norm(way) * r.uniform(*_OUTLIER_MG)
        force = truth.force_b_mss[i] + r.normal(0.0, FORCE_NOISE_MSS, 3)
        rate = truth.rate_b_rads[i] + errors.gyro_bias_b_rads + r.normal(0.0, GYRO_NOISE_RADS, 3)
        whole = np.round(value)  # int16 on the wire
        both = [
            InertialReading(1, "RAW_IMU", boot_ns, vec3(force, "force"), vec3(rate, "rate")),
            MagReading(1, 1, "RAW_IMU", boot_ns, vec3(whole, "field"), 97539),
        ]
        if put(t_s, both[0]):
            out.append((*out[-1][:1], len(out), both[1]))  # one message on the wire: both or none
            if not wild:
                heard.append(measured)
    for i in _every(truth, link.attitude_hz, 0.013):
        t_s = float(truth.t_s[i])
        roll, pitch, yaw = angles(C_hat[i])
        rate = truth.rate_b_rads[i] + errors.gyro_bias_b_rads + r.normal(0.0, GYRO_NOISE_RADS, 3)
        stamp = _stamp(t_s, link.stamp_jitter_s, r)
        put(t_s, AttitudeReading(1, "ATTITUDE", stamp, roll, pitch, yaw, vec3(rate, "rate")))
    out.sort(key=lambda one: one[:2])
    up = truth.height_m > 5.0 if truth.flies else np.ones(len(truth.t_s), dtype=bool)
    return Flight(
        scenario,
        seed,
        truth,
        errors,
        [(round((BOOT_S + arrival) * 1e9), reading) for arrival, _, reading in out],
        np.array(heard, dtype=np.intp),
        C_hat,
        float(truth.throttle[up].mean()),
    )


# ---------------------------------------------------------------- the errors


def _way(r: np.random.Generator) -> Array:
    v = r.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def _drawn(scenario: Scenario, seed: int, truth: Truth) -> Errors:
    r = np.random.default_rng([seed, 102])
    spec = scenario.compass
    site = list(SITES)[seed % len(SITES)]
    place = SITES[site]
    model = world_magnetic_model(*place, UNIX_AT_BOOT_NS)
    if model is None:
        raise ValueError(f"site {site}: outside the years of the world magnetic model")
    field = np.array(model) + r.normal(0.0, MODEL_ERROR_MG, 3)
    bias = r.normal(0.0, spec.bias_mg, 3)
    if spec.bias_length_mg is not None:
        bias = spec.bias_length_mg * _way(r)
    step, drift, throttle = spec.step_mg * _way(r), spec.drift_mgps * _way(r), spec.throttle_mg * _way(r)
    iron = bias + (truth.t_s >= STEP_AT_S)[:, None] * step + truth.t_s[:, None] * drift
    diagonal, cross = r.normal(0.0, spec.soft, 3), r.normal(0.0, spec.soft / math.sqrt(2.0), 3)
    soft = np.diag(diagonal)
    for (i, j), value in zip(((0, 1), (0, 2), (1, 2)), cross, strict=True):
        soft[i, j] = soft[j, i] = value
    gyro = r.normal(0.0, GYRO_BIAS_RADS, 3)
    noise = spec.noise_mg * r.uniform(0.75, 1.25)
    return Errors(site, place, field, np.array(model), iron, soft, throttle, gyro, noise)


def _sensor(scenario: Scenario, truth: Truth, e: Errors) -> Array:
    """What the compass feels, without noise, (N, 3) mG; near steel the ground adds its own field."""
    r = np.random.default_rng(_key(e))
    fade = (1.0 + np.maximum(truth.height_m, 0.0) / scenario.ground_scale_m) ** -3.0
    field_n = e.field_n_mg + scenario.ground_mg * fade[:, None] * _way(r)
    field_b = np.einsum("nij,nj->ni", truth.C_bn, field_n)
    return np.asarray(field_b @ (np.eye(3) + e.soft).T + e.iron_b_mg + truth.throttle[:, None] * e.throttle_b_mg)


def _measure(scenario: Scenario, e: Errors, sensor: Array, i: int, r: np.random.Generator) -> tuple[int, Array]:
    """The instant a value sent at i belongs to, and the value."""
    spec = scenario.compass
    late = round(spec.late_s / STEP_S)
    if not spec.averaged_s:
        at = max(i - late, 0)
        return at, sensor[at] + r.normal(0.0, e.noise_mg, 3)
    span = round(spec.averaged_s / STEP_S)
    end = max((i // span) * span - late, 1)  # renewed at the end of every span, then held until the next
    begin = max(end - span, 0)
    held = np.random.default_rng([i // span, *_key(e)]).normal(0.0, e.noise_mg, 3)  # the same until renewed
    return (begin + end) // 2, sensor[begin:end].mean(axis=0) + held


def _key(e: Errors) -> tuple[int, ...]:
    """Seeds of this flight, for what must not depend on the order of things."""
    return tuple(np.frombuffer(e.field_n_mg.tobytes(), dtype=np.uint32).tolist())


def _tilt_error(truth: Truth, r: np.random.Generator) -> Array:
    """Rotation vectors (N, 3) in n axes, level: a slow wander, and down mistaken where the vehicle accelerates."""
    n = len(truth.t_s)
    keep = math.exp(-STEP_S / TILT_TAU_S)
    kicks = r.normal(0.0, TILT_SIGMA_RAD * math.sqrt(1.0 - keep * keep), (n, 2))
    out = np.zeros((n, 3))
    out[:, :2] = recursive(keep, kicks, r.normal(0.0, TILT_SIGMA_RAD, 2))
    misled = r.normal(0.0, MISLED_RAD_PER_G) / GRAVITY_MSS
    felt = followed(truth.accel_n_mss[:, :2], MISLED_TAU_S)
    out[:, 0] -= misled * felt[:, 1]
    out[:, 1] += misled * felt[:, 0]
    return out


def rotation_vectors(turns_rad: Array) -> Array:
    """exp(-[v]x) (N, 3, 3): coordinates of a fixed vector in axes turned by v (N, 3), Rodrigues."""
    angle = np.linalg.norm(turns_rad, axis=1)
    safe = np.where(angle < 1e-12, 1.0, angle)
    first = np.where(angle < 1e-12, 1.0, np.sin(safe) / safe)
    second = np.where(angle < 1e-12, 0.5, (1.0 - np.cos(safe)) / safe**2)
    x, y, z = turns_rad.T
    nil = np.zeros_like(x)
    cross = np.moveaxis(np.array([[nil, -z, y], [z, nil, -x], [-y, x, nil]]), 2, 0)
    return np.asarray(np.eye(3) - first[:, None, None] * cross + second[:, None, None] * (cross @ cross))


def _believed(truth: Truth, e: Errors, sensor: Array, r: np.random.Generator) -> Array:
    """The autopilot's attitude (N, 3, 3): true, with its tilt error, and a yaw that follows the bad compass."""
    tilted = truth.C_bn @ rotation_vectors(_tilt_error(truth, r))
    every = round(0.1 / STEP_S)
    declination = math.atan2(e.model_n_mg[1], e.model_n_mg[0])
    seen = np.einsum("nji,nj->ni", tilted[::every], sensor[::every])
    wrong = -(np.arctan2(seen[:, 1], seen[:, 0]) - declination)
    turning = np.einsum("nji,j->ni", truth.C_bn[::every], e.gyro_bias_b_rads)[:, 2]
    off = float(wrong[0])
    offs = np.empty(len(seen))
    for k in range(len(seen)):
        off += 0.1 * float(turning[k]) + 0.1 / _YAW_TAU_S * math.remainder(float(wrong[k]) - off, math.tau)
        offs[k] = off
    yaw_error = np.interp(truth.t_s, truth.t_s[::every], offs)
    nil = np.zeros_like(yaw_error)
    return np.asarray(tilted @ rotations(nil, nil, yaw_error))


def angles(C_bn: Array) -> tuple[float, float, float]:
    """ZYX roll, pitch, yaw, rad, as ATTITUDE carries them."""
    pitch = math.asin(min(max(-float(C_bn[0, 2]), -1.0), 1.0))
    return math.atan2(C_bn[1, 2], C_bn[2, 2]), pitch, math.atan2(C_bn[0, 1], C_bn[0, 0])


# ---------------------------------------------------------------- the messages


def _every(truth: Truth, hz: float, phase_s: float) -> Index:
    if hz <= 0.0:
        return np.array([], dtype=np.intp)
    times = np.arange(phase_s, float(truth.t_s[-1]) - 1e-9, 1.0 / hz)
    return np.asarray(np.round(times / STEP_S), dtype=np.intp)


def _stamp(t_s: float, jitter_s: float, r: np.random.Generator) -> int:
    wander = min(max(r.normal(0.0, jitter_s), -3.0 * jitter_s), 3.0 * jitter_s) if jitter_s else 0.0
    return round((BOOT_S + t_s + wander) * 1e3) * 1_000_000


def _parameters() -> Iterator[ParamReading]:
    values = {"COMPASS_DEV_ID": 97539.0, "COMPASS_MOTCT": 0.0, "COMPASS_SCALE": 1.0}
    for group, value in (("OFS", 0.0), ("DIA", 1.0), ("ODI", 0.0), ("MOT", 0.0)):
        values |= {f"COMPASS_{group}_{axis}": value for axis in "XYZ"}
    for i, (name, value) in enumerate(values.items()):
        yield ParamReading(1, 1, name, value, i, len(values))


def _slow(scenario: Scenario, truth: Truth, e: Errors, r: np.random.Generator) -> Iterator[tuple[float, Reading]]:
    """Everything that is not IMU or attitude."""
    for parameter in _parameters():
        yield -0.01, parameter
    lat, lon, alt = e.place
    north_m, east_m = np.cumsum(truth.velocity_n_mps[:, :2], axis=0).T * STEP_S
    for i in _every(truth, 1.0, 0.0):
        t_s, boot_ns = float(truth.t_s[i]), _stamp(float(truth.t_s[i]), 0.0, r)
        yield t_s, VehicleReading(1, 1, 3, truth.kind, t_s >= truth.takeoff_s - 5.0, 4)
        if truth.flies:
            up = truth.height_m[i] > 0.2
            yield t_s, LandedReading(1, Landed.IN_AIR if up else Landed.ON_GROUND)
        if scenario.link.gps:
            yield t_s, TimeReading(1, boot_ns, UNIX_AT_BOOT_NS + boot_ns)
    for i in _every(truth, 4.0, 0.05):
        t_s, boot_ns = float(truth.t_s[i]), _stamp(float(truth.t_s[i]), 0.0, r)
        throttle = float(truth.throttle[i])
        yield t_s, ThrottleReading(1, round(throttle, 2))
        yield t_s, CurrentReading(1, "SYS_STATUS", round(1.0 + 25.0 * throttle**1.5 + r.normal(0.0, 0.3), 2))
        if not scenario.link.gps:
            continue
        height = float(truth.height_m[i]) + r.normal(0.0, 0.3)
        here = (lat + float(north_m[i]) / 111_320.0, lon + float(east_m[i]) / 111_320.0 / math.cos(math.radians(lat)))
        yield t_s, PositionReading(1, "GLOBAL_POSITION_INT", boot_ns, *here, alt + height)
        vn, ve = truth.velocity_n_mps[i, :2] + r.normal(0.0, 0.1, 2)
        yield t_s, MotionReading(1, boot_ns, float(vn), float(ve), height)
