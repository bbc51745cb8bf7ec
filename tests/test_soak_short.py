"""The soaks, short: AT-8a with 50 seeds and S1 with 500 timings. `make soak` runs 1000 and 10 000 of the same."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from pymavlink.dialects.v20 import ardupilotmega as dialect
from scripted_vehicle import S, Vehicle
from soak_rig import Witness
from soak_upload import TIMINGS_EACH, armings, bad_weather

from magmav.mavlink.codec import Codec


@pytest.mark.parametrize("first", (0, 25))
def test_AT_8a_loss_delay_and_disorder_leave_one_of_the_two_sets(first: int) -> None:
    ends = [bad_weather(seed) for seed in range(first, first + 25)]
    assert [e for e in ends if e.wrong] == []
    assert {e.end for e in ends} <= {"ALL_NEW", "ALL_OLD", "REFUSED", "PENDING_RESTORE"}
    assert max(e.latency_s for e in ends) > 1.5
    assert sum(e.end == "ALL_NEW" for e in ends) >= 20, "the weather is no excuse for refusing nearly always"


@pytest.mark.parametrize("first", range(0, 50, 10))
def test_S1_no_write_is_sent_after_the_arming_was_heard(first: int) -> None:
    timings = [t for batch in range(first, first + 10) for t in armings(batch)]
    assert len(timings) == 10 * TIMINGS_EACH
    assert sum(t.after_armed for t in timings) == 0
    assert [t for t in timings if t.wrong] == []
    assert {t.end for t in timings} == {"ALL_NEW", "ALL_OLD", "REFUSED", "PENDING_RESTORE"}, "every end is reached"
    assert sum(t.landed_armed for t in timings) > 20, "the arming comes between the writes"


@pytest.mark.parametrize(
    ("armed", "age_s", "counted"), [(True, 0.1, (1, 0)), (False, 1.3, (0, 1)), (False, 1.1, (0, 0))]
)
def test_S1_the_witness_sees_what_must_not_be(armed: bool, age_s: float, counted: tuple[int, int]) -> None:
    """A count of zero means something only where the counter counts."""
    vehicle = Vehicle()
    witness = Witness(vehicle)
    witness.hears(vehicle.heartbeat(armed), vehicle.now_ns)
    write = dialect.MAVLink_param_set_message(1, 1, b"COMPASS_OFS_X", 1.0, 9)
    witness.sees(Codec().encode(write, 1, 191), vehicle.now_ns + round(age_s * S))
    assert (witness.sets, witness.after_armed, witness.stale) == (1, *counted)
