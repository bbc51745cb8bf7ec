"""Who asks for a write, for which compass of which vehicle: the refusals that come before the transaction."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from flight_rig import SpyLink
from magmav_sim import Simulation, parse_scenario
from magmav_sim.link import ROUTE, SimulatedLink
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scripted_vehicle import Vehicle
from test_kept import Bench
from test_store_format import SAVED, VERDICT
from test_upload_far import GROUND
from upload_rig import NAMES, OLD, Rig, a_change, refused

from magmav.cli import main
from magmav.core.types import Change, Reason, UploadResult
from magmav.link import Packet
from magmav.store import SavedEstimate, Store


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        ({"COMPASS_DEV_ID": 131874.0}, Reason.DEVICE_CHANGED),
        ({"COMPASS_DEV_ID": None}, Reason.UNKNOWN_PARAM),
    ],
)
def test_AT_6b_device_id_changed_or_missing_is_refused_and_nothing_written(
    spoil: dict[str, float | None], why: Reason
) -> None:
    rig = Rig()
    for name, value in spoil.items():
        if value is None:
            del rig.vehicle.params[name]
        else:
            rig.vehicle.params[name] = value
    refused(rig, why)
    refused(rig, why, undoes=7)


def test_AT_6b_device_id_that_two_compasses_have_is_refused_and_nothing_written(tmp_path: Path) -> None:
    vehicle = Vehicle()
    vehicle.params["COMPASS_DEV_ID2"] = vehicle.params["COMPASS_DEV_ID"]
    bench = Bench(tmp_path / "s.sqlite", vehicle)
    bench.run(12.0)
    bench.companion.start(a_change(), None, vehicle.now_ns)
    bench.run(0.1)
    ended = bench.companion.ended
    assert ended is not None and ended.result is UploadResult.REFUSED
    assert ended.reasons == (Reason.MAPPING_UNCLEAR,)
    assert tuple(vehicle.params[n] for n in NAMES) == OLD and bench.store.history() == []
    bench.store.close()


@pytest.mark.parametrize("command", ["upload", "restore"])
@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        ({"COMPASS_DEV_ID2": 97539.0}, "MAPPING_UNCLEAR"),
        ({"COMPASS_PRIO1_ID": 55.0}, "MAPPING_UNCLEAR"),  # of no slot
        # Another slot's device is streamed as compass 1; of that nothing was learnt, and nothing was written to it.
        ({"COMPASS_DEV_ID2": 131874.0, "COMPASS_PRIO1_ID": 131874.0, "COMPASS_PRIO2_ID": 97539.0}, "NO_"),
    ],
)
def test_S6_AT_6b_one_command_reads_whose_slot_is_whose_before_it_writes(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
    spoil: dict[str, float],
    why: str,
) -> None:
    """A command begins as soon as it knows enough: that is not before all device ids are known."""
    simulation = Simulation(parse_scenario(GROUND, "ground.toml"), 3)
    for name, value in spoil.items():
        simulation.autopilot.parameters.put(name, value)
    new = (-100.0, 50.0, -60.0)
    change = Change(1, 1, "COMPASS_DEV_ID", 97539, NAMES, (0.0,) * 3, new, new, (2.0,) * 3, tuple(map(abs, new)))
    path = tmp_path / "s.sqlite"
    with Store(path) as store:
        store.save_estimate(SavedEstimate(7, "1", change, VERDICT, SAVED.offsets_mg, SAVED.sigma_mg))
        if command == "restore":
            store.begin(change, 5, vehicle="1")  # cut short
    held = tuple(float(simulation.autopilot.parameters[name]) for name in NAMES)
    spy = SpyLink(SimulatedLink(simulation, until_s=90.0), simulation)
    spy.warning = ""  # type: ignore[attr-defined]
    monkeypatch.setattr("magmav.link.open.open_link", lambda text: spy)
    assert main([command, "udpin:127.0.0.1:0", "--store", str(path), "--json"]) == 1
    out = json.loads(capsys.readouterr().out)
    assert out["result"] == "REFUSED" and [r["code"][: len(why)] for r in out["reasons"]] == [why]
    reader = dialect.MAVLink(None)
    sent = {m.get_type() for one in spy.sent for m in (reader.parse_buffer(one.data) or [])}
    assert "PARAM_REQUEST_READ" in sent and "PARAM_SET" not in sent
    assert tuple(float(simulation.autopilot.parameters[name]) for name in NAMES) == held


@pytest.mark.parametrize("late_s", [0.0, 6.0])
@pytest.mark.parametrize("at_s", [1.0, 3.3, 3.6, 4.0, 5.0, 9.0])
def test_S6_AT_6b_a_way_back_asked_for_early_waits_until_all_device_ids_are_known(
    tmp_path: Path, at_s: float, late_s: float
) -> None:
    """Also where the answer that matters comes late: what was asked for before was lost."""
    vehicle = Vehicle()
    twice = {"COMPASS_DEV_ID2": vehicle.params["COMPASS_DEV_ID"]}
    vehicle.at.append((vehicle.now_ns + round(late_s * 1e9), lambda: vehicle.params.update(twice)))
    vehicle.params[NAMES[0]] = vehicle.applied[NAMES[0]] = a_change().new[0]
    held = tuple(vehicle.params[n] for n in NAMES)
    with Store(tmp_path / "s.sqlite") as store:
        store.begin(a_change(), 5)  # cut short by an earlier companion
    bench = Bench(tmp_path / "s.sqlite", vehicle)
    bench.run(at_s)
    bench.companion.request_restore(1, vehicle.now_ns)
    bench.run(20.0)
    assert not vehicle.sets and tuple(vehicle.params[n] for n in NAMES) == held
    assert any("REFUSED: not clear which stored" in text for text in bench.texts)
    bench.store.close()


def test_S6_a_vehicle_that_does_not_say_whose_slot_is_whose_is_not_written_to() -> None:
    rig = Rig()
    begin_ns = rig.vehicle.now_ns
    refused(rig, Reason.UNKNOWN_PARAM, mapped=lambda: False)
    assert rig.vehicle.now_ns - begin_ns <= 10.1e9
    rig = Rig()
    known_ns = rig.vehicle.now_ns + 4_000_000_000
    assert rig.go(mapped=lambda: rig.vehicle.now_ns >= known_ns).result is UploadResult.ALL_NEW
    assert rig.vehicle.sets[0][0] >= known_ns


def test_AT_4c_a_refused_write_does_not_end_the_wait_for_the_reboot_of_the_one_before(tmp_path: Path) -> None:
    vehicle = Vehicle()
    bench = Bench(tmp_path / "s.sqlite", vehicle)
    bench.run(12.0)
    bench.companion.start(a_change(), None, vehicle.now_ns)
    bench.run(16.0)
    assert bench.companion.ended is not None and bench.companion.ended.result is UploadResult.ALL_NEW
    bench.companion.start(a_change(), None, vehicle.now_ns)  # the old values are not there any more
    bench.run(14.0)
    assert bench.companion.ended.result is UploadResult.REFUSED
    bench.boot_ms = 3_000
    bench.run(20.0)
    assert any("PERSISTED" in text for text in bench.texts), bench.texts
    bench.store.close()


@pytest.mark.parametrize(("uid", "known"), [("00ff00ff", False), (None, True), ("", True)])
def test_S19_what_was_learnt_on_another_vehicle_is_not_uploaded_to_this_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], uid: str | None, known: bool
) -> None:
    """`magmav upload` on a vehicle of the same system id with the same compass device id, the same offsets even."""
    simulation = Simulation(parse_scenario(GROUND, "ground.toml"), 3)
    monkeypatch.setattr("magmav.link.open.open_link", lambda text: SimulatedLink(simulation, until_s=90.0))
    path = tmp_path / "s.sqlite"
    own = simulation.autopilot.uid.to_bytes(18, "little").rstrip(b"\0").hex() if uid is None else uid  # its uid2
    new = (-100.0, 50.0, -60.0)
    change = Change(1, 1, "COMPASS_DEV_ID", 97539, NAMES, (0.0,) * 3, new, new, (2.0,) * 3, tuple(map(abs, new)))
    vehicle = f"1 uid {own}" if own else "1"
    with Store(path) as store:
        store.save_estimate(SavedEstimate(7, vehicle, change, VERDICT, SAVED.offsets_mg, SAVED.sigma_mg))
    code = main(["upload", "udpin:127.0.0.1:0", "--store", str(path), "--json"])
    out = json.loads(capsys.readouterr().out)
    held = tuple(float(simulation.autopilot.parameters[name]) for name in NAMES)
    if known:
        assert (code, out["result"], held) == (0, "ALL_NEW", new)
    else:
        assert (code, out["result"], held) == (1, "REFUSED", (0.0, 0.0, 0.0))
        assert [r["code"] for r in out["reasons"]] == ["NO_CALIBRATION"]


class _Asked:
    """The simulated vehicle's link, over which a ground station sets one of our parameters every second."""

    def __init__(self, simulation: Simulation, until_s: float, name: bytes, value: float) -> None:
        self._link = SimulatedLink(simulation, until_s=until_s)
        self.name, self.datagrams, self.warning = self._link.name, self._link.datagrams, ""
        self.unix_offset_ns, self.counts = self._link.unix_offset_ns, self._link.counts
        ground = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
        self._frame = dialect.MAVLink_param_set_message(1, 191, name, value, 9).pack(ground)

    def packets(self) -> Iterator[Packet]:
        next_ns = 0
        for packet in self._link.packets():
            yield packet
            if packet.t_ns >= next_ns:
                next_ns = packet.t_ns + 1_000_000_000
                yield Packet(packet.t_ns, self._frame, ROUTE)

    def send(self, data: bytes, route: str = "") -> None:
        self._link.send(data, route)

    def close(self) -> None:
        self._link.close()


def test_what_was_chosen_in_flight_counts_for_upload_too_until_the_configuration_says_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`magmav run` is told by MMAG_CONF_ABOVE that 50 mG want a code; `magmav upload` of 100 mG then wants one."""
    simulation = Simulation(parse_scenario(GROUND, "ground.toml"), 3)
    path, mine = tmp_path / "s.sqlite", tmp_path / "mine.toml"
    new = (-100.0, 50.0, -60.0)
    change = Change(1, 1, "COMPASS_DEV_ID", 97539, NAMES, (0.0,) * 3, new, new, (2.0,) * 3, tuple(map(abs, new)))
    with Store(path) as store:
        store.save_estimate(SavedEstimate(7, "1", change, VERDICT, SAVED.offsets_mg, SAVED.sigma_mg))

    monkeypatch.setattr("magmav.link.many.open_links", lambda texts: _Asked(simulation, 20.0, b"MMAG_CONF_ABOVE", 50.0))
    assert main(["run", "udpin:127.0.0.1:0", "--store", str(path)]) == 0

    def told(command: str, *words: str) -> tuple[int, dict[str, Any]]:
        until_s = simulation.elapsed_ns / 1e9 + 90.0
        monkeypatch.setattr("magmav.link.open.open_link", lambda text: SimulatedLink(simulation, until_s=until_s))
        capsys.readouterr()
        code = main([command, "udpin:127.0.0.1:0", "--store", str(path), "--json", *words])
        return code, json.loads(capsys.readouterr().out)

    code, refused_ = told("upload")
    assert (code, refused_["result"]) == (1, "REFUSED")
    assert [r["code"] for r in refused_["reasons"]] == ["CONFIRM_CHANGE"]
    code, dry = told("upload", "--dry-run", "--system", "1")
    assert (code, dry["confirm_code"]) == (0, refused_["confirm_code"]) and dry["confirm_code"] is not None
    mine.write_text("[upload]\nconfirm_above_mg = 120.0\n")  # edited later: the latest word counts
    assert told("upload", "--config", str(mine), "--dry-run")[1]["confirm_code"] is None
    code, done = told("upload", "--confirm-change", str(dry["confirm_code"]))
    assert (code, done["result"], done["confirmed"]) == (0, "ALL_NEW", True)
    assert told("restore")[1]["result"] == "ALL_OLD"
