"""mavsdk 4.1.0 on both sides of us: a ground station that reads and sets, and a vehicle that is written to."""

from __future__ import annotations

import json
import math
import threading
import time
from contextlib import contextmanager
from socket import AF_INET, SOCK_DGRAM, socket

import pytest
from process_rig import free_port, magmav
from pymavlink.dialects.v20 import ardupilotmega as dialect
from rig import CLIENTS, peer, program, stage
from sim_rig import COMPASS, HEAD

pytestmark = pytest.mark.peers
GROUNDED = HEAD + "stay = true\n" + COMPASS
_IRON_MG = (60.0, -40.0, 80.0)
_STORED = {
    "COMPASS_OFS_X": 0.0, "COMPASS_OFS_Y": 0.0, "COMPASS_OFS_Z": 0.0, "COMPASS_DEV_ID": 97539.0,
    "COMPASS_PRIO1_ID": 97539.0, "COMPASS_LEARN": 0.0, "COMPASS_OFFS_MAX": 1800.0, "COMPASS_ORIENT": 0.0,
}  # fmt: skip


def test_mavsdk_reads_and_sets_the_parameters_of_component_191_and_reads_what_they_mean(tmp_path):
    """One story, for its beginning takes half of its time: the list, a SET, refusals, and the metadata end to end."""
    python = peer("wire-mavsdk")
    with (
        stage(tmp_path, GROUNDED) as hub,
        program([python, CLIENTS / "mavsdk_ground.py", hub.port], tmp_path) as client,
    ):
        ground = json.loads(client.expect(r"^\{.*\}$").group(0))
    assert ground["vehicle"] == 0.0
    # mavsdk mixes in what other components send while it lists; every name of ours has to be there.
    ours = {name for name in ground["all"] if name.startswith("MMAG_")}
    assert len(ours) >= 36
    assert not [name for name in ground["ints"] if name.startswith("MMAG_")]
    assert (ground["before"], ground["set"], ground["after"]) == (1.0, "", 0.0)
    assert (ground["read-only"], ground["result"]) == ("READ_ONLY", 0.0)
    assert ground["unknown"] == "DOES_NOT_EXIST"
    described = {p["name"]: p for p in ground["metadata"]["parameters"]}
    assert set(described) == ours
    assert all(p["type"] == "Float" and p["shortDesc"] for p in described.values())


class Sidecar:
    """Between mavsdk's parameter server and magmav: what mavsdk lacks of an ArduPilot vehicle standing on the ground.

    A heartbeat, landed state, and IMU streams whose field follows the offsets that mavsdk says it holds.
    ``ardupilot`` False: only passes packets on.
    """

    def __init__(self, magmav_port: int, *, ardupilot: bool) -> None:
        self.ardupilot = ardupilot
        self.offsets = dict.fromkeys("XYZ", 0.0)
        self.near, self.far = socket(AF_INET, SOCK_DGRAM), socket(AF_INET, SOCK_DGRAM)
        for sock in (self.near, self.far):
            sock.bind(("127.0.0.1", 0))
            sock.setblocking(False)
        self.port = self.near.getsockname()[1]
        self._magmav = ("127.0.0.1", magmav_port)
        self._mavsdk = None
        self._stop = threading.Event()
        self._mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
        self._parser = dialect.MAVLink(None)
        self._parser.robust_parsing = True
        self._thread = threading.Thread(target=self._work, daemon=True)

    def _work(self) -> None:
        begun, turn = time.monotonic(), 0
        while not self._stop.wait(0.01):
            self._pass_on()
            ms = round((time.monotonic() - begun) * 1000)
            if self.ardupilot and ms >= 50 * turn:
                turn += 1
                for message in self._vehicle(60_000 + ms, turn):
                    self.far.sendto(bytes(message.pack(self._mav)), self._magmav)

    def _pass_on(self) -> None:
        while (data := _waiting(self.far)) is not None:
            if self._mavsdk is not None:
                self.near.sendto(data[0], self._mavsdk)
        while (data := _waiting(self.near)) is not None:
            self._mavsdk = data[1]
            for message in self._parser.parse_buffer(data[0]) or []:
                kind = message.get_type()
                if kind == "PARAM_VALUE" and message.param_id[:-1] == "COMPASS_OFS_":
                    self.offsets[message.param_id[-1]] = message.param_value
                if not (self.ardupilot and kind in ("HEARTBEAT", "AUTOPILOT_VERSION")):
                    self.far.sendto(bytes(message.get_msgbuf()), self._magmav)

    def _vehicle(self, ms: int, turn: int):
        wobble = 3.0 * math.sin(turn)
        field = [220.0 + wobble + self.offsets["X"], 30.0 + self.offsets["Y"], 430.0 + self.offsets["Z"]]
        yield dialect.MAVLink_raw_imu_message(ms * 1000, 0, 0, -1000, 0, 0, 0, *(round(v) for v in field))
        yield dialect.MAVLink_attitude_message(ms, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
        if turn % 4 == 0:
            yield dialect.MAVLink_heartbeat_message(2, 3, 81, 0, 3, 3)
            yield dialect.MAVLink_extended_sys_state_message(0, 1)
            yield dialect.MAVLink_global_position_int_message(ms, 473977000, 85456000, 488000, 0, 0, 0, 0, 0)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self._stop.set()
        self._thread.join()
        self.near.close()
        self.far.close()


def _waiting(sock):
    try:
        return sock.recvfrom(65535)
    except (BlockingIOError, ConnectionError):
        return None


@contextmanager
def mavsdk_vehicle(folder, *, ardupilot):
    """mavsdk's parameter server behind the sidecar; its program and the link for magmav."""
    python, port = peer("wire-mavsdk"), free_port()
    words = [f"{name}={value}" for name, value in _STORED.items()]
    with (
        Sidecar(port, ardupilot=ardupilot) as sidecar,
        program([python, CLIENTS / "mavsdk_vehicle.py", sidecar.port, *words], folder) as server,
    ):
        server.expect("serving")
        yield server, f"udpin:127.0.0.1:{port}"


def result_file(folder):
    """What `magmav replay --json` would have said of this vehicle."""
    compass = {
        "compass": 1, "state": "READY", "reasons": [], "hard_iron_mg": _IRON_MG, "sigma_mg": [2.0, 2.0, 2.0],
        "axes": ["OBSERVED"] * 3, "stored": _STORED,
    }  # fmt: skip
    (path := folder / "result.json").write_text(
        json.dumps({"vehicles": [{"system": 1, "autopilot": "ARDUPILOT", "compasses": [compass]}]})
    )
    return path


def test_mavsdks_parameter_server_receives_an_upload(tmp_path):
    store = ["--store", tmp_path / "s.sqlite", "--system", 1, "--json"]
    with mavsdk_vehicle(tmp_path, ardupilot=True) as (server, link):
        done = magmav("upload", link, *store, "--from", result_file(tmp_path))
        assert done.code == 0, done.out + done.err
        assert done.json["result"] == "ALL_NEW"
        for axis, iron in zip("XYZ", _IRON_MG, strict=True):
            server.read = 0
            assert float(server.expect(rf"set COMPASS_OFS_{axis} (\S+)").group(1)) == -iron


def test_mavsdks_parameter_server_alone_is_refused(tmp_path):
    """Without ArduPilot's heartbeat nothing says what kind of vehicle it is, or that it is disarmed."""
    store = ["--store", tmp_path / "s.sqlite", "--system", 1, "--json", "--wait", 8]
    with mavsdk_vehicle(tmp_path, ardupilot=False) as (server, link):
        done = magmav("upload", link, *store, "--from", result_file(tmp_path))
        assert done.code in (1, 4), done.out + done.err
        assert "ALL_NEW" not in done.out
        assert not [line for line in server.lines if line.startswith("set ")]
