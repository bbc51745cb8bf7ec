"""Whole programs against each other over real UDP on ephemeral ports, and what they leave behind: nothing."""

from __future__ import annotations

import json
import subprocess
import time

import pytest
from flight_rig import IRON_MG, LEVEL
from process_rig import environment, free_port, magmav, started, stopped

_ZERO = {"COMPASS_OFS_X": 0.0, "COMPASS_OFS_Y": 0.0, "COMPASS_OFS_Z": 0.0}


def lines(text):
    return [json.loads(line) for line in text.splitlines()]


def field_day(folder):
    """One vehicle that flies once and then stays on the ground, and one command after the other on its port."""
    (scenario := folder / "staying.toml").write_text(LEVEL.format(seed=32))
    port, day = free_port(), {}
    link, store = f"udpin:127.0.0.1:{port}", ["--store", folder / "magmav.sqlite", "--json"]
    with started("sim", scenario, "--to", f"udpout:127.0.0.1:{port}", "--speed", "10"):
        with started("run", link, *store) as run:
            day["run"] = until_landed_and_ready(run)
            day["taken"] = magmav("run", link, "--store", folder / "other.sqlite", "--json", "--for", 1)
            day["stopped"] = stopped(run)
        for name, words in {
            "dry": ["upload", link, *store, "--dry-run"],
            "bare": ["upload", link, *store, "--system", 1],
        }.items():
            day[name] = magmav(*words)
        code = day["dry"].json["confirm_code"]
        store += ["--system", 1]  # named, it need not be waited for whether there are others
        day["wrong"] = magmav("upload", link, *store, "--confirm-change", 1 + code % 9999)
        day["upload"] = magmav("upload", link, *store, "--confirm-change", code)
        day["again"] = magmav("upload", link, *store, "--confirm-change", code)
        day["restore"] = magmav("restore", link, *store)
        day["restore again"] = magmav("restore", link, *store)
    day["history"] = magmav("history", *store[:3])
    return day


def until_landed_and_ready(run):
    """Lines of `magmav run` until compass 1 is ready and the vehicle has stood still in heading for a while."""
    seen, begun = [], time.monotonic()
    while time.monotonic() - begun < 300.0:
        seen.append(json.loads(run.stdout.readline()))
        recent = [r for r in seen[-3:] if r["state"] == "READY"]
        if len(recent) == 3 and seen[-1]["boot_s"] > 80.0 and recent[0]["offsets_mg"] == seen[-1]["offsets_mg"]:
            return seen
    raise AssertionError(f"not ready and landed in time: {seen[-1]}")


def run_reports_as_it_learns_and_ends_well_on_sigterm(day):
    rows = day["run"]
    assert {r["system"] for r in rows} == {1} and {r["compass"] for r in rows} == {1}
    times = [r["boot_s"] for r in rows]
    assert times == sorted(times) and len(times) > 5
    last = rows[-1]
    off = [abs(o + t) for o, t in zip(last["offsets_mg"], IRON_MG, strict=True)]
    assert all(o <= 3.5 * s for o, s in zip(off, last["sigma_mg"], strict=True))
    assert last["device_id"] == 97539
    done = day["stopped"]
    assert done.code == 0
    assert all(r["state"] for r in lines(done.out)) and "Traceback" not in done.err


def port_that_a_service_holds_is_exit_4(day):
    assert day["taken"].code == 4 == day["taken"].json["error"]["code"]


def dry_run_shows_every_message_and_writes_nothing(day):
    done = day["dry"]
    assert done.code == 0
    shown = done.json
    assert shown["dry_run"] is True and shown["result"] is None and shown["old"] == _ZERO
    writes = [m for m in shown["messages"] if m.startswith("PARAM_SET")]
    assert [m.split()[1] for m in writes] == list(_ZERO)
    assert 1000 <= shown["confirm_code"] <= 9999
    assert day["bare"].json["old"] == _ZERO  # and still so afterwards


def upload_without_or_with_a_wrong_code_is_refused(day):
    for name in ("bare", "wrong"):
        done = day[name]
        assert done.code == 1
        assert done.json["result"] == "REFUSED"
        assert [r["code"] for r in done.json["reasons"]] == ["CONFIRM_CHANGE"]


def upload_with_the_code_is_all_new_and_right(day):
    done = day["upload"]
    assert done.code == 0 and done.json["result"] == "ALL_NEW" and done.json["confirmed"]
    assert done.json["new"] == day["dry"].json["new"]
    assert all(abs(new + true) <= 20.0 for new, true in zip(done.json["new"].values(), IRON_MG, strict=True))


def a_second_upload_of_the_same_is_refused(day):
    done = day["again"]
    assert done.code == 1 and done.json["result"] == "REFUSED"
    assert {r["code"] for r in done.json["reasons"]} & {"NOTHING_TO_DO", "OFFSETS_CHANGED"}


def restore_is_all_old_and_only_once(day):
    done = day["restore"]
    assert done.code == 0 and done.json["result"] == "ALL_OLD" and done.json["old"] == _ZERO
    again = day["restore again"]
    assert again.code == 1 and [r["code"] for r in again.json["reasons"]] == ["NO_SNAPSHOT"]


def history_tells_both_writes(day):
    assert day["history"].code == 0
    undo, upload = day["history"].json["writes"]
    assert (upload["action"], upload["result"], upload["undone"]) == ("upload", "ALL_NEW", True)
    assert (undo["action"], undo["result"]) == (f"undo of {upload['id']}", "ALL_OLD")
    assert upload["old"] == _ZERO and upload["new"] == day["dry"].json["new"]


@pytest.mark.long
def test_a_day_in_the_field(tmp_path):
    """One test, not one for each check, because the day takes half a minute and workers share nothing."""
    day = field_day(tmp_path)
    for check in (
        run_reports_as_it_learns_and_ends_well_on_sigterm,
        port_that_a_service_holds_is_exit_4,
        dry_run_shows_every_message_and_writes_nothing,
        upload_without_or_with_a_wrong_code_is_refused,
        upload_with_the_code_is_all_new_and_right,
        a_second_upload_of_the_same_is_refused,
        restore_is_all_old_and_only_once,
        history_tells_both_writes,
    ):
        check(day)


def ours(mark):
    """Command lines of processes that carry the mark in their environment or arguments."""
    shown = subprocess.run(["ps", "eww", "-A", "-o", "pid=,args="], capture_output=True, text=True, check=True)
    return [line for line in shown.stdout.splitlines() if mark in line and "ps eww" not in line]


def test_demo_improves_the_heading_proves_it_and_leaves_nothing(tmp_path):
    (empty := tmp_path / "cwd").mkdir()
    (scratch := tmp_path / "scratch").mkdir()
    done = magmav("demo", "--json", cwd=empty, env=environment(scratch))
    result = done.json
    assert done.code == 0
    assert result["before"]["heading_rms_deg"] > 20.0
    assert result["after"]["heading_rms_deg"] <= 2.0
    assert result["upload"] == {"result": "ALL_NEW", "confirmed_by_code": True}
    assert result["restore"]["result"] == "ALL_OLD"
    assert result["wall_s"] < 60.0
    assert result["reference"] == "simulated truth"
    assert len(result["compasses"]) == 2
    for compass in result["compasses"]:
        true = compass["true_offsets_mg"]
        assert (true[0] ** 2 + true[1] ** 2) ** 0.5 >= 150.0 and sum(v * v for v in true) ** 0.5 > 250.0
        assert max(map(abs, compass["offset_error_mg"])) <= 20.0
    assert list(empty.iterdir()) == [] and list(scratch.iterdir()) == []
    assert ours(str(scratch)) == []
