"""The Earth's field and what each compass makes of it. Independent of magmav's own field model and
estimators."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from pygeomag import GeoMag

from magmav_sim.airframe import FRAME_S, State
from magmav_sim.faults import Absent, Frozen, Vector, iron_at
from magmav_sim.mounting import rotation_matrix
from magmav_sim.scenario import CompassSpec, Scenario

_MG_PER_NT = 0.01
_BLOCK = 4096
_MODELS = ((2025, "WMM_2025"), (2020, "WMM_2020"), (2015, "WMM_2015v2"), (2010, "WMM_2010"))


def earth_field_ned_mg(lat_deg: float, lon_deg: float, alt_m: float, year: float) -> Vector:
    """The World Magnetic Model of that year, mG, true north-east-down. ValueError outside 2010 to 2030."""
    for first, name in _MODELS:
        if first <= year < first + 5:
            model = GeoMag(coefficients_file=f"wmm/{name}.COF")
            field = model.calculate(glat=lat_deg, glon=lon_deg, alt=alt_m / 1000, time=year)
            return field.x * _MG_PER_NT, field.y * _MG_PER_NT, field.z * _MG_PER_NT
    raise ValueError(f"year: want 2010 to 2030, got {year}")


class World:
    """What every compass reads, frame by frame; the field is that at home (a flight moves it by under 1
    mG)."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        place = scenario.place
        self.field_ned_mg = earth_field_ned_mg(place.lat_deg, place.lon_deg, place.alt_m, scenario.year)
        self._anomaly = scenario.anomaly
        self.sensors = [
            Sensor(i, spec, scenario, np.random.default_rng([seed, 2, i]))
            for i, spec in enumerate(scenario.compasses, start=1)
        ]

    @property
    def declination_rad(self) -> float:
        """Of the Earth's field, without the anomaly; east positive."""
        return math.atan2(self.field_ned_mg[1], self.field_ned_mg[0])

    def field_body_mg(self, state: State) -> Vector:
        """Earth and anomaly at the vehicle, mG, body axes."""
        n, e, d = self.field_ned_mg
        if self._anomaly is not None:
            share = (self._anomaly.scale_m / (self._anomaly.scale_m + max(0.0, state.height_m))) ** 3
            dn, de, dd = self._anomaly.ned_mg
            n, e, d = n + dn * share, e + de * share, d + dd * share
        sr, cr = math.sin(state.roll_rad), math.cos(state.roll_rad)
        sp, cp = math.sin(state.pitch_rad), math.cos(state.pitch_rad)
        sh, ch = math.sin(state.heading_rad), math.cos(state.heading_rad)
        north, east = ch * n + sh * e, ch * e - sh * n
        dip = sp * north + cp * d
        return cp * north - sp * d, cr * east + sr * dip, cr * dip - sr * east

    def sample(self, state: State, ampere: float, t_s: float) -> None:
        """Let every sensor take its 100 Hz sample."""
        field = self.field_body_mg(state)
        for sensor in self.sensors:
            sensor.sample(field, ampere, t_s)


class Sensor:
    """One magnetometer chip: samples at 100 Hz, gives the mean since it was last read, in its own axes."""

    def __init__(self, number: int, spec: CompassSpec, scenario: Scenario, rng: np.random.Generator) -> None:
        self.number = number
        self.spec = spec
        self._faults = [f for f in scenario.faults if getattr(f, "compass", 0) == number]
        self._stuck = [f for f in self._faults if isinstance(f, Frozen)]
        self._gone = [f for f in self._faults if isinstance(f, Absent)]
        self._to_sensor = np.asarray(rotation_matrix(spec.orient, scenario.autopilot.kind)).T
        self._plain = spec.orient == 0
        self._rng = rng
        self._noise: list[list[float]] = []
        self._late: deque[Vector] = deque(maxlen=1 + round(spec.delay_ms / 1000 / FRAME_S))
        self._sum = [0.0, 0.0, 0.0]
        self._count = 0
        self._last: Vector | None = None
        self._t_s = 0.0

    def hard_iron_mg(self, t_s: float) -> Vector:
        """What the iron on board adds at zero current, body axes, faults and drift included."""
        x, y, z = iron_at(self._faults, self.number, t_s)
        h, d = self.spec.hard_iron_mg, self.spec.drift_mg_per_s
        return h[0] + d[0] * t_s + x, h[1] + d[1] * t_s + y, h[2] + d[2] * t_s + z

    def sample(self, field_b_mg: Vector, ampere: float, t_s: float) -> None:
        """Take one sample of this field, mG, body axes."""
        self._t_s = t_s
        m, s = self.spec.motor_mg_per_a, self.spec.soft
        x, y, z = field_b_mg[0] + m[0] * ampere, field_b_mg[1] + m[1] * ampere, field_b_mg[2] + m[2] * ampere
        h = self.hard_iron_mg(t_s)
        self._late.append(
            (
                s[0][0] * x + s[0][1] * y + s[0][2] * z + h[0],
                s[1][0] * x + s[1][1] * y + s[1][2] * z + h[1],
                s[2][0] * x + s[2][1] * y + s[2][2] * z + h[2],
            )
        )
        if not self._noise:
            self._noise = (self._rng.standard_normal((_BLOCK, 3)) * self.spec.noise_mg).tolist()
        noise, value, total = self._noise.pop(), self._late[0], self._sum
        total[0] += value[0] + noise[0]
        total[1] += value[1] + noise[1]
        total[2] += value[2] + noise[2]
        self._count += 1

    def read(self) -> Vector | None:
        """Mean of the samples since the last read, mG, sensor axes; None where there is no sensor."""
        n = max(1, self._count)
        value = (self._sum[0] / n, self._sum[1] / n, self._sum[2] / n)
        self._sum, self._count = [0.0, 0.0, 0.0], 0
        if any(fault.active(self._t_s) for fault in self._gone):
            return None
        if self._last is not None and any(fault.active(self._t_s) for fault in self._stuck):
            return self._last
        if not self._plain:
            x, y, z = (self._to_sensor @ value).tolist()
            value = (x, y, z)
        self._last = value
        return value
