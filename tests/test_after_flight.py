"""After the flight: flights known whole, time turned round, and where it is shown."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from honest_flight import EXPECTED, MOTIONS, RATE_HZ, samples
from memory_flight import Frames, earth_model, flight
from synthetic_flight import HARD_IRON_MG

from magmav.afterwards import Afterwards
from magmav.cli import main
from magmav.comparison import SMOOTHED, compare
from magmav.core.after_flight import AfterFlight, after_flight
from magmav.core.estimators.adaptive import AdaptiveEstimator
from magmav.core.estimators.adaptive.bank import Bank
from magmav.core.estimators.adaptive.tuning import Tuning
from magmav.core.rotation import body_from_earth
from magmav.core.smoother.columns import Columns
from magmav.core.stretch import framed
from magmav.core.types import Estimate, mat3, vec3
from magmav.hearing import LinkRecording
from magmav.recording import replay
from magmav.settings import Settings
from magmav.view.compare import compare_view
from magmav.view.table import replay_view, to_text

HERE = (EXPECTED.horizontal_mg, EXPECTED.down_mg)
SECONDS = 60.0


def flown(motion="figure eight", seed=1, iron_mg=HARD_IRON_MG, seconds=SECONDS):
    return [replace(s, model_mg=HERE) for s in samples(motion, seed, seconds=seconds, iron_mg=iron_mg)]


def stepping(jump_mg, at_s, seconds=SECONDS):
    iron = np.tile(HARD_IRON_MG, (int(seconds * RATE_HZ), 1)).astype(float)
    iron[int(at_s * RATE_HZ) :] += jump_mg
    return iron


class AllModels(AdaptiveEstimator):
    """As the after-flight pass has it: every model from the first sample on."""

    def _begun(self, field, iron_mg=None):
        return Bank.begun(field, self.tuning, iron_mg)


def live(flight, moments, kind=AdaptiveEstimator):
    """What the estimator believed after these samples."""
    one, out = kind(second=False), []
    for i, s in enumerate(flight):
        one.step(s)
        if i in moments:
            out.append(one.estimate(None))
    return out


def seconds_of(boot_ns):
    return boot_ns / 1e9 - 10.0


def irons(known):
    return np.array([e.hard_iron_b_mg for e in known.estimates])


def sigmas(known):
    return np.array([np.sqrt(np.diag(e.covariance_mg2)) for e in known.estimates])


# ---------------------------------------------------------------- time turned round


def backwards(flight):
    """Time turned round: a step or a gap belongs to the way between two samples, so it goes to its other end."""
    last = replace(flight[-1], dt_s=0.0, yaw_step_rad=0.0, gap=False)
    rest = zip(reversed(flight[:-1]), reversed(flight[1:]), strict=True)
    return [last, *(replace(s, dt_s=n.dt_s, yaw_step_rad=-n.yaw_step_rad, gap=n.gap) for s, n in rest)]


def restamped(flight):
    """The flight flown from its end to its beginning."""
    end = flight[-1].boot_ns + flight[0].boot_ns
    return [replace(s, boot_ns=end - s.boot_ns) for s in backwards(flight)]


def test_flown_from_its_end_a_flight_tells_the_same():
    """To a fraction of a sigma: what is nonlinear begins at the other end, and noise is learnt in another order."""
    flight = flown("survey", 3)
    forth, back = after_flight(flight), after_flight(restamped(flight))
    there = forth.iron_b_mg(forth.boot_ns)
    here = back.iron_b_mg(flight[-1].boot_ns + flight[0].boot_ns - forth.boot_ns)
    assert np.sqrt(np.mean(((there - here) / sigmas(forth)) ** 2)) < 0.5


def turned_axes(s):
    """The vehicle's axes drawn a right angle about down: forward is what right was."""
    q = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    body = s.body_from_own
    return replace(
        s,
        mag_b_mg=vec3(q @ s.mag_b_mg, "field"),
        rate_b_rads=vec3(q @ s.rate_b_rads, "rate"),
        body_from_own=mat3(q @ body, "own frame"),
    )


def test_turned_axes_turn_the_answer():
    flight, yaw = [], 0.0
    for s in flown("survey", 4, seconds=30.0):
        yaw += s.yaw_step_rad
        flight.append(replace(s, body_from_own=mat3(body_from_earth(s.roll_rad, s.pitch_rad, yaw), "own frame")))
    plain, turned = after_flight(flight), after_flight([turned_axes(s) for s in flight])
    x, y, z = irons(plain).T
    assert irons(turned) == pytest.approx(np.column_stack((y, -x, z)), abs=1e-3)


# ---------------------------------------------------------------- flights


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_constant_iron_is_constant_to_its_sigma_from_the_first_second_on(motion):
    known = after_flight(flown(motion, 6))
    assert known.changes_ns == ()
    assert np.all(np.abs(irons(known) - irons(known)[-1]) < sigmas(known))
    assert np.all(np.abs(irons(known) - HARD_IRON_MG) < 3.0 * sigmas(known) + 2.0)
    assert np.all(sigmas(known)[0] < 1.5 * sigmas(known)[-1] + 1.0)  # what came after is known at the start already


def test_the_end_is_the_end_of_the_flight_as_it_was_flown():
    """Nothing comes after it: all that was known then is known, no more and hardly differently."""
    flight = flown("survey", 5)
    answer, then = after_flight(flight).answer, live(flight, {len(flight) - 1}, AllModels)[-1]
    sigma = np.sqrt(np.diag(then.covariance_mg2))
    assert np.all(np.abs(answer.hard_iron_b_mg - then.hard_iron_b_mg) < 0.5 * sigma)
    assert np.all(np.abs(np.log(np.sqrt(np.diag(answer.covariance_mg2)) / sigma)) < math.log(2.0))
    assert answer.samples == then.samples


@pytest.mark.parametrize(("seed", "at_s"), [(1, 30.0), (2, 42.0), (3, 17.0)])
def test_a_step_is_placed_within_two_seconds_and_known_on_both_sides(seed, at_s):
    jump = np.array((45.0, -45.0, 30.0))
    iron = stepping(jump, at_s)
    known = after_flight(flown("figure eight", seed, iron))
    (when,) = known.changes_ns
    assert seconds_of(when) == pytest.approx(at_s, abs=2.0)
    t = seconds_of(known.boot_ns)
    clear = np.abs(t - at_s) > 0.3
    error = irons(known) - iron[np.round(t * RATE_HZ).astype(int)]
    near = clear & (np.abs(t - at_s) < 6.0)
    assert near.sum() >= 8
    assert np.abs(error[near][:, :2]).max() < 6.0
    assert np.sqrt(np.mean((error[clear] / sigmas(known)[clear]) ** 2)) < 1.3
    # between two moments, never across the step
    sides = known.iron_b_mg(np.array([when, when + 1], dtype=np.int64))
    assert sides[1] - sides[0] == pytest.approx(jump, abs=12.0)


def path_errors(flight, iron):
    """Errors over their sigma, and plain, along the path from 5 s on: afterwards, and as it was believed."""
    known = after_flight(flight)
    t = seconds_of(known.boot_ns)
    late = t >= 5.0
    index = np.round(t * RATE_HZ).astype(int)
    then = np.array([e.hard_iron_b_mg for e in live(flight, set(index[late].tolist()))])
    return irons(known)[late] - iron[index[late]], sigmas(known)[late], then - iron[index[late]]


def test_a_drift_is_followed_without_lag_and_the_sigma_is_honest():
    iron = HARD_IRON_MG + np.outer(np.arange(800) / RATE_HZ, (0.3, -0.3, 0.2))
    after, sigma, before = [], [], []
    for seed in range(2):
        for into, one in zip(
            (after, sigma, before), path_errors(flown("figure eight", 20 + seed, iron, 80.0), iron), strict=True
        ):
            into.append(one)
    after, sigma, before = (np.concatenate(part) for part in (after, sigma, before))
    assert np.sqrt(np.mean(after**2)) < 0.7 * np.sqrt(np.mean(before**2))
    assert 0.2 < np.sqrt(np.mean((after / sigma) ** 2)) < 1.2


def test_after_a_gap_in_the_middle_both_sides_still_meet():
    flight = flown("figure eight", 9)
    flight[300] = replace(flight[300], gap=True, yaw_step_rad=2.0)
    known = after_flight(flight)
    assert np.all(np.abs(irons(known) - HARD_IRON_MG) < 3.0 * sigmas(known) + 2.0)


def test_without_a_position_the_field_is_found_as_well():
    known = after_flight(samples("figure eight", 12, seconds=SECONDS))
    assert np.all(np.abs(irons(known) - HARD_IRON_MG) < 3.0 * sigmas(known) + 3.0)
    assert known.answer.horizontal_mg == pytest.approx(HERE[0], abs=15.0)


def test_what_was_turned_by_hand_is_left_out_where_anything_flew():
    in_hands = [replace(s, by_hand=True) for s in flown("hover turns", 2, HARD_IRON_MG + 60.0, 20.0)]
    start = in_hands[-1].boot_ns - 10**10 + 10**8
    aloft = [replace(s, boot_ns=s.boot_ns + start) for s in flown("figure eight", 3)]
    known = after_flight([*in_hands, *aloft])
    assert known.boot_ns[0] >= aloft[0].boot_ns
    assert irons(known)[0] == pytest.approx(HARD_IRON_MG, abs=12.0)
    assert after_flight(in_hands).answer.hard_iron_b_mg == pytest.approx(HARD_IRON_MG + 60.0, abs=15.0)


def test_where_nothing_was_learnt_nothing_is_known():
    assert after_flight([]) is None
    assert after_flight([replace(s, learn=False) for s in flown(seconds=10.0)]) is None
    assert after_flight(flown(seconds=0.5)) is None


def test_between_two_moments_in_proportion_beyond_them_as_at_the_end():
    def said(x):
        return Estimate(vec3((x, 0, 0), "iron"), np.eye(3), vec3((1, 1, 1), "s"), 200.0, 400.0, 3.0, 1.0, 50, 1e9)

    known = AfterFlight(np.array([10, 20, 30]), (said(1.0), said(2.0), said(9.0)), (20,))
    asked = np.array([0, 15, 20, 21, 29, 99])
    assert known.iron_b_mg(asked)[:, 0] == pytest.approx([1.0, 1.5, 2.0, 9.0, 9.0, 9.0])


# ---------------------------------------------------------------- where it is shown


@pytest.fixture(scope="module")
def heard():
    return flight(seconds=30.0)


def test_compare_has_a_row_of_it_beside_the_adaptive_estimators(heard):
    ticks = itertools.count()
    result = compare(
        LinkRecording(Frames(heard)),
        Settings(),
        earth_model,
        clock=lambda: float(next(ticks)),
        only=["adaptive", SMOOTHED],
    )
    live_row, row = result["vehicles"][0]["compasses"][0]["estimators"]
    assert row["name"] == SMOOTHED and row["state"] is None and row["reasons"] == []
    # The live one hears the second opinion as well.
    assert row["offsets_mg"] == pytest.approx(live_row["offsets_mg"], abs=1.5)
    assert row["half_offsets_mg"] == pytest.approx(live_row["half_offsets_mg"], abs=3.0)
    assert row["in_sample"]["rms_deg"] < 6.0
    text = to_text(compare_view(result), width=120)
    assert f" {SMOOTHED} " in text


def test_replay_tells_it_where_it_is_asked_for(heard):
    afterwards, references = Afterwards(), {}
    result = replay(LinkRecording(Frames(heard)), Settings(), earth_model, references=references, tap=afterwards.tap)
    assert "After the flight" not in to_text(replay_view(result))
    afterwards.add_to(result, references)
    entry = result["vehicles"][0]["compasses"][0]["after_flight"]
    assert entry["offsets_mg"] == pytest.approx(-HARD_IRON_MG, abs=15.0)
    assert entry["heading"]["rms_deg"] < 6.0
    assert 25 <= len(entry["path"]) <= 31
    assert "After the flight" in to_text(replay_view(result))


def test_all_of_the_flight_cannot_be_known_and_frozen(capsys, tmp_path):
    assert main(["replay", str(tmp_path / "x.tlog"), "--after-flight", "--learn-for", "30"]) == 2
    assert "--learn-for" in capsys.readouterr().err


def test_a_rest_in_mid_flight_with_a_biased_gyro_turns_nothing_astray():
    """What a gyro shows while nothing moves is its bias: the own frame turns by it, the vehicle does not."""
    rng = np.random.default_rng(3)
    flight = flown("figure eight", 13)
    first, last = flight[:300], flight[300:]
    still, dt, turn_rads = first[-1], first[-1].dt_s, math.radians(0.5)
    bias = vec3(turn_rads * body_from_earth(still.roll_rad, still.pitch_rad, 0.0)[:, 2], "rate")
    rest = []
    for i in range(round(40.0 / dt)):
        rest.append(
            replace(
                still,
                boot_ns=still.boot_ns + round((i + 1) * dt * 1e9),
                mag_b_mg=vec3(still.mag_b_mg + rng.normal(0.0, 1.0, 3), "mag"),
                rate_b_rads=bias,
                yaw_step_rad=turn_rads * dt,
                body_from_own=None,
                throttle=None,
            )
        )
    whole = [*first, *rest, *[replace(s, boot_ns=s.boot_ns + 40_000_000_000) for s in last]]
    assert Columns.of(framed(whole), Tuning()).turned_rad.sum() > math.radians(10.0)
    known = after_flight(whole)
    assert not known.changes_ns
    assert np.all(np.abs(irons(known) - HARD_IRON_MG) < 4.0 * sigmas(known) + 2.0)
