"""The read-only file server: every byte right, every error named, no flood, no growth."""

from __future__ import annotations

import subprocess
import sys
import zlib
from pathlib import Path

import pytest
from ftp_client import Client, parsed, request
from hypothesis import given, settings
from hypothesis import strategies as st
from scripted_vehicle import MS, S, Wire

from magmav.mavlink.budget import Budget
from magmav.mavlink.ftp import MOST_CLIENTS, SILENT_NS, FileServer
from magmav.mavlink.metadata import crc32

FILES = {"general.json": b'{"version":1}', "parameter.json": bytes(range(256)) * 5, "empty": b""}
NONE, TERMINATE, RESET, LIST, OPEN, READ, CRC, BURST = 0, 1, 2, 3, 4, 5, 14, 15
ACK, NAK = 128, 129
WIRE = Wire()


def serving(bps: float = 20_000.0, **options):
    """A server with its budget counted as the companion does it, and one client."""
    budget = Budget(bps)
    server = FileServer(FILES, budget)

    def poll(now_ns):
        out = server.poll(now_ns)
        for item in out:
            budget.force(item.message, now_ns)
        return out

    budget.has(request(NONE, 0), 0)
    return server, Client(server.on_message, poll, now_ns=S, **options)


@pytest.mark.parametrize("opcode", [BURST, READ])
@pytest.mark.parametrize("path", [b"parameter.json", b"/parameter.json", b"parameter.json\0"])
def test_a_file_arrives_whole(opcode, path):
    _, client = serving()
    assert client.download(path, opcode) == FILES["parameter.json"]
    assert client.download(b"general.json", opcode, size=1) == FILES["general.json"]
    assert client.download(b"empty", opcode) == b""


def test_the_root_is_listed_by_entries_from_any_on():
    _, client = serving()
    rows = [f"F{name}\t{len(content)}".encode() for name, content in FILES.items()]
    assert client.ask(LIST, b"/").data.split(b"\0")[:-1] == rows
    assert client.ask(LIST, b"", offset=1).data.split(b"\0")[:-1] == rows[1:]
    assert client.ask(LIST, b"/", offset=3).data == bytes((6,))
    seen = []
    _, slow = serving(bps=100.0)
    while (got := slow.ask(LIST, b".", offset=len(seen))).opcode == ACK:
        seen += got.data.split(b"\0")[:-1]
    assert seen == rows, "a slow link gets them one by one"


def test_checksum_is_the_one_of_mavlink():
    """Begun at zero, not turned over (PX4's generate_crc.py); by long division here."""
    state = 0
    for byte in FILES["parameter.json"]:
        state ^= byte
        for _ in range(8):
            state = state >> 1 ^ (0xEDB88320 if state & 1 else 0)
    _, client = serving()
    assert int.from_bytes(client.ask(CRC, b"parameter.json").data, "little") == state
    assert crc32(FILES["parameter.json"]) == state != zlib.crc32(FILES["parameter.json"])


@pytest.mark.parametrize(
    ("opcode", "data", "fields", "error"),
    [
        (OPEN, b"nothing.json", {}, 10),
        (OPEN, b"../../etc/passwd", {}, 10),
        (OPEN, b"/general.json/x", {}, 10),
        (OPEN, b"", {}, 10),
        (OPEN, b"\xff\xfe", {}, 10),
        (OPEN, b"general.json", {"size": 240}, 3),
        (CRC, b"nothing.json", {}, 10),
        (LIST, b"/etc", {}, 10),
        (READ, b"", {"size": 10}, 4),
        (BURST, b"", {"size": 10}, 4),
        (BURST, b"", {"size": 10, "session": 9}, 4),
        (TERMINATE, b"", {}, 4),
        *((opcode, b"general.json", {}, 9) for opcode in range(6, 14)),
        (16, b"", {}, 7),
        (127, b"", {}, 7),
    ],
)
def test_what_cannot_be_done_is_refused_by_its_own_error(opcode, data, fields, error):
    _, client = serving()
    answer = client.ask(opcode, data, **fields)
    assert (answer.opcode, answer.data) == (NAK, bytes((error,)))


def test_reads_of_an_open_file_are_refused_beyond_its_end_or_without_a_size():
    _, client = serving()
    client.ask(OPEN, b"general.json")
    assert client.ask(READ, size=10, offset=13).data == bytes((6,))
    assert client.ask(READ, size=10, offset=2**32 - 1).data == bytes((6,))
    assert client.ask(READ, size=0).data == bytes((3,))
    assert client.ask(READ, size=10, offset=8).data == FILES["general.json"][8:]
    assert client.ask(RESET).opcode == ACK
    assert client.ask(READ, size=10).data == bytes((4,))
    assert client.ask(NONE).opcode == ACK


def test_a_repeat_gets_the_same_answer_and_an_old_number_with_another_offset_a_new_one():
    server, client = serving()
    client.ask(OPEN, b"parameter.json")

    def answer(message):
        server.on_message(WIRE.carry(message, 255, 190), "gcs", client.now_ns)
        client.now_ns += S
        (out,) = server.poll(client.now_ns)
        return parsed(bytes(WIRE.carry(out.message, 7, 191).payload))

    once = request(READ, 7, size=20, offset=40)
    assert answer(once) == answer(once) == answer(once)
    assert answer(request(READ, 7, size=20, offset=60)).data == FILES["parameter.json"][60:80]
    closing = request(TERMINATE, 8)
    assert answer(closing).opcode == answer(closing).opcode == ACK, (
        "its answer was lost: the file is closed all the same"
    )
    assert answer(request(TERMINATE, 9)).opcode == NAK
    assert answer(request(NONE, 65535)).sequence == 0


def test_who_asks_anew_no_longer_waits_for_what_was_before():
    server, client = serving()
    for sequence in range(30):
        server.on_message(WIRE.carry(request(CRC, sequence, b"general.json"), 255, 190), "gcs", client.now_ns)
    client.now_ns += S
    out = [item for _ in range(50) for item in server.poll(client.now_ns)]
    assert [parsed(bytes(WIRE.carry(o.message, 7, 191).payload)).sequence for o in out] == [30]


def test_clients_do_not_disturb_one_another_and_too_many_hear_so():
    server, first = serving()
    clients = [Client(server.on_message, server.poll, sender=(255, n), now_ns=S) for n in range(MOST_CLIENTS + 1)]
    budget = Budget(1e6)
    server._budget = budget
    names = list(FILES)[:2]
    for n, client in enumerate(clients[:-1]):
        client.now_ns = 2 * S
        assert client.ask(OPEN, names[n % 2].encode()).opcode == ACK
    clients[-1].now_ns = 3 * S
    late = clients[-1].ask(OPEN, b"general.json")
    assert (late.opcode, late.data) == (NAK, bytes((5,))), "no session is free"
    for n, client in enumerate(clients[:-1]):
        client.now_ns = 4 * S
        assert client.ask(READ, size=5).data == FILES[names[n % 2]][:5]
    clients[0].ask(RESET)
    assert clients[1].ask(READ, size=5).opcode == ACK, "a reset closes one's own file only"
    clients[-1].now_ns = 5 * S + SILENT_NS
    assert clients[-1].ask(OPEN, b"general.json").opcode == ACK
    assert first.now_ns == S


def most_in_ten_seconds(sent):
    return max(sum(n for t, n in sent if start <= t < start + 10 * S) for start, _ in sent)


def test_AT_9c_a_download_keeps_to_500_bytes_a_second_and_still_gets_on():
    _, client = serving(bps=500.0)
    began_ns = client.now_ns
    assert client.download(b"parameter.json") == FILES["parameter.json"]
    assert most_in_ten_seconds(client.sent) <= 5000
    assert (client.now_ns - began_ns) / S < 6.0, "1280 bytes"
    assert max(b[0] - a[0] for a, b in zip(client.sent, client.sent[1:], strict=False)) < S


def test_the_slowest_budget_there_is_still_serves():
    _, client = serving(bps=100.0)
    assert client.download(b"parameter.json") == FILES["parameter.json"]
    assert most_in_ten_seconds(client.sent) <= 1000


def test_thirty_percent_loss_each_way_changes_no_byte():
    for seed in range(5):
        _, client = serving(bps=2000.0, loss=0.3, seed=seed)
        assert client.download(b"parameter.json") == FILES["parameter.json"]


def test_a_storm_of_requests_is_answered_within_the_budget_and_fills_no_memory():
    server, _ = serving(bps=500.0)
    sizes, budget = [], server._budget
    for tick in range(1000):
        now_ns = S + tick * 20 * MS
        for n in range(5):
            message = WIRE.carry(request(CRC, tick, b"general.json"), 1 + n * tick % 254, tick % 250)
            server.on_message(message, f"udp:{n}", now_ns)
        for item in server.poll(now_ns):
            budget.force(item.message, now_ns)
            sizes.append((now_ns, budget.size(item.message)))
    assert most_in_ten_seconds(sizes) <= 5000
    assert sizes and len(server._clients) <= MOST_CLIENTS


@given(st.lists(st.tuples(st.binary(min_size=0, max_size=251), st.integers(1, 3)), max_size=20))
@settings(max_examples=150, deadline=None)
def test_whatever_comes_at_most_one_right_answer_goes(requests):
    server, client = serving()
    for payload, component in requests:
        message = request(NONE, 0)
        message.payload = list(payload.ljust(251, b"\0"))
        server.on_message(WIRE.carry(message, 255, component), "gcs", client.now_ns)
        client.now_ns += S
        out = server.poll(client.now_ns)
        padded = payload.ljust(251, b"\0")
        assert len(out) == (padded[3] < ACK)
        for item in out:
            got = parsed(bytes(WIRE.carry(item.message, 7, 191).payload))
            assert got.opcode in (ACK, NAK) and got.request == padded[3]
            assert got.sequence == (int.from_bytes(padded[:2], "little") + 1) & 0xFFFF
            assert len(got.data) <= 239 and not server.poll(client.now_ns)


_PYMAVLINK = """
import sys
sys.path[:0] = [{tests!r}]
from pymavlink import mavftp
from scripted_vehicle import Wire
from pymavlink.dialects.v20 import ardupilotmega as dialect
import test_ftp
server, client = test_ftp.serving(bps=100_000.0)
wire = Wire()

class Mav:
    def file_transfer_protocol_send(self, network, system, component, payload):
        message = dialect.MAVLink_file_transfer_protocol_message(network, system, component, list(payload))
        server.on_message(wire.carry(message, 255, 190), "gcs", client.now_ns)

class Master:
    mav, source_system, source_component = Mav(), 255, 190
    def recv_match(self, **anything):
        client.now_ns += 20_000_000
        for item in client.poll(client.now_ns):
            return wire.carry(item.message, 7, 191)

ftp = mavftp.MAVFTP(Master(), 7, 191)
got = ftp.read("parameter.json", 1280)
assert bytes(got) == test_ftp.FILES["parameter.json"], got
assert ftp.cmd_list(["/"]).error_code == 0
print(sorted((e.name, e.size_b) for e in ftp.list_result))
"""


def test_pymavlinks_own_client_reads_and_lists():
    """mavftp is GPL and never imported by the package; here it is somebody else, in a process of its own."""
    code = _PYMAVLINK.format(tests=str(Path(__file__).parent))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "[('empty', 0), ('general.json', 13), ('parameter.json', 1280)]" in done.stdout


class Hasty:
    """A client with MAVSDK's habits, as its source reads: session 0 always, 0.5 s, ten tries, and no patience.

    A burst that stalls is finished by reads of what is missing; an answer at an offset it does not wait for ends it.
    """

    def __init__(self, server_hear, server_poll, latency_ns):
        self.hear, self.poll, self.latency_ns = server_hear, server_poll, latency_ns
        self.now_ns, self.sequence, self.tries = 10 * S, 0, 10
        self.out, self.size, self.reading = b"", -1, False
        self.opcode, self.due_ns, self.seen = OPEN, 0, -1
        self.up, self.down = [], []

    def send(self, opcode, data=b"", **fields):
        self.opcode, self.due_ns = opcode, self.now_ns + S // 2
        message = WIRE.carry(request(opcode, self.sequence, data, **fields), 255, 190)
        self.sequence += 1
        self.up.append((self.now_ns + self.latency_ns, message))

    def more(self):
        if len(self.out) == self.size:
            self.send(TERMINATE)
        elif self.reading:
            self.send(READ, size=min(239, self.size - len(self.out)), offset=len(self.out))
        else:
            self.send(BURST, size=239, offset=len(self.out))

    def take(self, answer):
        if answer.request != self.opcode or answer.sequence == self.seen:
            return
        self.seen, self.tries = answer.sequence, 10
        assert answer.opcode == ACK
        if answer.request == OPEN:
            self.size = int.from_bytes(answer.data, "little")
        elif answer.request in (READ, BURST):
            assert answer.offset == len(self.out), "it would give up here"
            self.out += answer.data
        else:
            self.opcode = -1
            return
        self.more()

    def download(self, path):
        self.send(OPEN, path + b"\0")
        while self.opcode != -1:
            self.now_ns += 10 * MS
            while self.up and self.up[0][0] <= self.now_ns:
                self.hear(self.up.pop(0)[1], "gcs", self.now_ns)
            for item in self.poll(self.now_ns):
                payload = bytes(WIRE.carry(item.message, 7, 191).payload)
                self.down.append((self.now_ns + self.latency_ns, parsed(payload)))
            while self.down and self.down[0][0] <= self.now_ns:
                self.take(self.down.pop(0)[1])
            if self.opcode != -1 and self.now_ns >= self.due_ns:
                self.tries -= 1
                assert self.tries > 0, "timed out"
                if self.opcode == OPEN:
                    self.send(OPEN, path + b"\0")
                else:
                    self.reading = self.reading or bool(self.out)
                    self.more()
        return self.out


@pytest.mark.parametrize("latency_ms", [0, 20, 60])
@pytest.mark.parametrize("bps", [300.0, 500.0, 5000.0])
def test_a_hasty_client_gets_its_file_on_a_slow_budget(bps, latency_ms):
    """It asks again before the budget lets an answer go: only the newest question is answered, so none comes twice."""
    server, patient = serving(bps=bps)
    client = Hasty(server.on_message, patient.poll, latency_ms * MS)
    assert client.download(b"parameter.json") == FILES["parameter.json"]
