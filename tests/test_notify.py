"""What a service manager hears: ready when the work can begin, alive while it goes on, stopping at its end.

Real unix datagram sockets, and the real program; systemd itself only checks the unit, for there is none running.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from process_rig import free_port
from pymavlink.dialects.v20 import ardupilotmega as dialect

from magmav.core.types import Change, UploadResult
from magmav.notify import Notifier
from magmav.store import Store

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"
_F_SETPIPE_SZ = 1031
_REFUSE_EXEC_GAIN = (65, 1, 0, 0, 0)  # prctl(PR_SET_MDWE): what MemoryDenyWriteExecute asks of the kernel
_PATIENCE_S = 60.0


@contextmanager
def manager(address):
    """A socket that hears what systemd would hear."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        sock.bind(address)
        sock.settimeout(0.0)
        yield sock


def heard(sock):
    """Everything that waits, a datagram each."""
    out = []
    while True:
        try:
            out.append(sock.recv(4096).decode())
        except BlockingIOError:
            return out


def await_line(sock, line):
    """The datagram with this line, after any others; AssertionError when it does not come."""
    sock.settimeout(_PATIENCE_S)
    try:
        while line not in (text := sock.recv(4096).decode()).split("\n"):
            pass
    except TimeoutError:
        raise AssertionError(f"{line} was never said") from None
    finally:
        sock.settimeout(0.0)
    return text


@contextmanager
def service(folder, *words, watchdog_us=400_000, **options):
    """`magmav run` as systemd starts it; the notify socket and the process."""
    address = str(folder / "notify")
    env = os.environ | {"NOTIFY_SOCKET": address, "STATE_DIRECTORY": str(folder / "state")}
    env |= {"WATCHDOG_USEC": str(watchdog_us)}
    command = [sys.executable, "-m", "magmav.cli", "run", *map(str, words)]
    with (
        manager(address) as sock,
        subprocess.Popen(command, env=env, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, **options) as run,
    ):
        try:
            yield sock, run
        finally:
            run.kill()


# ------------------------------------------------------------ the protocol


def test_each_state_is_one_datagram_and_said_once(tmp_path):
    with manager(str(tmp_path / "n")) as sock:
        n = Notifier(str(tmp_path / "n"), 100)
        n.ready("listening on\nudpin")
        n.ready("again")
        n.beat(0)
        n.stopping()
        n.stopping()
        assert heard(sock) == ["READY=1\nSTATUS=listening on udpin", "WATCHDOG=1", "STOPPING=1"]
        assert n.counts == {"sent": 3}


def test_an_address_of_the_abstract_namespace(tmp_path):
    name = f"magmav-test-{os.getpid()}"
    with manager("\0" + name) as sock:
        Notifier("@" + name).ready()
        assert heard(sock) == ["READY=1"]


@given(
    steps=st.lists(st.integers(0, 400), min_size=1, max_size=200),
    every=st.integers(1, 1000),
)
def test_beats_keep_their_distance_and_never_miss_their_time(tmp_path_factory, steps, every):
    """However often the loop turns: two beats are never nearer than the period, and no turn after it goes unsaid."""
    address = str(tmp_path_factory.getbasetemp() / f"n{os.getpid()}")
    Path(address).unlink(missing_ok=True)
    with manager(address) as sock:
        n, now, beats, last = Notifier(address, every), 0, [], None
        for step in steps:
            now += step
            n.beat(now)
            if heard(sock):
                beats.append(now)
                assert last is None or now - last >= every
                last = now
            else:
                assert last is not None and now - last < every
        assert beats[0] == steps[0]


def test_a_clock_that_jumped_back_does_not_silence_the_watchdog(tmp_path):
    with manager(str(tmp_path / "n")) as sock:
        n = Notifier(str(tmp_path / "n"), 1000)
        n.beat(5_000_000)
        n.beat(10)
        assert len(heard(sock)) == 2


def test_nobody_to_tell_is_no_error(tmp_path):
    n = Notifier()
    n.ready()
    n.beat(0)
    n.stopping()
    assert not n.counts
    lost = Notifier(str(tmp_path / "nobody"), 1)
    lost.ready()
    lost.beat(0)
    assert lost.counts == {"send errors": 2}


def test_a_manager_that_does_not_read_holds_nothing_up(tmp_path):
    with manager(str(tmp_path / "n")):
        n = Notifier(str(tmp_path / "n"), 1)
        for now in range(5000):
            n.beat(now)
        assert n.counts["send errors"] > 0
        assert n.counts.total() == 5000


@pytest.mark.parametrize(
    ("environ", "every_ns", "told"),
    [
        ({}, 0, False),
        ({"NOTIFY_SOCKET": "/x"}, 0, True),
        ({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "10000000"}, 5_000_000_000, True),
        ({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "42"}, 5_000_000_000, True),
        ({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "41"}, 0, True),
        ({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "soon"}, 0, True),
        ({"NOTIFY_SOCKET": "vsock:2:1234", "WATCHDOG_USEC": "10"}, 0, False),
        ({"NOTIFY_SOCKET": "/"}, 0, False),
    ],
)
def test_what_systemd_set(environ, every_ns, told):
    n = Notifier.from_environment(environ, pid=42)
    assert n.every_ns == every_ns
    n.ready()
    assert bool(n.counts) == told
    with pytest.raises(ValueError, match="every_ns"):
        Notifier("/x", -1)


# ------------------------------------------------------------ the program


def test_run_says_ready_beats_and_on_sigterm_stops_cleanly(tmp_path):
    with service(tmp_path, "udpin:127.0.0.1:0") as (sock, run):
        assert "STATUS=listening on udpin:127.0.0.1:0" in await_line(sock, "READY=1")
        for _ in range(3):
            assert await_line(sock, "WATCHDOG=1") == "WATCHDOG=1"
        run.send_signal(signal.SIGTERM)
        await_line(sock, "STOPPING=1")
        assert run.wait(_PATIENCE_S) == 0
        assert b"Traceback" not in run.stderr.read()
    assert (tmp_path / "state" / "magmav.sqlite").exists()


def test_beats_stop_when_the_work_hangs_though_the_process_lives(tmp_path):
    """The loop is held by a recording nobody reads; a thread or a timer of its own would go on beating."""
    os.mkfifo(pipe := tmp_path / "held.tlog")
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    fcntl.fcntl(reader, _F_SETPIPE_SZ, 4096)
    port = free_port()
    words = (f"udpin:127.0.0.1:{port}", "--record", pipe)
    with service(tmp_path, *words) as (sock, run), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        await_line(sock, "WATCHDOG=1")
        beat = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3).pack(dialect.MAVLink(None, 1, 1))
        for _ in range(400):  # 29 bytes each, far more than the pipe holds
            vehicle.sendto(bytes(beat), ("127.0.0.1", port))
        quiet_since = time.monotonic()
        while time.monotonic() - quiet_since < 2.0:  # ten beats long
            quiet_since = time.monotonic() if heard(sock) else quiet_since
            time.sleep(0.05)
        assert run.poll() is None
        os.close(reader)


def test_state_survives_kills(tmp_path):
    """Two lives in one state directory, each ended by SIGKILL: what was on record before is there after each."""
    path = tmp_path / "state" / "magmav.sqlite"
    names, shift_mg, sigma_mg = ("COMPASS_OFS_X",), (12.5, 0.0, 0.0), (1.0, 1.0, 1.0)
    change = Change(1, 1, "COMPASS_DEV_ID", 97539, names, (0.0,), (12.5,), shift_mg, sigma_mg, (12.5,))
    with Store(path) as store:
        store.finish(store.begin(change, 1_000), UploadResult.ALL_NEW, ())
        store.begin(change, 2_000)  # cut short
        before = store.history()
    for _ in range(2):
        with service(tmp_path, "udpin:127.0.0.1:0") as (sock, run):
            await_line(sock, "READY=1")
            run.kill()
            assert run.wait() == -signal.SIGKILL
        (tmp_path / "notify").unlink()
        with Store(path) as store:
            assert store.history() == before
            assert [row.id for row in store.pending()] == [2]


def test_it_runs_where_no_memory_may_become_executable(tmp_path):
    """MemoryDenyWriteExecute of the unit, asked of the kernel directly; numpy and scipy are loaded by then."""
    libc = ctypes.CDLL(None)
    probe = f"import ctypes; raise SystemExit(-ctypes.CDLL(None).prctl{_REFUSE_EXEC_GAIN})"
    if subprocess.run([sys.executable, "-c", probe], check=False).returncode != 0:
        pytest.skip("this kernel knows no PR_SET_MDWE (Linux 6.3 and newer do)")
    with service(tmp_path, "udpin:127.0.0.1:0", preexec_fn=lambda: libc.prctl(*_REFUSE_EXEC_GAIN)) as (sock, run):
        await_line(sock, "WATCHDOG=1")
        run.send_signal(signal.SIGTERM)
        assert run.wait(_PATIENCE_S) == 0


# ------------------------------------------------------------ the unit and the container file


def unit(folder):
    """The unit with its program where this checkout has it."""
    text = (DEPLOY / "magmav.service").read_text()
    assert text.count("/opt/magmav/bin/magmav ") == 1
    here = folder / "magmav.service"
    here.write_text(text.replace("/opt/magmav/bin/magmav", str(Path(sys.executable).with_name("magmav"))))
    (folder / "magmav.service.d").mkdir()
    shutil.copy(DEPLOY / "magmav-serial.conf", folder / "magmav.service.d" / "serial.conf")
    return here


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_finds_no_fault_in_the_unit(tmp_path):
    here = unit(tmp_path)
    done = subprocess.run(["systemd-analyze", "verify", here], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    # The same with one line that is wrong, or the check would check nothing.
    here.write_text(here.read_text() + "\n[Service]\nWatchdogSec=soon\n")
    done = subprocess.run(["systemd-analyze", "verify", here], capture_output=True, text=True, timeout=60, check=False)
    assert "soon" in done.stderr


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_counts_the_unit_among_the_closed_ones(tmp_path):
    command = ["systemd-analyze", "security", "--offline=true", "--threshold=20", unit(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if "ffline" in done.stderr:
        pytest.skip("systemd-analyze of before 250 cannot judge a unit that is not loaded")
    assert done.returncode == 0, done.stdout[-200:]  # exposure of at most 2.0 of 10


def test_the_unit_waits_long_enough_and_keeps_its_state_private():
    text = (DEPLOY / "magmav.service").read_text()
    for line in ("Type=notify", "NotifyAccess=main", "WatchdogSec=10", "StateDirectoryMode=0700", "DynamicUser=yes"):
        assert f"\n{line}\n" in text
    assert "ExecStart=/opt/magmav/bin/magmav run $MAGMAV_LINK $MAGMAV_OPTIONS" in text


def test_the_container_file_copies_what_the_build_needs_and_runs_as_nobody():
    text = (DEPLOY / "Containerfile").read_text()
    copied = {w for line in re.findall(r"^COPY (?!--from)(.+) \S+$", text, re.M) for w in line.split()}
    assert {"pyproject.toml", "uv.lock", "README.md", "LICENSE", "LICENSES", "magmav", "sim", "config"} <= copied
    assert all((ROOT / name).exists() for name in copied)
    assert re.search(r"^USER (?!0|root)\S+$", text, re.M)
    assert re.search(r'^ENTRYPOINT \["', text, re.M)  # no shell between the runtime's SIGTERM and us
    assert "MAGMAV_STATE=/var/lib/magmav" in text
    assert f"uv=={uv_version()}" in text


def uv_version():
    (found,) = re.findall(r"^UV_VERSION := (\S+)$", (ROOT / "Makefile").read_text(), re.M)
    return found
