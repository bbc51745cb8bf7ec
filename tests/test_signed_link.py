"""A signed link through the whole service: without the key only listening, with it everything, and no listener."""

from __future__ import annotations

import hashlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from fleet_rig import Airspace, Craft, ground
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Reason
from magmav.live import NoVehicle, transact
from magmav.mavlink.signing import Signing, StampFile

KEY = hashlib.sha256(b"a signed link").digest()
OTHER = hashlib.sha256(b"another key").digest()


def kinds(messages: list) -> Counter[str]:
    return Counter(m.get_type() for m in messages)


def signer(key: bytes = KEY, file: StampFile | None = None) -> Signing:
    return Signing(key, 191, file)


def test_AT_9d_a_signed_link_without_a_key_is_read_only_within_ten_seconds_and_asks_for_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    craft = Craft(1, "udp:1", key=KEY)
    sky = Airspace(tmp_path, craft)
    sky.run(10.0)
    member = sky.fleet.members[1]
    assert member.sealed and "LINK_SIGNED_READ_ONLY" in caplog.text
    assert sum("LINK_SIGNED_READ_ONLY" in m.text for m in craft.heard if m.get_type() == "STATUSTEXT") == 1
    sky.run(120.0)
    sent = kinds(sky.link.sent["udp:1"])
    assert set(sent) <= {"HEARTBEAT", "STATUSTEXT", "NAMED_VALUE_FLOAT", "PARAM_VALUE"}, "nothing meant for it"
    assert 125 <= sent["HEARTBEAT"] <= 132 and sent["STATUSTEXT"] <= 6, "no endless retries"
    for trigger in ("MMAG_UPLOAD", "MMAG_RESTORE"):
        sky.push(ground(dialect.MAVLink_param_set_message(1, 191, trigger.encode(), 1.0, 9)), "udp:1")
        assert member.refusal is Reason.LINK_SIGNED_READ_ONLY and member.job is None
        assert member.result == -64.0
    sky.service.leave()
    assert kinds(sky.link.sent["udp:1"])["COMMAND_LONG"] == 0, "nothing was borrowed, nothing is given back"
    assert sky.records, "it goes on listening"


def test_AT_9d_it_ends_when_the_vehicle_no_longer_signs(tmp_path: Path) -> None:
    craft = Craft(1, "udp:1", key=KEY)
    sky = Airspace(tmp_path, craft)
    sky.run(10.0)
    craft.mav.signing.sign_outgoing = False
    sky.run(10.0)
    assert not sky.fleet.members[1].sealed
    assert kinds(craft.heard)["PARAM_REQUEST_READ"] > 20
    assert sky.service.pipeline.vehicles[1].calibrations.known(1)


def test_AT_9d_one_upload_command_without_a_key_is_refused_by_name(tmp_path: Path) -> None:
    sky = Airspace(tmp_path, Craft(1, "udp:1", key=KEY), single=True)
    sky.run(5.0)
    from magmav.link import Packet

    sky.link.packets = lambda: iter([Packet(sky.now_ns, b"", "")])
    result = transact(
        sky.session, sky.link, 1, lambda device: Reason.NO_CALIBRATION, confirm=None, dry=False, wait_s=5.0,
        progress=lambda text: None,
    )  # fmt: skip
    assert result["result"] == "REFUSED" and [r["code"] for r in result["reasons"]] == ["LINK_SIGNED_READ_ONLY"]
    assert not {"PARAM_SET", "PARAM_REQUEST_READ", "COMMAND_LONG"} & set(kinds(sky.link.sent["udp:1"]))


def test_with_the_key_the_vehicle_is_read_and_every_frame_of_ours_is_signed(tmp_path: Path) -> None:
    craft = Craft(1, "udp:1", key=KEY)
    sky = Airspace(tmp_path, craft, signer=signer())
    sky.run(15.0)
    assert sky.service.pipeline.vehicles[1].calibrations.known(1) and not sky.fleet.members[1].sealed
    judge = dialect.MAVLink(None)  # as the vehicle would: pymavlink's own check, unsigned refused
    judge.signing.secret_key = KEY
    judge.robust_parsing = True
    raw = sky.link.raw["udp:1"]
    got = [m for data in raw for m in judge.parse_buffer(data) or []]
    assert len(got) == len(raw) > 40 and all(m.get_signed() for m in got)
    assert sky.service.counts()["signing"]["signed"] > 150


def test_S17_with_a_key_the_unsigned_and_the_wrongly_signed_vehicle_are_not_heard(tmp_path: Path) -> None:
    plain, wrong = Craft(1, "udp:1"), Craft(2, "udp:2", key=OTHER)
    sky = Airspace(tmp_path, plain, wrong, signer=signer())
    sky.run(10.0)
    assert sky.fleet.members == {} and sky.records == [] and sky.service.pipeline.vehicles == {}
    counts = sky.service.counts()["signing"]
    assert counts["unsigned"] > 100 and counts["bad signature"] > 100
    lone = Airspace(tmp_path / "lone", plain, single=True, signer=signer())
    lone.run(3.0)
    from magmav.link import Packet

    late = [Packet(lone.now_ns + n * 10**9, b"", "") for n in range(30)]
    lone.link.packets = lambda: iter(late)
    with pytest.raises(NoVehicle, match="none signed with this key"):
        transact(
            lone.session, lone.link, 1, lambda d: Reason.NO_CALIBRATION, confirm=None, dry=False, wait_s=5.0,
            progress=lambda text: None,
        )  # fmt: skip


def test_a_spoofer_without_the_key_changes_nothing_even_on_the_vehicles_own_route(tmp_path: Path) -> None:
    craft, liar = Craft(1, "udp:1", key=KEY), Craft(1, "udp:1", key=OTHER)
    sky = Airspace(tmp_path, craft, signer=signer())
    sky.run(8.0)
    held = dict(sky.service.pipeline.vehicles[1].calibrations._held)
    for _ in range(20):
        sky.push(liar.heartbeat(True), "udp:1")
        sky.push(liar.param("COMPASS_OFS_X", 500.0), "udp:1")
        sky.push(ground(dialect.MAVLink_param_set_message(1, 191, b"MMAG_UPLOAD", 1.0, 9)), "udp:1")
        sky.run(0.5)
    member = sky.fleet.members[1]
    assert not member.presence.autopilot.armed and member.refusal is None and member.result == 0.0
    assert dict(sky.service.pipeline.vehicles[1].calibrations._held) == held


def test_a_recorded_session_played_back_is_not_believed(tmp_path: Path) -> None:
    craft = Craft(1, "udp:1", key=KEY)
    sky = Airspace(tmp_path, craft, signer=signer())
    taped: list[bytes] = []
    push = sky.push
    sky.push = lambda data, route: (taped.append(data), push(data, route))
    sky.run(5.0)
    sky.push = push
    count = len(sky.records)
    for frame in taped:
        sky.push(frame, "udp:1")
    assert len(sky.records) == count
    assert sky.service.counts()["signing"]["replayed"] == len(taped) > 50


def test_timestamps_are_kept_when_the_service_ends(tmp_path: Path) -> None:
    file = StampFile(tmp_path / "signing-191.json")
    craft = Craft(1, "udp:1", key=KEY)
    sky = Airspace(tmp_path, craft, signer=signer(file=file))
    sky.run(5.0)
    sky.service.leave()
    bound, streams = file.load()
    sent = [int.from_bytes(raw[-12:-6], "little") for raw in sky.link.raw["udp:1"]]
    assert bound == max(sent) and streams == {(1, 1, 0): craft.mav.signing.timestamp - 1}
    assert sent == sorted(set(sent))


# ------------------------------------------------------------ as a process


def listening(pid: int) -> list[str]:
    """Local addresses of this process's listening TCP sockets, as the kernel tells."""
    inodes = set()
    for fd in Path(f"/proc/{pid}/fd").iterdir():
        try:
            inodes.add(os.readlink(fd))
        except OSError:
            continue
    out = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and f"socket:[{words[9]}]" in inodes:
                out.append(words[1])
    return out


class Run:
    """`magmav run` as a process, until ``stop``."""

    def __init__(self, *words: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "magmav.cli", "run", *words],
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.said = ""
        while "listening on" not in self.said:
            line = self.process.stderr.readline()
            assert line, self.said
            self.said += line

    def __enter__(self) -> Run:
        return self

    def __exit__(self, *why: object) -> None:
        with self.process:
            self.process.kill()

    def stop(self) -> str:
        self.process.send_signal(signal.SIGTERM)
        out, err = self.process.communicate(timeout=20)
        return self.said + out + err


needs_proc = pytest.mark.skipif(not Path("/proc/self/net/tcp").exists(), reason="reads the kernel's socket tables")


@needs_proc
def test_S16_nothing_listens_on_tcp_and_udp_stays_on_loopback(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)):
        assert len(listening(os.getpid())) >= 1, "the test would see one"
    with Run("udpin::0", "udpin:127.0.0.1:0", "--store", str(tmp_path / "m.sqlite")) as run:
        assert listening(run.process.pid) == []
        inodes = {os.readlink(fd) for fd in Path(f"/proc/{run.process.pid}/fd").iterdir()}
        rows = [r.split() for r in Path(f"/proc/{run.process.pid}/net/udp").read_text().splitlines()[1:]]
        bound = [r[1] for r in rows if f"socket:[{r[9]}]" in inodes]
        assert len(bound) == 2 and all(b.startswith("0100007F:") for b in bound)
        said = run.stop()
    assert run.process.returncode == 0, said


def test_S17_run_with_a_key_file_writes_the_key_nowhere(tmp_path: Path) -> None:
    """Everything it says and keeps is searched, at the most talkative; one vehicle signs, one does not."""
    key = tmp_path / "key"
    key.write_bytes(KEY.hex().encode())
    key.chmod(0o644)
    kept = tmp_path / "state"
    kept.mkdir()
    words = (
        "udpin:127.0.0.1:0", "--key-file", str(key), "-v", "--store", str(kept / "m.sqlite"),
        "--record", str(kept / "day.tlog"), "--records", str(kept / "records.jsonl"),
    )  # fmt: skip
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock, Run(*words) as run:
        sock.bind(("127.0.0.1", 0))
        port = int(run.said.rpartition("(port ")[2].partition(")")[0])
        craft, plain = Craft(1, "", key=KEY), Craft(2, "")
        craft.mav.signing.timestamp = (time.time_ns() - 1_420_070_400 * 10**9) // 10_000
        setup = dialect.MAVLink_setup_signing_message(1, 1, list(KEY), 5)
        for n in range(30):
            for data in (*craft.talk(n * 1000), craft.pack(setup), *plain.talk(n * 1000)):
                sock.sendto(data, ("127.0.0.1", port))
            time.sleep(0.02)
        sock.settimeout(5.0)
        answer = sock.recv(2048)
        said = run.stop()
    assert run.process.returncode == 0, said
    assert "chmod 600" in said and "unsigned" in said and "vehicle 1 is heard" in said and "vehicle 2" not in said
    assert answer[2] == 1, "and what it sent is signed"
    files = {p.name: p.read_bytes() for p in kept.iterdir()}
    assert "signing-191.json" in files and len(files["day.tlog"]) > 1000
    for where, data in (*files.items(), ("said", said.encode())):
        for form in (KEY, KEY.hex().encode(), str(list(KEY)).encode(), repr(KEY).encode()):
            assert form not in data, where


def test_a_key_file_that_is_none_ends_with_three_and_names_it(tmp_path: Path) -> None:
    (tmp_path / "key").write_text("hunter2")
    done = subprocess.run(
        [sys.executable, "-m", "magmav.cli", "run", "udpin:127.0.0.1:0", "--key-file", str(tmp_path / "key"),
         "--store", str(tmp_path / "m.sqlite")], capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 3 and "no signing key" in done.stderr and "hunter2" not in done.stderr
