"""Which motion meets which errors. The first 18 are those of the reference study, the rest are harder or stranger."""

from __future__ import annotations

from dataclasses import dataclass, replace

from estimator_bench import motions as m
from estimator_bench.flights import Start
from estimator_bench.motions import Motion


@dataclass(frozen=True, slots=True)
class Link:
    """What is sent, and what happens to it on the way."""

    imu_hz: float = 25.0  # RAW_IMU: compass, accelerometer, gyro
    attitude_hz: float = 25.0  # 0: none is sent
    gps: bool = True  # position, velocity, height, time
    loss: float = 0.0
    outliers: float = 0.0  # share of compass values that are far off
    stamp_jitter_s: float = 0.0  # sigma of the vehicle's own time stamps
    arrival_jitter_s: float = 0.004


@dataclass(frozen=True, slots=True)
class Compass:
    """The sensor and what is wrong with it. Fields mG."""

    bias_mg: float = 70.0  # sigma per axis
    bias_length_mg: float | None = None  # this long instead, in any direction
    noise_mg: float = 4.0
    late_s: float = 0.015
    averaged_s: float = 0.0  # ArduPilot's way: a mean over this long, renewed as often
    step_mg: float = 0.0  # at 90 s, in any direction
    drift_mgps: float = 0.0  # in any direction
    throttle_mg: float = 0.0  # at full throttle, in any direction
    soft: float = 0.0  # sigma of the soft iron's diagonal; that of the others is this over sqrt 2


@dataclass(frozen=True, slots=True)
class Scenario:
    """One row of the table. ground_mg: field of what lies under the take-off, fading with height over ground_scale_m.

    weak : the motion can hardly teach (hover, cruise): timid verdicts are no fault there.
    """

    name: str
    motion: Motion
    kind: int = m.QUAD
    start: Start = "aloft"
    compass: Compass = Compass()
    link: Link = Link()
    ground_mg: float = 0.0
    ground_scale_m: float = 1.5
    weak: bool = False
    reference: bool = True
    jsbsim: str | None = None  # name of a flight of jsbsim_flights instead of a motion

    @property
    def tells_enough(self) -> bool:
        """Full telemetry, and a motion that teaches: a verdict may be asked for within a minute."""
        return not self.weak and self.link.gps and self.link.attitude_hz >= 10.0


_ROUGH = Link(10.0, 10.0, True, 0.20, 0.01, 0.003, 0.020)
_FINE = Link(50.0, 50.0)
STEP_AT_S = 90.0

REFERENCE = (
    Scenario("hover_yaw", m.hover_yaw),
    Scenario("figure8", m.figure8),
    Scenario("survey", m.survey),
    Scenario("loiter_fw", m.loiter_fw, m.PLANE),
    Scenario("aggressive", m.aggressive),
    Scenario("cruise", m.cruise, m.PLANE, weak=True),
    Scenario("hover_only", m.hover_only, weak=True),
    Scenario("step", m.figure8, compass=Compass(step_mg=70.0)),
    Scenario("drift", m.figure8, compass=Compass(drift_mgps=0.3)),
    Scenario("motor", m.hover_yaw, compass=Compass(throttle_mg=80.0)),
    Scenario("takeoff", m.figure8, start="ground", ground_mg=120.0),
    Scenario("soft5", m.aggressive, compass=Compass(soft=0.05)),
    Scenario("soft5_fig8", m.figure8, compass=Compass(soft=0.05)),
    Scenario("rough10", m.survey, link=_ROUGH),
    Scenario("rough10_f8", m.figure8, link=_ROUGH),
    Scenario("imu_only", m.aggressive, link=Link(attitude_hz=0.0, gps=False)),
    Scenario("imu_gps", m.survey, link=Link(attitude_hz=0.0)),
    Scenario("rm3100_50", m.figure8, compass=Compass(noise_mg=1.0), link=_FINE),
)

_more = tuple(
    replace(s, reference=False)
    for s in (
        Scenario("bias250", m.figure8, compass=Compass(bias_mg=250.0)),
        Scenario("bias600", m.figure8, compass=Compass(bias_length_mg=600.0)),
        Scenario("late60", m.figure8, compass=Compass(late_s=0.060)),
        Scenario("slow2", m.survey, link=Link(2.0, 2.0)),
        Scenario("averaged10", m.survey, compass=Compass(averaged_s=0.1), link=_FINE),
        Scenario("steel_pad", m.survey, start="pad", ground_mg=300.0, ground_scale_m=2.0),
        Scenario("tailsitter", m.tailsitter, m.TAILSITTER),
        Scenario("aerobatics", m.aerobatics, m.PLANE),
        Scenario("boat", m.boat, m.BOAT),
        Scenario("rover", m.rover, m.ROVER),
        Scenario("jsb_hover_yaw", m.hover_yaw, jsbsim="hover_yaw", start="ground"),
        Scenario("jsb_figure8", m.figure8, jsbsim="figure8", start="ground"),
        Scenario("jsb_survey", m.survey, jsbsim="survey", start="ground"),
        Scenario("jsb_loiter", m.loiter_fw, m.PLANE, jsbsim="loiter", start="ground"),
    )
)

SCENARIOS: dict[str, Scenario] = {s.name: s for s in (*REFERENCE, *_more)}


def chosen(text: str) -> list[Scenario]:
    """Scenarios by name, in the order asked for; ``all``, ``reference`` and ``new`` stand for groups.

    ValueError naming what does not exist.
    """
    out: dict[str, Scenario] = {}
    for name in text.split(","):
        groups = {
            "all": list(SCENARIOS.values()),
            "reference": [s for s in SCENARIOS.values() if s.reference],
            "new": [s for s in SCENARIOS.values() if not s.reference],
        }
        if name not in groups and name not in SCENARIOS:
            raise ValueError(f"scenario {name!r}: choose all, reference, new or some of {', '.join(SCENARIOS)}")
        out.update({s.name: s for s in groups.get(name, [SCENARIOS.get(name, REFERENCE[0])])})
    return list(out.values())
