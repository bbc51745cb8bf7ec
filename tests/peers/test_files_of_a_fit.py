"""A parameter file of fit in MAVProxy 1.8.75: read by its own loader, and loaded onto a vehicle from its console."""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pytest
from parameter_entry import ARDUPILOT, PX4, entry
from rig import CLIENTS, peer, stage
from test_mavproxy import GROUNDED, ask_until, console

from magmav.fitting.parameters import file_of

pytestmark = pytest.mark.peers


@pytest.mark.parametrize("changed", [ARDUPILOT, PX4])
def test_mavproxys_loader_reads_every_value_to_the_last_bit(tmp_path, changed):
    (path := tmp_path / "new.param").write_text(file_of(entry(changed), ".param"))
    words = [peer("wire-mavproxy"), CLIENTS / "mavproxy_parameters.py", path]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=True)
    assert f"Loaded {len(changed)} parameters" in done.stderr and "Invalid" not in done.stderr
    got = json.loads(done.stdout)
    assert {n: np.float32(v).tobytes() for n, v in got.items()} == {
        n: np.float32(v).tobytes() for n, v in changed.items()
    }


@pytest.mark.long
def test_param_load_in_mavproxys_console_puts_them_on_the_vehicle(tmp_path):
    (tmp_path / "new.param").write_text(file_of(entry(ARDUPILOT), ".param"))
    with (
        stage(tmp_path, GROUNDED) as hub,
        console(tmp_path, f"--master=udpout:127.0.0.1:{hub.port}", "--streamrate=-1") as mavproxy,
    ):
        mavproxy.expect("Detected vehicle 1:1 ")
        mavproxy.say("set param_ftp False")
        mavproxy.say("vehicle 1:1")
        mavproxy.say("param fetch")
        mavproxy.expect(r"Received \d+ parameters")
        mavproxy.say("param load new.param")
        told = mavproxy.expect(r"Loaded (\d+) parameters from new.param")
        assert int(told.group(1)) == len(ARDUPILOT)
        for name in ("COMPASS_OFS_X", "COMPASS_DIA_X", "COMPASS_MOTCT"):
            shown = ask_until(mavproxy, f"param fetch {name}", rf"{name} = (-?[\d.]+)").group(1)
            assert float(shown) == pytest.approx(ARDUPILOT[name], abs=1e-6)
        mavproxy.end()
