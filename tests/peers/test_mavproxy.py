"""MAVProxy 1.8.75: the plugin in its console on its own link, and its console against `magmav run` behind a router."""

from __future__ import annotations

import hashlib
import math
from contextlib import suppress
from datetime import UTC, datetime

import pytest
from flight_rig import LEVEL
from process_rig import free_port
from rig import magmav_words, peer, program, stage
from sim_rig import COMPASS, HEAD

from magmav.store import Store

pytestmark = pytest.mark.peers
GROUNDED = HEAD + "stay = true\n" + COMPASS
_OFFSETS = {"X": -180.0, "Y": 120.0, "Z": -240.0}  # against the iron of LEVEL, mG


def console(folder, *options):
    """MAVProxy's console without windows."""
    python = peer("wire-mavproxy")
    words = [python, python.with_name("mavproxy.py"), f"--state-basedir={folder}", "--aircraft=t"]
    return program([*words, "--default-modules=link,param,cmdlong,ftp", *options], folder)


def ask_until(mavproxy, line, pattern):
    """MAVProxy sends a PARAM_SET in its own time: ask again until the answer is the new one."""
    for _ in range(20):
        mavproxy.say(line)
        with suppress(AssertionError):
            return mavproxy.expect(pattern, within_s=1.0)
    raise AssertionError("\n".join([f"never {pattern!r} in", *mavproxy.lines[-40:]]))


def test_the_plugin_learns_uploads_and_restores_from_mavproxys_console(tmp_path):
    (scenario := tmp_path / "staying.toml").write_text(LEVEL.format(seed=32))
    port = free_port()
    with console(tmp_path, f"--master=udpin:127.0.0.1:{port}", "--load-module=magmav.mavproxy") as mavproxy:
        mavproxy.expect("Loaded module magmav.mavproxy")
        mavproxy.expect("magmav: at work")
        mavproxy.say("magmav status")
        mavproxy.expect("magmav: no vehicle yet")
        mavproxy.say("module load magmav.mavproxy")
        mavproxy.expect("already loaded")
        with program(magmav_words("sim", scenario, "--to", f"udpout:127.0.0.1:{port}", "--speed", 8), tmp_path):
            mavproxy.expect("magmav: compass 1 of system 1: ready")
            mavproxy.expect("DISARMED")
            ask_until(mavproxy, "magmav status", "magmav: system 1, ArduPilot, disarmed, mavproxy:1")
            mavproxy.say("magmav upload 9")
            mavproxy.expect("magmav: upload: compass: want a whole number from 1 to 3, got '9'")
            mavproxy.say("magmav upload")
            code = mavproxy.expect(r"magmav upload 1 --confirm-change (\d+)").group(1)
            mavproxy.say(f"magmav upload 1 --confirm-change {code}")
            mavproxy.expect("magmav: compass 1: upload begun")
            mavproxy.expect("magmav: compass 1: ALL_NEW")
            for axis, value in _OFFSETS.items():
                # MAVProxy's own view of the vehicle: it heard the PARAM_VALUEs as we did.
                mavproxy.say(f"param show COMPASS_OFS_{axis}")
                shown = float(mavproxy.expect(rf"COMPASS_OFS_{axis} +(-?[\d.]+)").group(1))
                assert shown == pytest.approx(value, abs=20.0)
            mavproxy.say("magmav restore")
            mavproxy.expect("magmav: compass 1: ALL_OLD")
            mavproxy.say("param show COMPASS_OFS_X")
            assert float(mavproxy.expect(r"COMPASS_OFS_X +(-?[\d.]+)").group(1)) == 0.0
            mavproxy.say("magmav history")
            mavproxy.expect("magmav: 2: .*undo of 1 ALL_OLD")
            mavproxy.say("module unload magmav.mavproxy")
            mavproxy.expect("Unloaded module magmav.mavproxy")
            mavproxy.say("magmav status")
            mavproxy.expect("Unknown command")
        mavproxy.end()
    with Store(tmp_path / "magmav" / "magmav.sqlite") as store:
        assert [row.result.name for row in store.history()] == ["ALL_OLD", "ALL_NEW"]


def test_mavproxy_fetches_sets_and_saves_our_parameters_and_sets_an_offset(tmp_path):
    with (
        stage(tmp_path, GROUNDED) as hub,
        console(tmp_path, f"--master=udpout:127.0.0.1:{hub.port}", "--streamrate=-1") as mavproxy,
    ):
        mavproxy.expect_all("Detected vehicle 1:1 ", "Detected vehicle 1:191 ")
        # The vehicle first. FTP off: the simulated autopilot has no files and MAVProxy would wait for them.
        mavproxy.say("set param_ftp False")
        mavproxy.say("vehicle 1:1")
        mavproxy.say("param fetch")
        mavproxy.expect(r"Received \d+ parameters")
        mavproxy.say("param set COMPASS_OFS_X 42.5")
        ask_until(mavproxy, "param fetch COMPASS_OFS_X", r"COMPASS_OFS_X = 42\.5")
        # Ours, with FTP on again: what answers there must not keep MAVProxy from the list.
        mavproxy.say("set param_ftp True")
        mavproxy.say("vehicle 1:191")
        mavproxy.say("param fetch")
        count = int(mavproxy.expect(r"Received (\d+) parameters", within_s=30.0).group(1))
        mavproxy.say("param set MMAG_LEARN 0")
        ask_until(mavproxy, "param fetch MMAG_LEARN", r"MMAG_LEARN = 0\.0")
        mavproxy.say("param save out.parm")
        mavproxy.expect(r"Saved \d+ parameters to out.parm")
        mavproxy.end()
    saved = dict(line.split()[:2] for line in (tmp_path / "out.parm").read_text().splitlines() if line[:1] != "#")
    ours = {name: float(value) for name, value in saved.items() if name.startswith("MMAG_")}
    assert ours["MMAG_LEARN"] == 0.0
    assert ours["MMAG_UPLOAD"] == 0.0
    assert count >= 30
    assert len(ours) == count
    assert math.isnan(ours["MMAG_HDG_T"])  # nothing was learnt on the ground; MAVProxy saves that as it is


@pytest.mark.parametrize("keyed", [True, False])
def test_the_plugin_on_a_link_that_mavproxy_signs_is_believed_and_without_the_key_only_listens(tmp_path, keyed):
    key = hashlib.sha256(b"aviary").hexdigest()  # as MAVProxy makes it of the word
    # Timestamps over a minute behind MAVProxy's are no good signature: the vehicle has the day's time.
    now = GROUNDED.replace("2026-11-22T10:00:00Z", f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}")
    (scenario := tmp_path / "signed.toml").write_text(now + f'[[fault]]\nkind = "signed"\nkey = "{key}"\n')
    port = free_port()
    options = (f"--master=udpin:127.0.0.1:{port}", "--load-module=signing,magmav.mavproxy")
    with console(tmp_path, *options) as mavproxy:
        mavproxy.expect("magmav: at work")
        if keyed:
            mavproxy.say("signing key aviary")
            mavproxy.expect("Setup signing key")
        with program(magmav_words("sim", scenario, "--to", f"udpout:127.0.0.1:{port}"), tmp_path):
            ask_until(mavproxy, "magmav status", "magmav: system 1, ArduPilot, disarmed, mavproxy:1")
            if keyed:
                # It was asked for RAW_IMU, and for the offsets, by messages it believed.
                ask_until(mavproxy, "magmav status", "magmav: compass 1 of system 1: learning")
                ask_until(mavproxy, "magmav upload --dry-run", "magmav: (compass 1: nothing to write|.*HEARTBEAT)")
            else:
                ask_until(mavproxy, "magmav status", "magmav: LINK_SIGNED_READ_ONLY")
                mavproxy.say("magmav upload")
                mavproxy.expect("magmav: refused: the vehicle signs")
        mavproxy.end()


@pytest.mark.long
def test_the_plugin_names_a_second_vehicle_and_follows_mavproxys_vehicle_command(tmp_path):
    port = free_port()
    words = []
    for system in (1, 2):
        (where := tmp_path / f"{system}.toml").write_text(GROUNDED + f"[autopilot]\nsystem = {system}\n")
        words.append(magmav_words("sim", where, "--to", f"udpout:127.0.0.1:{port}"))
    with console(tmp_path, f"--master=udpin:127.0.0.1:{port}", "--load-module=magmav.mavproxy") as mavproxy:
        mavproxy.expect("magmav: at work")
        with program(words[0], tmp_path):
            ask_until(mavproxy, "magmav status", "magmav: system 1, ArduPilot")
            with program(words[1], tmp_path):
                mavproxy.expect("magmav: also heard: system 2; only system 1 is served here")
                mavproxy.say("vehicle 2")
                mavproxy.expect("magmav: system 2 is served from here on; learning begins anew")
                ask_until(mavproxy, "magmav status", "magmav: system 2, ArduPilot, disarmed, mavproxy:1")
                ask_until(mavproxy, "magmav status", "magmav: compass 1 of system 2")
        mavproxy.end()
