"""What a picture is drawn from: the records of one compass as arrays, thinned so that memory is bounded."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magmav.core.types import AxisState, Heading, Record, State

Floats = NDArray[np.float64]

MAX_POINTS = 20_000
_REBOOT_S = 1.0  # boot time falling back by more is a reboot; by less, a packet out of order


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """One compass of one vehicle over its boot time, since its last reboot.

    Arrays are (N,) or (N, 3), NaN where not known; angles in radians, fields in mG and body axes.
    stored is what the autopilot's own values give, corrected what the estimate gives; expected_mg is the
    field strength the data imply. The rms, scored and frozen values come from a score, drawn as given.
    """

    system: int
    compass: int
    device_id: int  # 0 when not known
    boot_s: Floats
    stored_b_mg: Floats
    corrected_b_mg: Floats
    offsets_mg: Floats
    sigma_mg: Floats
    stored_heading_rad: Floats  # magnetic
    stored_heading_true_rad: Floats
    heading_rad: Floats  # magnetic
    heading_true_rad: Floats
    heading_sigma_rad: Floats
    expected_mg: float
    axes: tuple[AxisState, AxisState, AxisState]
    state: State
    samples: int  # before thinning
    reboots: int = 0
    reference_true_rad: Floats | None = None
    rms_before_deg: float | None = None
    rms_after_deg: float | None = None
    scored_s: tuple[float, float] | None = None
    frozen_s: float | None = None

    def against(
        self,
        reference_true_rad: ArrayLike,
        rms_before_deg: float | None = None,
        rms_after_deg: float | None = None,
        scored_s: tuple[float, float] | None = None,
        frozen_s: float | None = None,
    ) -> Self:
        """The same with a reference heading at every boot_s, (N,) rad true, NaN where it has none."""
        reference = np.asarray(reference_true_rad, dtype=np.float64)
        if reference.shape != self.boot_s.shape:
            raise ValueError(f"reference_true_rad: want {self.boot_s.shape}, got {reference.shape}")
        return replace(
            self,
            reference_true_rad=reference,
            rms_before_deg=rms_before_deg,
            rms_after_deg=rms_after_deg,
            scored_s=scored_s,
            frozen_s=frozen_s,
        )

    def error_deg(self, heading_true_rad: Floats) -> Floats:
        """Heading less reference, (N,) degrees in [-180, 180); NaN where either is not known."""
        if self.reference_true_rad is None:
            raise ValueError("reference_true_rad: this trace has no reference")
        return (np.degrees(heading_true_rad - self.reference_true_rad) + 180.0) % 360.0 - 180.0


class TraceCollector:
    """Gathers records, each compass on its own. When one is full every second point goes, and so on."""

    def __init__(self, max_points: int = MAX_POINTS) -> None:
        if max_points < 2:
            raise ValueError(f"max_points: want 2 or more, got {max_points}")
        self._max = max_points
        self._series: dict[tuple[int, int], _Series] = {}

    def add(self, record: Record) -> None:
        """Take one record; a boot time that fell back begins the compass again."""
        key = (record.system, record.compass)
        series = self._series.get(key)
        if series is None:
            series = self._series[key] = _Series(self._max, reboots=0)
        back_s = (series.last_ns - record.boot_ns) / 1e9
        if back_s > _REBOOT_S:
            series = self._series[key] = _Series(self._max, series.reboots + 1)
        elif back_s >= 0.0 and series.seen:
            return
        series.add(record)

    def traces(self) -> list[Trace]:
        """A trace per compass seen, in order of system and compass."""
        return [self._series[key].trace() for key in sorted(self._series)]


_COLUMNS = 18
_NONE = (math.nan,) * 3


class _Series:
    """Rows of one compass, at most ``limit``, every ``stride``-th of those seen."""

    def __init__(self, limit: int, reboots: int) -> None:
        self.limit, self.stride, self.seen, self.kept, self.reboots = limit, 1, 0, 0, reboots
        self.last_ns = 0
        self.rows = np.empty((min(limit, 256), _COLUMNS))
        self.last: Record | None = None

    def add(self, record: Record) -> None:
        if self.seen % self.stride == 0:
            if self.kept == self.limit:
                half = self.rows[: self.kept : 2].copy()
                self.rows[: len(half)] = half
                self.kept, self.stride = len(half), self.stride * 2
            if self.seen % self.stride == 0:
                if self.kept == len(self.rows):
                    grown = np.empty((min(self.limit, 2 * self.kept), _COLUMNS))
                    grown[: self.kept] = self.rows
                    self.rows = grown
                self.rows[self.kept] = _row(record)
                self.kept += 1
        self.seen += 1
        self.last, self.last_ns = record, record.boot_ns

    def trace(self) -> Trace:
        rows, last = self.rows[: self.kept].copy(), self.last
        if last is None:
            raise ValueError("no record was added")
        return Trace(
            system=last.system,
            compass=last.compass,
            device_id=last.device_id,
            boot_s=rows[:, 0],
            stored_b_mg=rows[:, 1:4],
            corrected_b_mg=rows[:, 4:7],
            offsets_mg=rows[:, 7:10],
            sigma_mg=rows[:, 10:13],
            stored_heading_rad=rows[:, 13],
            stored_heading_true_rad=rows[:, 14],
            heading_rad=rows[:, 15],
            heading_true_rad=rows[:, 16],
            heading_sigma_rad=rows[:, 17],
            expected_mg=math.hypot(last.estimate.horizontal_mg, last.estimate.down_mg),
            axes=last.verdict.axes,
            state=last.verdict.state,
            samples=self.seen,
            reboots=self.reboots,
        )


def _row(record: Record) -> tuple[float, ...]:
    heading = record.heading
    known = record.estimate.samples > 0  # before that the offsets are where the estimator starts, not an answer
    sigma = record.sigma_mg if known else _NONE
    return (
        record.boot_ns / 1e9,
        *record.stored_b_mg,
        *(record.corrected_b_mg if known else _NONE),
        *(record.offsets_mg if known else _NONE),
        *(value if math.isfinite(value) else math.nan for value in sigma),
        *_angles(record.stored_heading),
        *_angles(heading),
        heading.sigma_rad if heading.valid else math.nan,
    )


def _angles(heading: Heading) -> tuple[float, float]:
    magnetic = heading.magnetic_rad if heading.valid else math.nan
    return magnetic, heading.true_rad if heading.valid and heading.true_valid else math.nan
