"""All estimators side by side: the same samples, halves that know nothing of each other, refusals with their reason."""

import itertools
import json

import numpy as np
import pytest
from memory_flight import HZ, Bench, Frames, earth_model, flight
from synthetic_flight import HARD_IRON_MG

from magmav.comparison import METHODS, SMOOTHED, Tape, compare
from magmav.core.estimators import ESTIMATORS
from magmav.hearing import LinkRecording
from magmav.pipeline import Pipeline
from magmav.recording import Keeper, NothingToLearnFrom, play, replay
from magmav.settings import Settings
from magmav.view.compare import compare_view
from magmav.view.table import to_text

UNIX_NS = 1_790_000_000 * 10**9


def told(frames):
    return LinkRecording(Frames(frames))


def ticking():
    """A clock that is a second later each time it is asked."""
    count = itertools.count()
    return lambda: float(next(count))


def rows(result, compass=0):
    return {r["name"]: r for r in result["vehicles"][0]["compasses"][compass]["estimators"]}


@pytest.fixture(scope="module")
def compared():
    return compare(told(flight(seconds=60.0)), Settings(), earth_model, clock=ticking())


def test_every_estimator_of_the_project_has_a_row(compared):
    assert list(rows(compared)) == METHODS
    assert [name for name in METHODS if name != SMOOTHED] == list(ESTIMATORS)
    json.dumps(compared, allow_nan=False)


def test_the_answer_is_the_one_the_pipeline_gives(compared):
    """Bit for bit: comparing is not another way of estimating."""
    records = Bench().play(flight(seconds=60.0))
    got = rows(compared)[Settings().learn.estimator]
    last = replay(told(flight(seconds=60.0)), Settings(), earth_model)["vehicles"][0]["compasses"][0]
    assert got["offsets_mg"] == pytest.approx(last["offsets_mg"], abs=0.5)  # replay's is up to 0.2 s older
    assert got["state"] == records[-1].verdict.state.name
    assert last["samples_learnt"] == len(records)
    assert 0 <= len(records) - got["samples"] <= 3  # what comes before it moves teaches the estimator nothing


@pytest.mark.parametrize("name", ["kalman", "bullock", "kasa", "taubin"])
def test_three_dimensional_methods_find_the_iron_of_a_figure_eight(compared, name):
    got = rows(compared)[name]
    assert got["offsets_mg"] == pytest.approx(-HARD_IRON_MG, abs=25.0)
    before = compared["vehicles"][0]["compasses"][0]["uncalibrated"]
    assert got["second_half"]["rms_deg"] < 6.0 < 40.0 < before["second_half"]["rms_deg"]


def test_the_cost_is_the_clocks(compared):
    """Each step takes exactly one tick of a clock that ticks when asked: a million microseconds a sample."""
    assert {r["us_per_sample"] for name, r in rows(compared).items() if name != SMOOTHED} == {1e6}


def test_all_scores_of_a_column_are_made_on_the_same_samples_and_none_is_lost(compared):
    compass = compared["vehicles"][0]["compasses"][0]
    for column in ("second_half", "in_sample"):
        scores = [r[column] for r in (*compass["estimators"], compass["uncalibrated"], compass["stored"]) if r[column]]
        assert len({(s["n"], s["from_s"], s["to_s"]) for s in scores}) == 1
        assert scores[0]["n"] + sum(scores[0]["excluded"].values()) == compass["samples"]
    assert compass["estimators"][0]["second_half"]["from_s"] >= compass["split_s"]


def test_the_first_half_knows_nothing_of_the_second():
    """Another iron in the second half: what was fitted before is untouched, what came after is not."""
    n = 60 * HZ
    jump = np.zeros((n, 3))
    jump[n // 2 + HZ :] = (150.0, -80.0, 60.0)
    names = ["kalman", "bullock", "taubin"]
    a, b = (
        rows(compare(told(frames), Settings(), earth_model, clock=ticking(), only=names))
        for frames in (flight(seconds=60.0), flight(seconds=60.0, offsets_mg=jump))
    )
    for name in names:
        assert a[name]["half_offsets_mg"] == b[name]["half_offsets_mg"]
        assert a[name]["offsets_mg"] != b[name]["offsets_mg"]


def test_a_vehicle_that_never_turns_gets_no_circle_and_is_told_why():
    """Noise about one point is no circle: every geometric method says so, and nobody is ready."""
    rng = np.random.default_rng(4)
    still = flight(seconds=30.0, iron_mg=np.array((100.0, 20.0, 300.0)), motion="hover turns")
    standing = stand(still, rng)
    got = rows(compare(told(standing), Settings(), earth_model, clock=ticking()))
    shapeless = ("kalman", "adaptive", SMOOTHED, "twostep")  # they know no shape and refuse none: the gate does
    for name, row in got.items():
        assert row["state"] != "READY", name
        if name not in shapeless:
            assert row["offsets_mg"] is None, name
            assert row["refusal"], name


def stand(frames, rng):
    """The same frames of a vehicle that stands: level, one heading, a compass that only hisses."""
    from memory_flight import Teller

    tell, out = Teller(), []
    for i, (ms, data) in enumerate(frames):
        if i % 2 == 0 and len(data) < 60:
            out.append((ms, tell.attitude(ms, 0.0, 0.0, 1.0, np.zeros(3))))
        elif len(data) < 60:
            out.append((ms, tell.imu(ms, np.array((200.0, 30.0, 450.0)) + rng.normal(0.0, 4.0, 3))))
        else:
            out.append((ms, data))
    return out


def test_an_estimator_nobody_has_heard_of_is_refused_by_name():
    with pytest.raises(ValueError, match="oracle"):
        compare(told(flight(seconds=5.0)), Settings(), earth_model, clock=ticking(), only=["oracle"])


def test_a_recording_without_a_compass_is_refused():
    with pytest.raises(NothingToLearnFrom, match="no magnetometer data"):
        compare(told([]), Settings(), earth_model, clock=ticking())


def test_the_table_shows_every_method_and_says_what_is_not_known(compared):
    text = to_text(compare_view(compared), width=120)
    for name in (*ESTIMATORS, "uncalibrated", "as stored"):
        assert f" {name} " in text
    assert "ATTITUDE yaw" in text
    assert "nan" not in text.lower()


def test_a_tape_keeps_the_last_stretch_that_taught():
    samples = []
    pipeline = Pipeline(Settings(), earth_model, UNIX_NS, lambda s, c, k: samples.append((s, c)))
    play(told(flight(seconds=4.0)), pipeline, Keeper(pipeline, None))
    sample, circumstances = samples[-1]
    quiet = type(sample)(**{f: getattr(sample, f) for f in sample.__dataclass_fields__} | {"learn": False})
    tape = Tape()
    for stretch, one, n in (((0, 0), sample, 5), ((0, 1), sample, 7), ((1, 1), quiet, 9)):
        for _ in range(n):
            tape.add(one, circumstances, stretch)
    tape.close()
    assert (len(tape.heard), tape.learnt) == (7, 7)
