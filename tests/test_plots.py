"""Pictures: what is drawn is what was measured, and it says against what."""

import math
import struct
import subprocess
import sys
import zlib
from dataclasses import replace

import numpy as np
import pytest
from synthetic_flight import DECLINATION_RAD, EARTH_MG, HARD_IRON_MG, fly
from test_records import make

from magmav.core.types import AxisState, Heading, State, vec3
from magmav.reference import Reference
from magmav.score import heading_error_rad, magnetic_heading_rad, score_heading
from magmav.view.plots import DemoFlight, DemoOffsets, Trace, TraceCollector, plot_demo, plot_replay
from magmav.view.records import ViewError

AXES = (AxisState.OBSERVED, AxisState.OBSERVED, AxisState.FROM_MODEL)


@pytest.fixture(scope="module")
def flown():
    """A trace of a flight whose hard iron is learnt exponentially, and the flight."""
    flight = fly(60.0, noise_mg=3.0, seed=5)
    t = flight.boot_s - flight.boot_s[0]
    hard_iron = HARD_IRON_MG * (1 - np.exp(-t / 8.0))[:, None]
    corrected = flight.sensor_b_mg - hard_iron
    stored, heading = (
        magnetic_heading_rad(field, flight.roll_rad, flight.pitch_rad) for field in (flight.sensor_b_mg, corrected)
    )
    heading = np.where(t > 3.0, heading, np.nan)
    trace = Trace(
        system=1,
        compass=2,
        device_id=97539,
        boot_s=flight.boot_s,
        stored_b_mg=flight.sensor_b_mg,
        corrected_b_mg=corrected,
        offsets_mg=-hard_iron,
        sigma_mg=np.tile([2.0, 3.0, np.nan], (len(t), 1)),
        stored_heading_rad=stored,
        stored_heading_true_rad=stored + DECLINATION_RAD,
        heading_rad=heading,
        heading_true_rad=heading + DECLINATION_RAD,
        heading_sigma_rad=np.full(len(t), 0.02),
        expected_mg=float(np.linalg.norm(EARTH_MG)),
        axes=AXES,
        state=State.READY,
        samples=len(t),
    )
    return trace, flight


@pytest.fixture(scope="module")
def picture(flown, tmp_path_factory):
    """The flight drawn without a reference."""
    return plot_replay(tmp_path_factory.mktemp("plots") / "r.png", [flown[0]], "t", None)


def drawn(figure, title, label):
    """x and y of the one line with this label in the one panel with this title."""
    panels = [a for a in figure.get_axes() if a.get_title(loc="left").startswith(title)]
    (line,) = [ln for a in panels for ln in a.get_lines() if str(ln.get_label()).startswith(label)]
    return np.asarray(line.get_xdata()), np.asarray(line.get_ydata())


def words(figure):
    texts = [figure.get_suptitle()] + [s.get_suptitle() for s in figure.subfigs]
    for axes in figure.get_axes():
        texts += [axes.get_title(loc="left"), axes.get_xlabel(), axes.get_ylabel()]
        texts += [t.get_text() for t in axes.get_legend().get_texts()]
    return texts


def test_the_drawn_error_is_the_scored_error(tmp_path, flown):
    trace, flight = flown
    yes = np.ones(len(flight.boot_s), dtype=bool)
    reference = Reference("SIM yaw", flight.boot_s, flight.roll_rad, flight.pitch_rad, flight.yaw_rad, yes, yes)
    score = score_heading(trace.boot_s, trace.heading_true_rad, reference)
    seen = trace.against(reference.interpolate(trace.boot_s).yaw_true_rad, 91.23, score.rms_deg, (20.0, 70.0), 20.0)
    figure = plot_replay(tmp_path / "r.png", [seen], "flight.tlog", reference.name)

    x, before = drawn(figure, "Heading error against SIM yaw", "as streamed: 91.2 deg RMS")
    assert np.array_equal(x, flight.boot_s)
    want = np.degrees(heading_error_rad(trace.boot_s, trace.stored_heading_true_rad, reference))
    assert before == pytest.approx(want, abs=1e-9) and np.abs(before).max() > 90
    _, after = drawn(figure, "Heading error against SIM yaw", f"corrected: {score.rms_deg:.3g} deg RMS")
    want = np.degrees(heading_error_rad(trace.boot_s, trace.heading_true_rad, reference))
    assert after == pytest.approx(want, abs=1e-9, nan_ok=True)
    assert math.sqrt(np.nanmean(after**2)) == pytest.approx(score.rms_deg)
    _, close = drawn(figure, "The corrected heading magnified", "corrected")
    assert close == pytest.approx(after, nan_ok=True)
    for title in ("Heading error", "The corrected heading"):
        (axes,) = [a for a in figure.get_axes() if a.get_title(loc="left").startswith(title)]
        low, high = axes.get_ylim()
        assert low == -high and high <= 180
        assert "SIM yaw" in axes.get_title(loc="left")


def test_offsets_are_drawn_with_their_sigma_and_what_is_not_known_is_left_out(picture, flown):
    trace, _ = flown
    figure = picture
    for i, label in enumerate(("x forward -310 ± 2.0 mG", "y right 140 ± 3.0 mG", "z down -220 mG (from field")):
        x, y = drawn(figure, "Offsets to store", label)
        assert np.array_equal(x, trace.boot_s) and np.array_equal(y, trace.offsets_mg[:, i])
    (axes,) = [a for a in figure.get_axes() if a.get_title(loc="left").startswith("Offsets")]
    band = axes.collections[1].get_paths()[0].vertices
    at_end = band[np.isclose(band[:, 0], trace.boot_s[-1])][:, 1]
    assert (at_end.min(), at_end.max()) == pytest.approx((trace.offsets_mg[-1, 1] - 3, trace.offsets_mg[-1, 1] + 3))


def test_the_field_is_drawn_on_equal_axes_round_its_sphere(picture, flown):
    trace, _ = flown
    figure = picture
    for title, across, up in (("Field from above (circle: 477 mG)", 1, 0), ("Field from the side", 0, 2)):
        x, y = drawn(figure, title, "corrected")
        assert np.array_equal(x, trace.corrected_b_mg[:, across]) and np.array_equal(y, trace.corrected_b_mg[:, up])
        x, y = drawn(figure, title, "as streamed")
        assert np.array_equal(x, trace.stored_b_mg[:, across]) and np.array_equal(y, trace.stored_b_mg[:, up])
        (axes,) = [a for a in figure.get_axes() if a.get_title(loc="left").startswith(title)]
        assert axes.get_aspect() == 1.0
        circle = next(ln for ln in axes.get_lines() if len(np.asarray(ln.get_xdata())) == 181)
        radii = np.hypot(*np.asarray(circle.get_xydata()).T)
        assert radii == pytest.approx(np.linalg.norm(EARTH_MG))
    assert axes.yaxis_inverted()  # down is down


def test_without_a_reference_no_error_is_claimed(tmp_path, flown):
    trace, _ = flown
    magnetic = replace(trace, compass=3, heading_true_rad=np.full(len(trace.boot_s), np.nan))
    figure = plot_replay(tmp_path / "r.png", [magnetic], "bench $5 \u4e2d.tlog", None)
    _, y = drawn(figure, "Heading, magnetic north", "corrected")
    assert y == pytest.approx(np.degrees(trace.heading_rad) % 360, nan_ok=True)
    _, turned = drawn(figure, "How far the correction turns", "corrected less streamed")
    wrapped = np.angle(np.exp(1j * (trace.heading_rad - trace.stored_heading_rad)), deg=True)
    assert turned == pytest.approx(wrapped, nan_ok=True)
    said = words(figure)
    assert not any("error against" in text or "RMS" in text for text in said)
    assert said[0] == r"bench \$5 ?.tlog   (heading errors: not known)"


def test_every_compass_has_its_block_and_the_picture_is_a_png(tmp_path, flown):
    trace, _ = flown
    path = tmp_path / "three.png"
    short = replace(trace, **{
        name: getattr(trace, name)[:2]
        for name in Trace.__slots__
        if isinstance(getattr(trace, name), np.ndarray)
    })  # fmt: skip
    nothing = np.full((2, 3), np.nan)
    blank = replace(short, compass=3, device_id=0, reboots=1, offsets_mg=nothing, sigma_mg=nothing)
    figure = plot_replay(path, [short, replace(blank, corrected_b_mg=nothing)], "t", None)
    assert "x forward not known" in words(figure) and "z down not known (from field model)" in words(figure)
    assert [s.get_suptitle() for s in figure.subfigs] == [
        "System 1, compass 2, device 97539: ready",
        "System 1, compass 3: ready, after 1 reboot(s)",
    ]
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", data[16:24])
    assert width == 1300 and height > 1500
    start = data.index(b"IHDR")
    assert zlib.crc32(data[start : start + 17]) == struct.unpack(">I", data[start + 17 : start + 21])[0]


def test_a_picture_that_cannot_be_written_is_refused_by_name(tmp_path, flown):
    trace, flight = flown
    short = DemoFlight(flight.boot_s[:2], np.zeros(2), None)
    with pytest.raises(ViewError, match=r"nodir/r\.png: cannot write picture: No such file"):
        plot_demo(tmp_path / "nodir/r.png", short, short, [], "t", "truth")
    with pytest.raises(ViewError, match=r"r\.jpg: pictures want a name ending in \.png"):
        plot_replay(tmp_path / "r.jpg", [trace], "t", None)
    with pytest.raises(ValueError, match="traces: nothing to draw"):
        plot_replay(tmp_path / "r.png", [], "t", None)
    with pytest.raises(ValueError, match="reference_true_rad: want"):
        trace.against(np.zeros(3))


def test_the_demo_draws_both_flights_and_the_offsets_against_the_truth(tmp_path):
    t = 100.0 + np.arange(200) / 10
    before = DemoFlight(t, 80 * np.sin(t), 56.6, own_error_deg=5 * np.cos(t))
    after = DemoFlight(t + 500, 0.5 * np.sin(t), 0.354)
    compass = DemoOffsets(
        1, *(np.array(v, float) for v in ([0, 0, 0], [-309, 141, -222], [1, 1, 3], [-310, 140, -220]))
    )
    figure = plot_demo(tmp_path / "d.png", before, after, [compass], "magmav demo", "simulated truth")
    for title, label, flight, error in (
        ("First flight", "streamed: 56.6 deg RMS", before, before.error_deg),
        ("First flight", "magmav", before, before.own_error_deg),
        ("Second flight: uploaded", "streamed: 0.354 deg RMS", after, after.error_deg),
        ("The second flight magnified", "streamed: 0.354 deg RMS", after, after.error_deg),
    ):
        x, y = drawn(figure, title, label)
        assert x == pytest.approx(flight.boot_s - flight.boot_s[0]) and np.array_equal(y, error)
    for label, values in (("old", compass.old_mg), ("uploaded", compass.new_mg), ("truth", compass.true_mg)):
        assert np.array_equal(drawn(figure, "Offsets", label)[0], values)
    notes = [t.get_text() for a in figure.get_axes() for t in a.texts]
    assert notes == ["off by +1.0 ± 1.0 mG", "off by +1.0 ± 1.0 mG", "off by -2.0 ± 3.0 mG"]
    panels = {a.get_title(loc="left"): a for a in figure.get_axes()}
    assert panels["First flight: old offsets"].get_ylim() == panels["Second flight: uploaded offsets"].get_ylim()
    assert panels["First flight: old offsets"].get_ylabel() == "error against simulated truth, deg"
    assert panels["The second flight magnified"].get_ylim() == (-1.0, 1.0)


# ---------------------------------------------------------------- collecting


def record_at(i, **changes):
    return make(0, boot_ns=i * 20_000_000, mag_b_mg=vec3((i, 0, 0), "m"), stored_b_mg=vec3((i, 1, 2), "s"), **changes)


def test_a_trace_says_what_the_records_said():
    collector = TraceCollector()
    blind = Heading(False, False, 1.0, 2.0, 3.0)
    collector.add(record_at(1, heading=blind, sigma_mg=np.array([1.0, np.inf, 2.0])))
    record = record_at(2)
    collector.add(record)
    (trace,) = collector.traces()
    assert trace.boot_s == pytest.approx([0.02, 0.04]) and trace.samples == 2
    assert np.isnan([trace.heading_rad[0], trace.heading_true_rad[0], trace.heading_sigma_rad[0]]).all()
    assert trace.heading_true_rad[1] == record.heading.true_rad
    assert trace.stored_heading_rad[1] == record.stored_heading.magnetic_rad
    assert np.isnan(trace.stored_heading_true_rad).all()  # that heading was magnetic only
    assert np.array_equal(trace.stored_b_mg, [[1, 1, 2], [2, 1, 2]])
    assert np.array_equal(trace.corrected_b_mg[1], record.corrected_b_mg)
    assert np.array_equal(trace.offsets_mg[1], record.offsets_mg)
    assert np.isnan(trace.sigma_mg[0, 1]) and trace.sigma_mg[0, 2] == 2.0
    assert trace.expected_mg == pytest.approx(math.hypot(200, 400))
    assert (trace.axes, trace.state) == (record.verdict.axes, State.LEARNING)


@pytest.mark.parametrize("limit", [2, 7, 100])
def test_thinning_is_even_bounded_and_keeps_both_ends_near(limit):
    collector = TraceCollector(max_points=limit)
    for i in range(1, 1001):
        collector.add(record_at(i))
    (trace,) = collector.traces()
    steps = np.diff(trace.boot_s) / 0.02
    assert limit / 2 <= len(trace.boot_s) <= limit and trace.samples == 1000
    assert steps == pytest.approx(steps[0] * np.ones(len(steps)))
    assert trace.boot_s[0] == pytest.approx(0.02)
    assert trace.boot_s[-1] + steps[0] * 0.02 > 20.0


def test_compasses_are_kept_apart_and_a_reboot_begins_again():
    collector = TraceCollector()
    for i in (200, 201, 201, 190):  # a copy and a late packet: neither is news
        collector.add(record_at(i, compass=3))
    for i in (200, 201, 5, 6, 7):
        collector.add(record_at(i, compass=1))
    one, three = collector.traces()
    assert (one.compass, one.reboots) == (1, 1) and one.boot_s == pytest.approx([0.1, 0.12, 0.14])
    assert (three.compass, three.reboots) == (3, 0) and three.boot_s == pytest.approx([4.0, 4.02])
    with pytest.raises(ValueError, match="max_points"):
        TraceCollector(1)


def test_drawing_is_not_paid_for_until_something_is_drawn():
    program = "import sys, magmav.view.plots, magmav.view.table; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0
