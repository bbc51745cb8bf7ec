"""The vehicle on a link: pace, pings, truth files, and the program's manners."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
from itertools import pairwise

import pytest
from magmav_sim import TruthLog, serve
from magmav_sim.__main__ import main
from magmav_sim.serve import packed
from pymavlink.dialects.v20 import ardupilotmega as dialect
from sim_rig import COMPASS, Ground, simulation

from magmav.link import LinkError
from magmav.link.memory import SetClock, memory_pair
from magmav.link.open import stays_here
from magmav.link.udp import udp_in


class Bench:
    """A served vehicle on a clock that we move: each look at the time moves it by 10 ms."""

    def __init__(self, speed, answer, seconds):
        self.clock = SetClock()
        vehicle, self.ground = memory_pair(self.clock)
        self.sim = simulation()
        self.answer = answer
        self.mav = dialect.MAVLink(None, 1, 191)
        self.pings = []
        self.ahead_s = []
        self.end_s = seconds
        self._reading = self.ground.packets()
        serve(vehicle, self.sim, speed, None, self.step)

    def step(self):
        """Called by the vehicle after every packet: the other end's turn, then time goes on."""
        while data := next(self._reading).data:
            for message in self.mav.parse_buffer(data) or []:
                if message.get_type() == "PING":
                    self.pings.append((message.seq, self.sim.elapsed_ns / 1e9))
                    if self.answer(self.clock.now_ns / 1e9, message):
                        reply = dialect.MAVLink_ping_message(0, message.seq, 1, 1)
                        self.ground.send(bytes(reply.pack(self.mav)))
        self.clock.advance(0.01)
        return self.clock.now_ns >= self.end_s * 1e9


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_speed_is_a_multiple_of_the_links_time(speed):
    bench = Bench(speed, lambda now, ping: False, 3.0)
    assert bench.sim.elapsed_ns / 1e9 == pytest.approx(3 * speed, abs=0.02 * speed + 0.02)
    assert bench.pings == []


def test_answered_pings_let_it_run_far_ahead_of_the_clock():
    bench = Bench(None, lambda now, ping: True, 1.0)
    assert bench.sim.elapsed_ns / 1e9 > 15
    assert [seq for seq, _ in bench.pings] == list(range(1, len(bench.pings) + 1))


def test_unanswered_it_waits_a_second_and_then_keeps_real_time():
    bench = Bench(None, lambda now, ping: False, 0.95)
    assert bench.sim.elapsed_ns / 1e9 == pytest.approx(0.2, abs=0.021)
    bench = Bench(None, lambda now, ping: False, 5.0)
    assert bench.sim.elapsed_ns / 1e9 == pytest.approx(0.2 + 4.0, abs=0.05)


def test_never_runs_more_than_the_window_past_the_last_answer():
    bench = Bench(None, lambda now, ping: ping.seq <= 5, 1.0)
    assert bench.sim.elapsed_ns / 1e9 == pytest.approx(5 * 0.2 + 0.4, abs=0.021)


def test_listener_that_wakes_up_late_ends_the_slow_pace():
    bench = Bench(None, lambda now, ping: now > 3.0, 3.5)
    assert bench.sim.elapsed_ns / 1e9 > 8


def test_frames_share_datagrams_without_being_cut():
    frames = [bytes([i]) * size for i, size in enumerate((500, 600, 200, 1200, 10))]
    out = packed(frames)
    assert [len(d) for d in out] == [1100, 200, 1200, 10]
    assert b"".join(out) == b"".join(frames)


SHORT = """
seed = 5
airframe = "F450"
date = 2026-11-22T10:00:00Z
place = { lat_deg = 47.3977, lon_deg = 8.5456, alt_m = 488.0 }
[[compass]]
device_id = 97539
hard_iron_mg = [80.0, -20.0, 40.0]
noise_mg = 4.0
[[flight]]
pattern = [
    { kind = "takeoff", height_m = 12.0, climb_mps = 3.0 },
    { kind = "yaw", turns = 1.0, rate_dps = 36.0 },
    { kind = "land", sink_mps = 2.0 },
]
"""

FLIGHT = """
[[flight]]
ground_s = 2.0
pattern = [{ kind = "takeoff", height_m = 3.0, climb_mps = 2.0 }, { kind = "land", sink_mps = 2.0 }]
"""


def test_truth_files_say_what_was_true(tmp_path):
    sim = simulation(
        COMPASS + '[[fault]]\nkind = "iron_step"\ncompass = 1\nat_s = 4.0\nmg = [5.0, 6.0, 7.0]\n' + FLIGHT,
        top="end_ground_s = 1.0",
    )
    with TruthLog(tmp_path / "new", sim) as truth:
        while not sim.finished:
            sim.advance(0.02)
            truth.sample()
    rows = list(csv.DictReader((tmp_path / "new" / "truth.csv").read_text().splitlines()))
    assert list(rows[0])[:4] == ["boot_time_s", "roll_deg", "pitch_deg", "heading_true_deg"]
    times = [float(r["boot_time_s"]) for r in rows]
    steps = [round(b - a, 3) for a, b in pairwise(times)]
    assert len(times) == pytest.approx(20 * sim.elapsed_ns / 1e9, abs=2)
    assert set(steps) <= {0.04, 0.06, 0.05}
    assert float(rows[0]["heading_true_deg"]) == pytest.approx(70, abs=1e-3)
    assert max(float(r["height_m"]) for r in rows) == pytest.approx(3, abs=0.5)
    summary = json.loads((tmp_path / "new" / "truth.json").read_text())
    (compass,) = summary["compasses"]
    assert compass["hard_iron_mg"] == [100, -50, 200] and compass["offsets_mg"] == [-100, 50, -200]
    assert compass["hard_iron_end_mg"] == [105, -44, 207]
    assert summary["declination_deg"] == pytest.approx(3.66, abs=0.05)
    whats = [e["what"] for e in summary["events"]]
    assert whats == ["arm", "flight", "takeoff", "pattern", "pattern", "touchdown", "disarm"]


def test_program_says_what_is_wrong_and_keeps_standard_output_clean(tmp_path, capsys):
    assert main(["demo"]) == 2
    assert main(["demo", "--to", "udpout:127.0.0.1:9", "--speed", "-1"]) == 2
    assert main(["nonsense", "--to", "udpout:127.0.0.1:9"]) == 3
    assert main(["demo", "--to", "carrier pigeon"]) == 4
    (tmp_path / "file").touch()
    assert main(["demo", "--to", "udpout:127.0.0.1:9", "--truth", str(tmp_path / "file" / "x")]) == 3
    heard = capsys.readouterr()
    assert heard.out == ""
    for word in ("--to", "--speed", "nonsense", "carrier pigeon", "--truth"):
        assert word in heard.err
    assert main(["--help"]) == 0


@pytest.mark.parametrize(
    "to",
    ["udpout:192.0.2.7:14550", "udpin:0.0.0.0:14550", "udpin:[::]:14550", "tcp:192.0.2.7:5760",
     "tcp:[2001:db8::1]:5760", "udpout:255.255.255.255:14550", "udpout:[::ffff:192.0.2.7]:14550",
     "serial:/dev/ttyUSB0:57600", "serial:/dev/null"],
)  # fmt: skip
def test_S15_the_simulator_speaks_on_this_machine_only(to, capsys, monkeypatch):
    def refused(*args, **kwargs):
        raise AssertionError("a socket was opened")

    monkeypatch.setattr("socket.socket", refused)
    assert main(["demo", "--to", to]) == 4
    assert to in capsys.readouterr().err


@pytest.mark.parametrize("to", ["udpout:127.0.0.1:14550", "udpin::14550", "udpin:[::1]:0", "tcp:127.3.2.1:5760"])
def test_loopback_is_this_machine(to):
    assert stays_here(to) == to


# An audit hook sees every socket however it is come by, and cannot be taken off again.
GUARDED = """
import sys
def guard(event, args):
    if event in ("socket.bind", "socket.connect", "socket.sendto") or event == "socket.__new__" and args[1] != 1:
        raise SystemExit(f"{event} {args}")
sys.addaudithook(guard)
from magmav.cli import main
for words in eval(sys.argv[1]):
    assert main(words) == 0, words
try:
    main(["sim", "demo", "--to", "udpout:127.0.0.1:9"])
except SystemExit as hit:
    assert "socket" in str(hit)
else:
    raise AssertionError("the guard sees nothing")
"""


def test_S15_no_file_mode_opens_a_socket(tmp_path):
    """Flying into files, and replaying and fitting each of them; a unix socket is none that leaves the machine."""
    (tmp_path / "short.toml").write_text(SHORT)
    files = [str(tmp_path / f"f.{kind}") for kind in ("tlog", "bin", "ulg")]
    words = [["sim", str(tmp_path / "short.toml"), "--write", *files]]
    words += [["replay", path, "--json"] for path in files]
    words += [["fit", files[1], "--json", "--out", str(tmp_path / "out"), "--params", str(tmp_path / "new.param")]]
    done = subprocess.run(
        [sys.executable, "-c", GUARDED, repr(words)], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr[-2000:] + done.stdout[-500:]


def answering(link, seconds_of_simulation):
    """A companion on a real socket: answers pings until the vehicle's clock has passed some time."""
    mav = dialect.MAVLink(None, 1, 191)
    beats = 0
    for packet in link.packets():
        for message in (mav.parse_buffer(packet.data) or []) if packet.data else []:
            beats += message.get_type() == "HEARTBEAT"
            if message.get_type() == "PING" and message.target_system == 0:
                if message.time_usec >= seconds_of_simulation * 1e6:
                    return beats
                reply = dialect.MAVLink_ping_message(message.time_usec, message.seq, 1, 1)
                link.send(bytes(reply.pack(mav)), packet.route)
    raise LinkError("closed")


def test_program_flies_over_udp_at_full_speed_and_ends_on_sigterm(tmp_path):
    link = udp_in("127.0.0.1", 0)
    command = [sys.executable, "-m", "magmav_sim", "figure8", "--to", f"udpout:127.0.0.1:{link.port}"]
    vehicle = subprocess.Popen(
        [*command, "--speed", "max", "--truth", str(tmp_path)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env={**os.environ, "PYTHONWARNINGS": "error"},
    )  # fmt: skip
    try:
        assert answering(link, 30.0) == pytest.approx(31, abs=2)
        vehicle.send_signal(signal.SIGTERM)
        out, err = vehicle.communicate(timeout=10)
    finally:
        vehicle.kill()
        link.close()
    assert (vehicle.returncode, out, err) == (0, b"", b"")
    assert json.loads((tmp_path / "truth.json").read_text())["elapsed_s"] > 29
    rows = (tmp_path / "truth.csv").read_text().splitlines()
    assert len(rows) > 550


def test_ground_can_talk_to_a_served_vehicle():
    bench = Bench(1.0, lambda now, ping: False, 0.5)
    ground = Ground(bench.sim)
    assert ground.set("COMPASS_OFS_X", 4.0)[0].param_value == 4.0
