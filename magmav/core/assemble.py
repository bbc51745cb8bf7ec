"""Readings to Samples: one fresh magnetometer value with the tilt and turning that belong to it.

Per vehicle. Duplicates, reordering, gaps, reboots and clock jumps are handled here and counted, so that an estimator
never meets them. Two clocks are never mixed: everything here is the vehicle's boot time.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from magmav.core.motion import Motion
from magmav.core.motion_run import MotionRun
from magmav.core.types import AttitudeReading, InertialReading, MagReading, Sample, Shaping, Vec3

_BACK_NS = 2_000_000_000  # further back than any reordering: a reboot
_AHEAD_NS = 10_000_000_000  # further ahead than any pause worth bridging: a clock jump
_NEAR_NS = 5_000_000_000  # a second message this close after the first confirms a new timeline
_GAP_S = 0.5
_SOURCE_SILENT_NS = 2_000_000_000
_REFRESH_S = 0.1  # ArduPilot's refresh; a slower stream only shows it more rarely
_AVERAGED_S = 0.07
# PX4's logs stamp a value with the time it was measured, so it has no age; on a link it sends the newest there is.
_STAMPED = frozenset({
    "sensor_mag", "vehicle_magnetometer", "vehicle_magnetometer less bias", "sensor_combined",
    "SCALED_IMU raw", "SCALED_IMU2 raw", "SCALED_IMU3 raw",
})  # fmt: skip
# ArduPilot writes its log right after the compass was read: a value has not waited.
_AT_ONCE = frozenset({"MAG", "MAG2", "MAG3"})
_PREFERENCE = ("RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "HIGHRES_IMU")


class Tick(Enum):
    """What a boot time says about the vehicle's clock."""

    GOES_ON = "goes on"
    REBOOT = "reboot"
    JUMP = "clock jump"
    DOUBT = "doubt"  # too far off to be used until a second message agrees


_GOES_ON = Tick.GOES_ON  # asked of every reading, and an enumeration is slow to look into


class BootClock:
    """Follows one vehicle's boot time. A jump is believed when a second, later message confirms it."""

    def __init__(self) -> None:
        self.latest_ns: int | None = None
        self._doubt_ns: int | None = None

    def hear(self, boot_ns: int) -> Tick:
        """Take one boot time and say how it continues the story."""
        if self.latest_ns is None:
            self.latest_ns = boot_ns
            return _GOES_ON
        ahead = boot_ns - self.latest_ns
        if 0 < ahead <= _AHEAD_NS:
            self.latest_ns, self._doubt_ns = boot_ns, None
            return _GOES_ON
        if -_BACK_NS <= ahead <= 0:
            return _GOES_ON
        if self._doubt_ns is not None and 0 < boot_ns - self._doubt_ns <= _NEAR_NS:
            self.latest_ns, self._doubt_ns = boot_ns, None
            return Tick.REBOOT if ahead < 0 else Tick.JUMP
        self._doubt_ns = boot_ns
        return Tick.DOUBT

    def hears(self, first_ns: int, last_ns: int) -> bool:
        """Boot times that rise by steps well under a pause, first to last, where they go on; False: hear them apart."""
        if self.latest_ns is not None:
            ahead = first_ns - self.latest_ns
            if not -_BACK_NS <= ahead <= _AHEAD_NS:
                return False
            if last_ns <= self.latest_ns:
                return True
        self.latest_ns, self._doubt_ns = last_ns, None
        return True


@dataclass(slots=True)
class _Compass:
    """What is remembered of one compass between messages."""

    source: str
    heard_ns: int  # boot time of the last message, fresh or not
    sent_b_mg: list[float] | None = None
    fresh_ns: int = 0
    yaw_rad: float = 0.0
    epoch: int = -1
    turned_rad: float = 0.0  # since the last fresh value
    restart: bool = True
    refresh_s: float = 0.0  # between fresh values, and between messages
    period_s: float = 0.0

    def pace(self, boot_ns: int, fresh: bool) -> None:
        """Learn how often messages come and how often they bring something new."""
        if fresh:
            self.refresh_s = _follow(self.refresh_s, (boot_ns - self.fresh_ns) / 1e9)
        else:
            self.period_s = _follow(self.period_s, (boot_ns - self.heard_ns) / 1e9)

    @property
    def age_s(self) -> float:
        """Age of a fresh value when it comes.

        ArduPilot sends the mean of the last 100 ms (autopilots.md 1.1), then the value waits for the next message.
        A compass that brings news faster than that is not averaged so, and nothing is known of its delay.
        """
        if self.refresh_s < _AVERAGED_S or self.source in _STAMPED:
            return 0.0
        if self.source in _AT_ONCE:
            return 0.5 * _REFRESH_S
        return 0.5 * (_REFRESH_S + min(self.period_s, _REFRESH_S))


def _rank(source: str) -> int:
    """Place in the order of preference; all others, as logs have them, come last and are equal."""
    return _PREFERENCE.index(source) if source in _PREFERENCE else len(_PREFERENCE)


def _follow(mean_s: float, now_s: float) -> float:
    """A slow mean that a single silence does not disturb."""
    if mean_s == 0.0:
        return now_s
    return mean_s + 0.1 * (now_s - mean_s) if now_s < 4.0 * mean_s else mean_s


class Assembler:
    """One vehicle's readings to Samples. ``counts`` says what was dropped and why.

    own : which of core.motion's OWN_TILTS gives the tilt where no attitude comes.
    """

    def __init__(self, system: int, own: str = "complementary") -> None:
        self.system = system
        self._own = own
        self.counts: Counter[str] = Counter()
        self.clock = BootClock()
        self.motion = Motion(own)
        self.reboots = 0
        self._compasses: dict[int, _Compass] = {}

    def attitude(self, reading: AttitudeReading) -> None:
        """Take an attitude."""
        if self._in_time(reading.boot_ns) and not self.motion.attitude(reading):
            self.counts[f"{reading.source}: duplicate or late"] += 1

    def inertial(self, reading: InertialReading) -> None:
        """Take accelerometer and gyro: the tilt of a vehicle that sends no attitude."""
        if self._in_time(reading.boot_ns):
            self.motion.inertial(reading)

    def run(self, run: MotionRun) -> bool:
        """Take many attitudes at once; False, and nothing taken, where they have to be heard one by one."""
        if not self.motion.follows(run) or not self.clock.hears(run.first_ns, max(run.last_ns, *run.inertial_ns)):
            return False
        self.motion.run(run)
        return True

    def frozen_s(self, compass: int) -> float:
        """Seconds of turning (over 30 degrees) during which this compass never changed its value, else 0."""
        known = self._compasses.get(compass)
        if known is None or known.turned_rad < math.radians(30.0):
            return 0.0
        return (known.heard_ns - known.fresh_ns) / 1e9

    def restart(self, compass: int) -> None:
        """The next sample of this compass follows a break: nothing is bridged."""
        if compass in self._compasses:
            self._compasses[compass].restart = True

    def mag(
        self,
        reading: MagReading,
        undo: Callable[[Vec3], Vec3],
        shaping: Shaping,
        learn: bool,
        axes: int = 3,
        model_mg: tuple[float, float] | None = None,
        throttle: float | None = None,
    ) -> Sample | None:
        """A Sample when this is a fresh value whose tilt is known.

        ``undo`` takes the value as sent back to the sensor's own field; it is called only for fresh values.
        """
        if not self._in_time(reading.boot_ns):
            return None
        known = self._source(reading)
        if known is None:
            return None
        boot_ns, sent_b_mg = reading.boot_ns, reading.field_b_mg.tolist()
        known.turned_rad += self.motion.rate_rads * max(boot_ns - known.heard_ns, 0) / 1e9
        if boot_ns > known.heard_ns:
            known.pace(boot_ns, fresh=False)
        known.heard_ns = boot_ns
        if known.sent_b_mg is not None:
            if sent_b_mg == known.sent_b_mg:
                self.counts["mag: repeated value"] += 1
                return None
            known.pace(boot_ns, fresh=True)
        age_s = known.age_s
        state = self.motion.at(boot_ns - round(age_s * 1e9))
        now = self.motion.yaw_at(boot_ns)
        if state is None or now is None:
            self.counts["mag: no tilt yet"] += 1
            return None
        dt_s, (yaw_now_rad, epoch_now) = (boot_ns - known.fresh_ns) / 1e9, now
        gap = known.restart or (dt_s > _GAP_S and not state.bridged) or known.epoch != state.epoch
        if known.sent_b_mg is not None and dt_s > _GAP_S:
            self.counts["mag: gap"] += 1
        sample = Sample(
            system=self.system,
            compass=reading.compass,
            boot_ns=boot_ns,
            dt_s=0.0 if known.restart else dt_s,
            mag_b_mg=undo(reading.field_b_mg),
            shaping=shaping,
            rate_b_rads=state.rate_b_rads,
            roll_rad=state.roll_rad,
            pitch_rad=state.pitch_rad,
            yaw_step_rad=0.0 if gap else state.yaw_rad - known.yaw_rad,
            lead_rad=yaw_now_rad - state.yaw_rad if epoch_now == state.epoch else 0.0,
            age_s=age_s,
            gap=gap,
            tilt_from=state.source,
            own_tilt_rad=state.own_tilt_rad,
            tilt_every_s=state.every_s,
            learn=learn,
            axes=axes,
            model_mg=model_mg,
            throttle=throttle,
            body_from_own=state.body_from_own,
        )
        known.sent_b_mg, known.fresh_ns, known.turned_rad = sent_b_mg, boot_ns, 0.0
        known.yaw_rad, known.epoch, known.restart = state.yaw_rad, state.epoch, False
        return sample

    def rebooted(self, boot_ns: int) -> None:
        """The clock shows boot_ns since a reboot, as others know. Nothing new where readings said so before."""
        latest = self.clock.latest_ns
        if latest is not None and latest - boot_ns > _BACK_NS:
            self.clock = BootClock()
            self.reboots += 1
            self._begin_anew()

    def _begin_anew(self) -> None:
        self.motion = Motion(self._own)
        self._compasses.clear()

    def _in_time(self, boot_ns: int) -> bool:
        tick = self.clock.hear(boot_ns)
        if tick is _GOES_ON:
            return True
        self.counts[f"clock: {tick.value}"] += 1
        if tick is Tick.DOUBT:
            return False
        self.reboots += tick is Tick.REBOOT
        self._begin_anew()
        return True

    def _source(self, reading: MagReading) -> _Compass | None:
        """The compass's memory, or None when this message repeats what another one already tells, or comes late."""
        known = self._compasses.get(reading.compass)
        if known is None:
            known = self._compasses[reading.compass] = _Compass(reading.source, reading.boot_ns)
            return known
        if reading.source != known.source:
            better = _rank(reading.source) < _rank(known.source)
            if not better and reading.boot_ns - known.heard_ns < _SOURCE_SILENT_NS:
                self.counts["mag: same compass in another message"] += 1
                return None
            known.source = reading.source
        elif reading.boot_ns <= known.heard_ns and known.sent_b_mg is not None:
            self.counts["mag: duplicate" if reading.boot_ns == known.heard_ns else "mag: late"] += 1
            return None
        return known
