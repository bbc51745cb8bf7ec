"""One vehicle on a link: what it says of itself, and one channel per compass that learns from it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from magmav.boot import Boot
from magmav.channels import idle_channel, limits, new_channel
from magmav.core.assemble import Assembler
from magmav.core.causes import Causes
from magmav.core.channel import Channel, Circumstances, Finding
from magmav.core.correction import without_third
from magmav.core.field import ExpectedField, FieldKeeper
from magmav.core.handover import Handover
from magmav.core.heading import UNKNOWN
from magmav.core.motion_run import MotionRun
from magmav.core.phase import Phase
from magmav.core.published import Publisher, noise_of_heading
from magmav.core.types import (
    ZERO3,
    AttitudeReading,
    AxisState,
    CalibrationReading,
    CurrentReading,
    Estimate,
    FieldModel,
    Heading,
    InertialReading,
    LandedReading,
    MagReading,
    MotionReading,
    ParamReading,
    PositionReading,
    Reading,
    Reason,
    Record,
    Sample,
    State,
    ThrottleReading,
    TimeReading,
    Vec3,
    VehicleReading,
    Verdict,
    vec3,
)
from magmav.mavlink.autopilot.books import Books
from magmav.mavlink.autopilot.stored import Standing, StoredCalibrations
from magmav.own_yaw import steadied
from magmav.settings import Settings

_FROZEN_S = 3.0  # one value this long while the vehicle turns: the sensor is stuck
_SAY_FROZEN_NS = 1_000_000_000


Tap = Callable[[Sample, Circumstances, tuple[int, int]], None]
"""Sees every Sample with its circumstances, and the number of boots and of new beginnings of its compass before it."""


class Vehicle:
    """One vehicle: what it says of itself, and one channel per compass.

    idle : only ``tap`` wants its Samples. Nothing is learnt, and a Record comes only where the circumstances changed.
    """

    def __init__(
        self, system: int, settings: Settings, model: FieldModel, tap: Tap | None = None, idle: bool = False
    ) -> None:
        self.system, self.settings = system, settings
        self._tap, self._idle = tap, idle
        self.autopilot = self._reboots = 0
        self.learning = settings.learn.on
        self.learn_for_s: float | None = None
        self.assembler = Assembler(system, settings.attitude.own)
        self.phase = Phase()
        self.causes = Causes()
        self._books = Books()
        self.former: Boot | None = None
        self.channels: dict[int, Channel] = {}
        self.counts: Counter[str] = Counter()
        self._keeper = FieldKeeper(model)
        self._place: tuple[float, float, float] | None = None
        self._unix_minus_boot_ns: int | None = None
        self._epochs: dict[int, int] = {}
        self._settle_until_ns: dict[int, int] = {}
        self._handovers: dict[int, Handover] = {}
        self._latest: dict[int, Record] = {}
        self._publishers: dict[int, Publisher] = {}
        self._wanted: dict[int, tuple[Vec3, tuple[AxisState, ...], Vec3 | None, Vec3]] = {}
        self._around: dict[int, tuple[tuple[ExpectedField | None, Standing, bool, bool], Circumstances]] = {}
        self.unjudged: tuple[Sample, Circumstances] | None = None  # idle: of the last magnetometer reading, where fresh
        self._said: dict[int, tuple[Circumstances, str]] = {}
        self._first_ns: int | None = None
        self._throttle: float | None = None
        if not math.isnan(settings.place.lat_deg):
            self._place = (settings.place.lat_deg, settings.place.lon_deg, settings.place.alt_m)

    def apply(self, settings: Settings) -> None:
        """Take changed settings."""
        self.settings = settings
        self.learning = settings.learn.on
        for channel in self.channels.values():
            channel.limits, channel.steady_s = limits(settings), settings.gate.steady_s

    def rebooted(self, boot_ns: int) -> None:
        """Its clock shows boot_ns since a reboot, as messages tell that give no reading."""
        self.assembler.rebooted(boot_ns)
        if self.assembler.reboots != self._reboots:
            self._after_reboot()

    def step(self, r: Reading, t_ns: int, unix_ns: int) -> Record | None:
        """Hand one reading to whom it concerns."""
        match r:
            case MagReading():
                return self._mag(r, t_ns, unix_ns)
            case AttitudeReading():
                self.assembler.attitude(r)
                self.phase.tilt(r.roll_rad, r.pitch_rad, r.boot_ns)
            case InertialReading():
                self.assembler.inertial(r)
            case PositionReading():
                self._place = (r.lat_deg, r.lon_deg, r.alt_m)
                self.phase.position(r)
            case MotionReading():
                self.phase.moving(r)
            case VehicleReading():
                self._by_the_rules_of(r.autopilot)
                self.calibrations.armed(r.armed)
                self.phase.vehicle(r, self._now_ns())
            case LandedReading():
                self.phase.landed(r)
            case ParamReading() | CalibrationReading():
                self._stored(r)
            case ThrottleReading():
                self._throttle = r.share
                self.calibrations.throttle(r.share)
                self.causes.throttle(r.share)
            case CurrentReading():
                self.calibrations.current(r.ampere)
                self.causes.current(r.ampere)
            case TimeReading():
                self._unix_minus_boot_ns = r.unix_ns - r.boot_ns
        if self.assembler.reboots != self._reboots:
            self._after_reboot()
        return None

    def run(self, run: MotionRun) -> bool:
        """Take many attitudes at once; False, and nothing taken, where they have to be handed on one by one."""
        if not self.assembler.run(run):
            return False
        roll, pitch, _ = run.attitudes.rows[run.end - 1, :3].tolist()
        self.phase.tilt(roll, pitch, run.last_ns)  # all are upright
        return True

    def _by_the_rules_of(self, autopilot: int) -> None:
        """What was undone by another autopilot's rules before does not mix with what is now."""
        was, self.autopilot = self.calibrations, autopilot
        if self.calibrations is not was:
            self._epochs.clear()

    def _stored(self, r: ParamReading | CalibrationReading) -> None:
        """Where a correction changes, what comes next teaches nothing; new offsets for old are handed over exactly."""
        held, now_ns = self.calibrations, self._now_ns()
        before = {c: (held.epoch(c), held.offsets(c)) for c in self.channels}
        for compass in self._books.take(r, self.autopilot):
            self.settle(compass)
            epoch, old = before.get(compass, (None, None))
            new = held.offsets(compass)
            if epoch == held.epoch(compass) and old is not None and new is not None:
                self._handovers.setdefault(compass, Handover()).changed(old, new, now_ns)

    def _mag(self, r: MagReading, t_ns: int, unix_ns: int) -> Record | None:
        held, compass, axes = self.calibrations, r.compass, self.settings.compass.axes
        self.unjudged = None
        if not held.sensor(compass, r.device_id, r.source):
            self.counts["mag: same compass in a better message"] += 1
            return None
        if axes == 2:
            r = replace(r, field_b_mg=vec3((*r.field_b_mg[:2], 0.0), "field"))
        channel, stored = self._channel(compass), held.standing(compass)
        channel.held = not self.learning or self._over(r.boot_ns)
        if stored.epoch != self._epochs.get(compass) and not channel.keeps:
            self._epochs[compass] = stored.epoch
            self.assembler.restart(compass)
            channel.restart()
            self.causes.restart(compass)
            self._handovers.pop(compass, None)
        if not stored.undoable:
            self.counts[f"compass {compass}: stored matrix cannot be undone"] += 1
            return None
        learn = self._teaches(compass, r.boot_ns) and not channel.held
        undo: Callable[[Vec3], Vec3] = partial(held.undo, compass, source=r.source)
        shaping = stored.shaping
        if axes == 2:
            try:
                undo, shaping = without_third(undo, shaping)
            except ValueError:
                self.counts[f"compass {compass}: two axes: sensor is mounted upright"] += 1
                return None
        here = self.expected(unix_ns)
        model_mg = None if here is None else (here.horizontal_mg, here.down_mg)
        sample = self.assembler.mag(r, undo, shaping, learn, axes, model_mg, self._throttle)
        if self.assembler.reboots != self._reboots:
            self._after_reboot()
        if sample is None:
            return self._frozen(r, t_ns, channel)
        sample = self._handed_over(self._handled(sample, channel.held), channel.estimate)
        circumstances = self._circumstances(compass, here, stored)
        if self._tap is not None:
            self._tap(sample, circumstances, (self._reboots, stored.epoch))
        if self._idle and not self._news(sample, circumstances):
            return None
        used_b_mg = held.corrected(compass, r.field_b_mg, r.source)
        finding = steadied(sample, channel.step(sample, used_b_mg, circumstances), self.assembler.motion)
        if not self._idle:
            self.causes.step(sample, finding.estimate, circumstances.expected, used_b_mg, self.phase.unflown)
        finding = self._doubted(finding, stored.refuses or self.causes.refuses(compass))
        published, published_ns = self._publish(sample, finding)
        record = self._latest[compass] = Record(
            t_ns=t_ns,
            system=self.system,
            compass=compass,
            device_id=stored.device_id,
            boot_ns=r.boot_ns,
            age_s=sample.age_s,
            mag_b_mg=sample.mag_b_mg,
            corrected_b_mg=finding.corrected_b_mg,
            stored_b_mg=used_b_mg,
            roll_rad=sample.roll_rad,
            pitch_rad=sample.pitch_rad,
            estimate=finding.estimate,
            offsets_mg=self._to_store(compass, finding, stored.offsets),
            sigma_mg=finding.sigma_mg,
            heading=finding.heading,
            stored_heading=finding.stored_heading,
            verdict=finding.verdict,
            learnt=sample.learn,
            relative=circumstances.relative,
            axes=axes,
            published=published,
            published_boot_ns=published_ns,
            throttle=sample.throttle,
        )
        return record

    def _news(self, s: Sample, c: Circumstances) -> bool:
        """Where nothing is learnt: is there anything else to say than at the sample before?"""
        self.unjudged, was = (s, c), self._said.get(s.compass)
        self._said[s.compass] = c, s.tilt_from
        return was is None or was[0] is not c or was[1] != s.tilt_from

    def _handled(self, s: Sample, held: bool) -> Sample:
        """What is turned by hand teaches too, and says so."""
        settled = s.boot_ns >= self._settle_until_ns.get(s.compass, 0)
        taught = s.learn or (self.phase.handled(s) and settled and not held)
        if not taught or self.phase.armed or not self.phase.flyer:
            return s
        return replace(s, learn=True, by_hand=True)

    def _handed_over(self, s: Sample, e: Estimate) -> Sample:
        """Undone with the offsets it was made with, while new ones take the place of old ones."""
        handover = self._handovers.get(s.compass)
        if handover is None:
            handover = self._handovers[s.compass] = Handover()
        return handover.step(s, e, int(self.settings.learn.settle_s * 1e9))

    def _publish(self, sample: Sample, finding: Finding) -> tuple[Heading, int]:
        """The heading that goes out, smoothed as the settings say, and the boot time it belongs to."""
        wanted, compass = self.settings.heading, sample.compass
        if wanted.smooth == "off":
            self._publishers.pop(compass, None)
            return finding.heading, sample.boot_ns
        publisher = self._publishers.get(compass)
        if publisher is None or (publisher.smoothing, publisher.lag) != (wanted.smooth, wanted.lag):
            publisher = self._publishers[compass] = Publisher(wanted.smooth, wanted.lag)
        noise = noise_of_heading(finding.estimate, finding.estimate.horizontal_mg)
        return publisher.step(sample.boot_ns, finding.heading, noise)

    def _doubted(self, f: Finding, reason: Reason | None) -> Finding:
        """Offsets that rest on a wrong mounting or scale are not for writing, however sure they are."""
        if reason is None or f.verdict.state is State.NO_DATA:
            return f
        return replace(f, verdict=Verdict(State.REFUSED, f.verdict.axes, (reason, *f.verdict.reasons)))

    def _to_store(self, compass: int, finding: Finding, stored: Vec3 | None) -> Vec3:
        """The offsets this compass should hold: an axis that was not observed stays exactly as it is stored (S4).

        None of the three changes at every sample, so the same ones are not put together anew.
        """
        offsets, axes = finding.offsets_mg, finding.verdict.axes
        if AxisState.NOT_OBSERVED not in axes:
            return offsets
        was = self._wanted.get(compass)
        if was is not None and was[0] is offsets and was[1] is axes and was[2] is stored:
            return was[3]
        unknown = [axis is AxisState.NOT_OBSERVED for axis in axes]
        out = vec3(np.where(unknown, ZERO3 if stored is None else stored, offsets), "offsets")
        self._wanted[compass] = offsets, axes, stored, out
        return out

    def _frozen(self, r: MagReading, t_ns: int, channel: Channel) -> Record | None:
        """A stuck sensor gives no fresh value, so nobody would judge it again: withdraw its verdict, once a second."""
        last = self._latest.get(r.compass)
        if last is None or r.boot_ns - last.boot_ns < _SAY_FROZEN_NS or self.assembler.frozen_s(r.compass) <= _FROZEN_S:
            return None
        if Reason.FROZEN not in last.verdict.reasons:
            reasons = (Reason.FROZEN, *last.verdict.reasons)
            channel.verdict = Verdict(State.REFUSED, last.verdict.axes, reasons)
            self.counts["mag: frozen"] += 1
        self._said.pop(r.compass, None)
        said = replace(last, t_ns=t_ns, boot_ns=r.boot_ns, heading=UNKNOWN, verdict=channel.verdict, learnt=False)
        said = replace(said, published=UNKNOWN, published_boot_ns=r.boot_ns)
        self._latest[r.compass] = said
        return said

    # ------------------------------------------------------------ the questions asked on the way

    @property
    def calibrations(self) -> StoredCalibrations:
        """What this vehicle stores for its compasses, by the rules of its autopilot (ArduPilot's until it says)."""
        return self._books.of(self.autopilot)

    def _now_ns(self) -> int:
        return self.assembler.clock.latest_ns or 0

    def _channel(self, compass: int) -> Channel:
        if compass not in self.channels:
            self.channels[compass] = (idle_channel if self._idle else new_channel)(self.settings)
        return self.channels[compass]

    def settle(self, compass: int) -> None:
        """What comes now and for a moment teaches nothing: this compass's correction is changing."""
        until = self._now_ns() + int(self.settings.learn.settle_s * 1e9)
        self._settle_until_ns[compass] = until

    def _teaches(self, compass: int, boot_ns: int) -> bool:
        if self._first_ns is None:
            self._first_ns = boot_ns
        flying = self.phase.learnable(boot_ns, self.settings.learn.on_ground)
        return flying and boot_ns >= self._settle_until_ns.get(compass, 0)

    def started_ns(self) -> int | None:
        """Boot time of take-off, or of the first data where nothing flies; None before."""
        return self.phase.takeoff_ns if self.phase.flyer else self._first_ns

    def _over(self, boot_ns: int) -> bool:
        started = self.started_ns()
        return self.learn_for_s is not None and started is not None and boot_ns - started > self.learn_for_s * 1e9

    def expected(self, unix_ns: int) -> ExpectedField | None:
        """The Earth's field where the vehicle says it is, or where the settings say; None when neither."""
        if self._place is None:
            return None
        if self._unix_minus_boot_ns is not None:
            unix_ns = self._unix_minus_boot_ns + self._now_ns()
        return self._keeper.at(*self._place, unix_ns)

    def _circumstances(self, compass: int, here: ExpectedField | None, stored: Standing) -> Circumstances:
        """Of a fresh value, so of a sensor that is not stuck; the same object while nothing changes."""
        flyer, grounded = self.phase.flyer, self.phase.unflown and not self.settings.learn.on_ground
        made_of = here, stored, flyer, grounded
        was = self._around.get(compass)
        if was is None or was[0] != made_of:
            offsets = stored.offsets if flyer else None
            now = Circumstances(here, not stored.known, stored.assumed, stored.changed, grounded, 0.0, offsets)
            was = self._around[compass] = made_of, now
        return was[1]

    def _after_reboot(self) -> None:
        """A vehicle that started anew may hold other parameters and stand elsewhere: begin again."""
        self._reboots = self.assembler.reboots
        self.counts["reboots"] += 1
        self.former = Boot(self.calibrations, self.phase, self.started_ns(), self.causes)
        kind = self.phase.kind
        self.phase = Phase()
        self.phase.kind = kind
        self.causes = Causes()
        self._books = Books()
        self._epochs.clear()
        self._settle_until_ns.clear()
        self._handovers.clear()
        self._latest.clear()
        self._publishers.clear()
        self._said.clear()
        self._first_ns = self._unix_minus_boot_ns = None
        for channel in self.channels.values():
            if not channel.keeps:
                channel.restart()
