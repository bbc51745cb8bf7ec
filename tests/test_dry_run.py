"""The dry run names every message before it is sent: what then really leaves us is on its list, and nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from flight_rig import IRON_MG, SpyLink
from magmav_sim import Simulation, parse_scenario
from magmav_sim.link import SimulatedLink
from pymavlink.dialects.v20 import ardupilotmega as dialect
from test_upload_far import GROUND

from magmav.core.types import Change
from magmav.geomag import world_magnetic_model
from magmav.live import Session, transact
from magmav.mavlink.autopilot.plan import plan_change
from magmav.settings import Settings
from magmav.store import Store, Write

Ran = tuple[dict[str, Any], set[str]]
"""What it printed, and what left us."""
COMMANDS = {number: entry.name for number, entry in dialect.enums["MAV_CMD"].items()}


def line(m: Any) -> str:
    """A message as the dry run names it."""
    kind = m.get_type()
    if kind == "PARAM_SET":
        return f"{kind} {m.param_id} {m.param_value!r}"
    if kind == "PARAM_REQUEST_READ":
        return f"{kind} {m.param_id}"
    if kind == "COMMAND_LONG":
        of = m.command in (dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAV_CMD_REQUEST_MESSAGE)
        return f"{kind} {COMMANDS[m.command]}" + (f" {dialect.mavlink_map[int(m.param1)].msgname}" if of else "")
    if kind == "PARAM_VALUE":
        return f"{kind} MMAG_" if m.param_id.startswith("MMAG_") else f"{kind} {m.param_id}"
    return str(kind)


def run(simulation: Simulation, store: Store, *, dry: bool, undo: bool, code: int | None) -> Ran:
    """One `magmav upload` or `restore`: what it printed, and what left us."""
    link = SpyLink(SimulatedLink(simulation, until_s=simulation.elapsed_ns / 1e9 + 120.0), simulation)
    session = Session.on(link, Settings(), world_magnetic_model, store, ask=False)

    def pick(device: int) -> Change | Write:
        if undo:
            row = store.last_restorable(1, 1, device, session.companion.writer.vehicle)
            assert row is not None
            return row
        flown = session.companion.flown()
        assert flown is not None
        sigma = np.array((2.0, 2.0, 5.0))
        change = plan_change(flown.calibrations, 1, 1, IRON_MG, sigma, (True, True, True))
        assert change is not None
        return change

    confirm = None if undo or dry else code
    out = transact(session, link, 1, pick, confirm=confirm, dry=dry, wait_s=20.0, progress=lambda text: None)
    reader = dialect.MAVLink(None)
    return out, {line(m) for sent in link.sent for m in (reader.parse_buffer(sent.data) or [])}


@pytest.fixture(scope="module")
def day(tmp_path_factory: pytest.TempPathFactory) -> list[Ran]:
    """Dry, real, the undo dry, the undo real."""
    simulation = Simulation(parse_scenario(GROUND, "ground.toml"), 3)
    with Store(tmp_path_factory.mktemp("dry") / "s.sqlite") as store:
        first = run(simulation, store, dry=True, undo=False, code=None)
        code = first[0]["confirm_code"]
        rest = ((False, False), (True, True), (False, True))
        return [first, *(run(simulation, store, dry=dry, undo=undo, code=code) for dry, undo in rest)]


@pytest.mark.parametrize("first", [0, 2])
def test_dry_run_names_every_message_that_the_real_run_sends_and_none_besides(day: list[Ran], first: int) -> None:
    (shown, sent_dry), (done, sent) = day[first : first + 2]
    assert done["result"] == ("ALL_NEW", "ALL_OLD")[first // 2]
    said = {text.split(" (")[0] for text in shown["messages"] if not text.startswith("a change above")}
    perhaps = {"COMMAND_LONG MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES", "PARAM_VALUE MMAG_", "STATUSTEXT"}
    assert sent <= said, sorted(sent - said)
    assert said - sent <= perhaps, sorted(said - sent)
    assert not {text for text in sent_dry if text.startswith("PARAM_SET") or "PREARM" in text}
    assert sent_dry <= said


def test_dry_run_of_a_restore_shows_the_old_values_and_wants_no_code(
    day: list[Ran],
) -> None:
    upload, restore = day[0][0], day[2][0]
    sets = [text.split()[:3] for text in restore["messages"] if text.startswith("PARAM_SET")]
    assert sets == [["PARAM_SET", name, repr(value)] for name, value in upload["old"].items()]
    assert any("confirm with code" in text for text in upload["messages"])
    assert not any("confirm with code" in text for text in restore["messages"])
