"""When a change of offsets is claimed, and when it must not be."""

from __future__ import annotations

import json
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magmav.fitting.trend import table, trend, why_not
from magmav.view.many import many_csv, many_html, many_view, said
from magmav.view.table import to_text


def row(day: int, offsets: Any, sigma: Any = (2.0, 2.0, 5.0), **other: Any) -> dict[str, Any]:
    """A flight's row of one compass."""
    made = {
        "date": f"2026-11-{day:02d}T10:00:00Z", "path": f"{day}.bin", "sha256": f"{day:064x}", "kind": "dataflash",
        "system": 1, "autopilot": 3, "compass": 1, "device_id": 97539, "flights": 1, "state": "READY", "reasons": [],
        "causes": [], "relative": False, "old_offsets_mg": [0.0, 0.0, 0.0],
        "new_offsets_mg": [float(v) for v in offsets],
        "change_mg": [float(v) for v in offsets], "sigma_mg": [float(v) for v in sigma], "axes": ["OBSERVED"] * 3,
        "heading_reference": "ATT yaw", "heading_before_rms_deg": 20.0, "heading_after_rms_deg": 2.0,
        "heading_held_out_rms_deg": 2.5, "heading_n": 900,
    } | other  # fmt: skip
    return made | {"counts": why_not(made) is None, "why_not": why_not(made)}


def test_a_change_is_claimed_beyond_the_two_sigmas_of_both_and_not_within() -> None:
    """2 (2 + 3) = 10 mG on x."""
    still = [row(1, (50, 0, 0)), row(2, (59.9, 0, 0), (3, 2, 5))]
    moved = [row(1, (50, 0, 0)), row(2, (60.1, 0, 0), (3, 2, 5))]
    assert trend(still)["changes"] == []
    (change,) = trend(moved)["changes"]
    assert (change["axis"], change["after"]["path"], change["found_in"]["path"]) == ("x", "1.bin", "2.bin")
    assert (change["from_mg"], change["to_mg"], change["by_mg"], change["limit_mg"]) == (50.0, 60.1, 10.1, 10.0)


def test_a_step_is_found_at_its_flight_on_its_axis_and_nowhere_else() -> None:
    chance = np.random.default_rng(4)
    rows = [
        row(d, np.array([100.0, -40.0, 230.0 if d <= 12 else 290.0]) + chance.normal(0, (2, 2, 5)))
        for d in range(1, 25)
    ]
    (change,) = trend(rows)["changes"]
    assert (change["axis"], change["after"]["path"], change["found_in"]["path"]) == ("z", "12.bin", "13.bin")
    assert change["by_mg"] == pytest.approx(60.0, abs=15.0)


def test_honest_scatter_is_rarely_called_a_change() -> None:
    """Two sigmas of each of two flights are 2.83 of their difference: 0.47 %; against a longer mean it is rarer."""
    chance, pairs = np.random.default_rng(5), 3000
    claims = sum(len(trend([row(d, chance.normal(0.0, (2, 2, 5))) for d in (1, 2)])["changes"]) for _ in range(pairs))
    assert 0.0027 < claims / (3 * pairs) < 0.0067  # three of its own sigmas to either side
    long = [trend([row(d, chance.normal(0.0, (2, 2, 5))) for d in range(1, 21)])["changes"] for _ in range(100)]
    assert sum(map(len, long)) / (100 * 19 * 3) < 0.002


def test_a_drift_is_claimed_beyond_three_of_its_sigmas() -> None:
    drifting = trend([row(d, (3.5 * d, 3.0 * d, 0), (10, 10, 10)) for d in range(1, 11)])
    assert drifting["changes"] == [] and drifting["drift"]["x"]["mg_per_flight"] == pytest.approx(3.5)
    assert drifting["drift"]["x"]["claimed"] and not drifting["drift"]["y"]["claimed"]
    sigma = 10.0 / np.sqrt(sum((d - 5.5) ** 2 for d in range(1, 11)))
    assert drifting["drift"]["x"]["sigma_mg_per_flight"] == pytest.approx(sigma, abs=1e-4)
    assert trend([row(1, (0, 0, 0)), row(2, (1, 0, 0))])["drift"] == {"x": None, "y": None, "z": None}


def test_what_is_not_ready_dated_absolute_and_observed_claims_nothing() -> None:
    base = [row(1, (0, 0, 0)), row(2, (0, 0, 0))]
    for other in ({"state": "LEARNING"}, {"state": "REFUSED"}, {"date": None}, {"relative": True}):
        far = row(3, (500, 500, 500), **other)
        (compass,) = table([*base, far])[0]["compasses"]
        assert compass["changes"] == [] and not far["counts"] and far["why_not"]
        assert f"3.bin does not count: {far['why_not']}" in said(compass), "it is in the table, and says why"
    unseen = row(3, (500, 0, 500), axes=["NOT_OBSERVED", "OBSERVED", "FROM_MODEL"])
    assert [change["axis"] for change in trend([*base, unseen])["changes"]] == ["z"]


def test_rows_go_by_vehicle_and_device_and_not_by_the_compass_number() -> None:
    rows = [
        row(1, (0, 0, 0)), row(2, (0, 0, 0), compass=2), row(3, (90, 0, 0), device_id=5), row(4, (90, 0, 0), system=7),
        row(5, (0, 0, 0), device_id=None), row(6, (90, 0, 0), device_id=None, compass=3),
    ]  # fmt: skip
    got = table(rows)
    assert [(v["system"], [(c["device_id"], c["compass"]) for c in v["compasses"]]) for v in got] == [
        (1, [(5, [1]), (97539, [1, 2]), (None, [1]), (None, [3])]), (7, [(97539, [1])]),
    ]  # fmt: skip
    assert all(c["changes"] == [] for v in got for c in v["compasses"])


def test_the_order_of_rows_changes_nothing() -> None:
    rows = [row(1, (0, 0, 0)), row(1, (50, 0, 0), sha256="f" * 64), row(2, (0, 0, 0)), row(3, (9, 9, 9), date=None)]
    assert len({json.dumps(table(order)) for order in permutations(rows)}) == 1


def document(rows: list[dict[str, Any]], errors: list[Any] = []) -> dict[str, Any]:  # noqa: B006  never changed
    return {
        "logs": len(rows), "rule": "r", "vehicles": table(rows), "errors": errors, "same_content": [],
        "made_by": {"magmav": "0", "at": None},
    }  # fmt: skip


@settings(max_examples=30, deadline=None)
@given(name=st.text(min_size=1, max_size=30))
def test_whatever_a_file_is_called_the_table_stays_whole(name: str) -> None:
    made = document([row(1, (0, 0, 0), path=name), row(2, (90, 0, 0))], [{"path": name, "code": 3, "text": name}])
    page = many_html(made)
    assert page.count("<tr") == 3 and page.count("<svg") == 1 and page.count("</body>") == 1
    assert "\x1b" not in to_text(many_view(made)) or "\x1b" in page
    import csv
    import io

    read = list(csv.reader(io.StringIO(many_csv(made), newline="")))
    assert len(read) == 3 and len({len(line) for line in read}) == 1
    shown = "".join(c if c.isprintable() else "?" for c in name)
    assert read[1][5] in (shown, f"'{shown}") and read[1][5][:1] not in ("=", "+", "-", "@")


def test_unknown_numbers_are_empty_in_csv_and_a_dash_on_the_page() -> None:
    made = document([row(1, (0, 0, 0), old_offsets_mg=None, heading_reference=None, heading_before_rms_deg=None)])
    head, line = (text.split(",") for text in many_csv(made).splitlines())
    held = dict(zip(head, line, strict=True))
    assert held["old_offsets_x_mg"] == held["heading_before_rms_deg"] == "" and held["new_offsets_x_mg"] == "0.0"
    assert "<td>-</td>" in many_html(made)
