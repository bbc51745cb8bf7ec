"""Each fault an autopilot or a link can have, in the words of a scenario and with its values."""

from __future__ import annotations

import hashlib
from typing import Any

import pytest
from magmav_sim import ScenarioError, SimulatedLink, Simulation, load_scenario, scenario_files
from magmav_sim.__main__ import main
from magmav_sim.link import ROUTE, SECOND_ROUTE
from pymavlink.dialects.v20 import ardupilotmega as dialect
from sim_rig import COMPASS, Ground, simulation

from magmav.link.udp import udp_in

ACCEPTED = 0
KEY = bytes(range(32))
PX4 = '[autopilot]\nkind = "px4"\n'


def fault(text: str, body: str = "") -> Ground:
    return Ground(simulation(COMPASS + body + "[[fault]]\n" + text))


def set_all(ground: Ground, *values: float) -> None:
    for axis, value in zip("XYZ", values, strict=False):
        ground.send(dialect.MAVLink_param_set_message(1, 1, f"COMPASS_OFS_{axis}".encode(), value, 9))


def held(ground: Ground) -> list[float]:
    return [ground.sim.autopilot.parameters[f"COMPASS_OFS_{axis}"] for axis in "XYZ"]


# ---------------------------------------------------------------- slow


def test_slow_autopilot_acts_at_once_and_answers_late_and_in_order():
    ground = fault('kind = "slow"\nseconds = 3.0\n')
    set_all(ground, 1.0, 2.0, 3.0)
    heard = ground.run(2.9)
    assert held(ground) == [1.0, 2.0, 3.0]
    assert not [m for m in heard if m.get_type() == "PARAM_VALUE"]
    echoes = ground.of("PARAM_VALUE", 0.3)
    assert [(m.param_id[-1], m.param_value) for m in echoes] == [("X", 1.0), ("Y", 2.0), ("Z", 3.0)]
    assert len([m for m in ground.heard if m.get_type() == "HEARTBEAT"]) == 4  # streams are not slow


def test_slow_commands_and_lists_too_and_it_ends():
    ground = fault('kind = "slow"\nseconds = 2.0\nuntil_s = 1.0\n')
    ground.send(dialect.MAVLink_command_long_message(1, 1, 511, 0, 27, 100_000, 0, 0, 0, 0, 0))
    ground.send(dialect.MAVLink_param_request_list_message(1, 1))
    early = ground.run(1.9)
    assert not [m for m in early if m.get_type() in ("COMMAND_ACK", "PARAM_VALUE")]
    assert [m for m in early if m.get_type() == "RAW_IMU"]
    late = ground.run(2.0)
    assert [m.param_index for m in late if m.get_type() == "PARAM_VALUE"] == list(
        range(len(ground.sim.autopilot.parameters))
    )
    assert ground.set("COMPASS_OFS_X", 4.0)


# ---------------------------------------------------------------- reboots, writers


@pytest.mark.parametrize(("lost", "want"), [("false", [1.0, 2.0, 0.0]), ("true", [1.0, 0.0, 0.0])])
def test_reboot_after_the_nth_set_loses_what_follows_and_perhaps_the_last(lost, want):
    ground = fault(f'kind = "reboot_after_sets"\nsets = 2\nlost = {lost}\n')
    ground.run(5.0)
    set_all(ground, 1.0, 2.0, 3.0)
    echoes = ground.of("PARAM_VALUE", 0.02)
    assert [m.param_value for m in echoes] == [1.0, 2.0]  # told, whether or not it was saved
    assert ground.sim.boot_ns < 0.1e9
    assert ground.run(1.0) == []  # booting
    ground.run(2.0)
    assert held(ground) == want
    assert [ground.read(f"COMPASS_OFS_{axis}")[0].param_value for axis in "XYZ"] == want


def test_px4_reboots_after_the_nth_set_too():
    ground = Ground(simulation(COMPASS + PX4 + '[[fault]]\nkind = "reboot_after_sets"\nsets = 1\nlost = true\n'))
    ground.run(2.0)
    ground.send(dialect.MAVLink_param_set_message(1, 1, b"CAL_MAG0_XOFF", 0.5, 9))
    ground.run(3.0)
    assert ground.sim.autopilot.parameters["CAL_MAG0_XOFF"] == 0.0
    assert "reboot" in [e["what"] for e in ground.sim.autopilot.events]


@pytest.mark.parametrize("echoed", [True, False])
def test_second_writer_after_the_nth_set(echoed):
    text = 'kind = "second_writer"\nname = "COMPASS_OFS_X"\nvalue = 33.0\nsets = 2\n'
    ground = fault(text + f"echoed = {str(echoed).lower()}\n")
    set_all(ground, 1.0, 2.0)
    told = [(m.param_id[-1], m.param_value) for m in ground.of("PARAM_VALUE", 0.5)]
    assert told == [("X", 1.0), ("Y", 2.0)] + [("X", 33.0)] * echoed
    assert held(ground) == [33.0, 2.0, 0.0]


def test_second_writer_at_a_time_moves_the_stream_as_well():
    ground = fault('kind = "second_writer"\nname = "COMPASS_OFS_Z"\nvalue = 20.0\nat_s = 2.0\n')
    ground.stream(27, 20)
    before = ground.field()
    ground.run(2.0)
    assert (ground.field() - before).tolist() == [0, 0, 20]
    ground.set("COMPASS_OFS_Z", 5.0)
    ground.run(1.0)
    assert held(ground)[2] == 5.0  # it wrote once


def test_second_writer_switches_learning_on():
    ground = fault('kind = "second_writer"\nname = "COMPASS_LEARN"\nvalue = 3\nat_s = 1.0\n')
    ground.run(1.2)
    assert ground.read("COMPASS_LEARN")[0].param_value == 3


def test_a_writer_of_an_unknown_name_is_a_wrong_scenario():
    with pytest.raises(ScenarioError, match="CAL_MAG0_XOFF"):
        fault('kind = "second_writer"\nname = "CAL_MAG0_XOFF"\nvalue = 1.0\n')


def test_px4_deaf_without_effect_and_with_another_sensor():
    def px4(text):
        return Ground(simulation(COMPASS + PX4 + "[[fault]]\n" + text))

    deaf = px4('kind = "deaf"\n')
    assert deaf.read("CAL_MAG0_XOFF") == []
    numb = px4('kind = "no_effect"\n')
    numb.run(1.5)
    before = numb.sim.autopilot.published_mg[0]
    numb.send(dialect.MAVLink_param_set_message(1, 1, b"CAL_MAG0_XOFF", 0.25, 9))
    (echo,) = numb.of("PARAM_VALUE", 0.02)
    numb.run(3.0)
    assert (echo.param_value, numb.sim.autopilot.published_mg[0]) == (0.25, pytest.approx(before))
    body = COMPASS + PX4 + '[autopilot.parameters]\nCAL_MAG0_XOFF = 0.1\n[[fault]]\nkind = "device_id"\ncompass = 1\n'
    other = Ground(simulation(body + "device_id = 4711\nat_s = 2.0\n"))
    other.run(1.9)
    was = other.sim.autopilot.published_mg[0]
    other.run(2.0)
    assert other.sim.autopilot.published_mg[0] == pytest.approx((was[0] + 100, was[1], was[2]))  # no slot is its own
    assert other.sim.autopilot.parameters["CAL_MAG0_ID"] == 97539


# ---------------------------------------------------------------- signed


class Signing(Ground):
    """A ground station that signs, by pymavlink."""

    def __init__(self, sim: Simulation, key: bytes | None = KEY, stamp: int | None = None) -> None:
        super().__init__(sim)
        signing = self._mav.signing
        signing.secret_key, signing.link_id, signing.sign_outgoing = key, 3, key is not None
        signing.timestamp = now(sim) if stamp is None else stamp


def now(sim: Simulation) -> int:
    """10 us since 2015, by the vehicle's clock."""
    return (sim.autopilot.unix_ns - 1_420_070_400 * 10**9) // 10_000


def signed(more: str = "") -> Simulation:
    return simulation(COMPASS + f'[[fault]]\nkind = "signed"\nkey = "{KEY.hex()}"\nlink_id = 9\n{more}')


def test_signed_vehicle_signs_everything_with_a_time_that_grows():
    sim = signed()
    frames = sim.advance(3.0)
    stamps = []
    for frame in frames:
        assert frame[2] & 1 and frame[-13] == 9
        assert hashlib.sha256(KEY + frame[:-6]).digest()[:6] == frame[-6:]
        stamps.append(int.from_bytes(frame[-12:-6], "little"))
    assert len(stamps) == 4 and stamps == sorted(set(stamps))
    assert 0 <= now(sim) - stamps[-1] < 10**5
    heard = Signing(signed()).run(1.5)  # pymavlink believes it
    assert [m.get_type() for m in heard] == ["HEARTBEAT"] * 2


def test_signed_vehicle_believes_only_its_key():
    sim = signed()
    assert Signing(sim, None).set("COMPASS_OFS_X", 1.0) == []
    Signing(sim, bytes(32)).send(dialect.MAVLink_param_set_message(1, 1, b"COMPASS_OFS_X", 2.0, 9))
    sim.advance(0.1)
    assert sim.autopilot.parameters["COMPASS_OFS_X"] == 0.0
    assert Signing(sim).set("COMPASS_OFS_X", 3.0)[0].param_value == 3.0
    (_, signer), *_ = sim._signed
    assert dict(signer.counts) == {"unsigned": 1, "forged": 1}


def test_what_was_said_before_is_not_believed_again():
    sim = signed()
    ground = Signing(sim)
    frames = [
        bytes(dialect.MAVLink_param_set_message(1, 1, b"COMPASS_OFS_X", value, 9).pack(ground._mav))
        for value in (1.0, 2.0)
    ]
    for frame in (*frames, frames[0]):
        sim.receive(frame)
        sim.advance(0.02)
    assert sim.autopilot.parameters["COMPASS_OFS_X"] == 2.0
    minute = 60 * 10**5
    for late, want in ((minute + 10, 2.0), (minute - 1000, 5.0)):  # a new sender may be a minute behind, no more
        other = Signing(sim, stamp=now(sim) - late)
        other._mav.signing.link_id = 40
        other.send(dialect.MAVLink_param_set_message(1, 1, b"COMPASS_OFS_X", 5.0, 9))
        sim.advance(0.02)
        assert sim.autopilot.parameters["COMPASS_OFS_X"] == want


def test_signing_may_begin_and_end():
    sim = signed("at_s = 1.0\nuntil_s = 2.0\n")
    flags = [frame[2] & 1 for frame in sim.advance(3.5)]
    assert flags == [0, 1, 0, 0]


@pytest.mark.parametrize("key", ["00", "zz" * 32, "0" * 63])
def test_a_key_that_is_none_is_refused(key):
    with pytest.raises(ScenarioError, match="fault"):
        fault(f'kind = "signed"\nkey = "{key}"\n')


# ---------------------------------------------------------------- second route


def heard_by_route(sim: Simulation, seconds: float, act: Any = None) -> dict[str, list[Any]]:
    link = SimulatedLink(sim, until_s=sim.elapsed_ns / 1e9 + seconds)
    parsers = {ROUTE: dialect.MAVLink(None), SECOND_ROUTE: dialect.MAVLink(None)}
    out: dict[str, list[Any]] = {ROUTE: [], SECOND_ROUTE: []}
    for packet in link.packets():
        if packet.data:
            out[packet.route] += parsers[packet.route].parse_buffer(packet.data) or []
        elif act is not None:
            act(link)
            act = None
    return out


def test_second_route_claims_to_be_the_same_autopilot():
    sim = simulation(COMPASS + '[[fault]]\nkind = "second_route"\nat_s = 1.0\nuntil_s = 4.0\n')
    heard = heard_by_route(sim, 6.0)
    assert {m.get_type() for m in heard[ROUTE]} == {"HEARTBEAT"}
    beats = [m for m in heard[SECOND_ROUTE] if m.get_type() == "HEARTBEAT"]
    assert len(beats) == 3
    first = beats[0]
    assert (first.get_srcSystem(), first.get_srcComponent(), first.autopilot, first.base_mode & 128) == (1, 1, 3, 0)
    landed = [m.landed_state for m in heard[SECOND_ROUTE] if m.get_type() == "EXTENDED_SYS_STATE"]
    assert landed == [1, 1, 1]


def test_second_route_echoes_what_was_never_stored_there_and_may_pull_the_trigger():
    sim = simulation(COMPASS + '[[fault]]\nkind = "second_route"\narmed = true\nlanded = false\ntriggers = 2\n')
    sender = dialect.MAVLink(None, 255, 190)

    def write(link):
        for message in (
            dialect.MAVLink_param_set_message(2, 1, b"COMPASS_OFS_X", 12.0, 9),  # for somebody else: not stored
            dialect.MAVLink_param_request_read_message(2, 1, b"COMPASS_OFS_X", -1),
        ):
            link.send(bytes(message.pack(sender)))
        link.send(b"whatever", SECOND_ROUTE)

    heard = heard_by_route(sim, 2.0, write)[SECOND_ROUTE]
    assert [m.param_value for m in heard if m.get_type() == "PARAM_VALUE"] == [12.0, 12.0]
    assert sim.autopilot.parameters["COMPASS_OFS_X"] == 0.0
    (trigger,) = [m for m in heard if m.get_type() == "PARAM_SET"]
    assert (trigger.target_component, trigger.param_id, trigger.param_value) == (191, "MMAG_UPLOAD", 2.0)
    assert (trigger.get_srcSystem(), trigger.get_srcComponent()) == (255, 190)
    assert all(m.base_mode & 128 for m in heard if m.get_type() == "HEARTBEAT")
    assert {m.landed_state for m in heard if m.get_type() == "EXTENDED_SYS_STATE"} == {2}


def test_second_route_is_a_second_socket_on_the_wire(tmp_path):
    text = (scenario_files()["second_route"].read_text()).replace("stay = true", "end_ground_s = 0.0")
    text = text[: text.index("[[flight]]")].replace("at_s = 5.0", "at_s = 0.0") + (
        '[[flight]]\nstart = "command"\nwait_s = 4.0\npattern = [{ kind = "takeoff" }, { kind = "land" }]\n'
    )
    path = tmp_path / "short.toml"
    path.write_text(text)
    link = udp_in("127.0.0.1", 0)
    try:
        assert main([str(path), "--to", f"udpout:127.0.0.1:{link.port}", "--speed", "100"]) == 0
        routes = set()
        for packet in link.packets():
            if not packet.data:
                break
            routes.add(packet.route)
    finally:
        link.close()
    assert len(routes) == 2


# ---------------------------------------------------------------- the files


FILES = (
    "px4", "px4_autocal", "ardupilot_newer", "uncommitted", "deaf", "no_effect", "slow", "arms_midway",
    "reboots_midway",
    "changed_device", "second_writer", "signed", "second_route",
)  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_every_fault_has_a_scenario_of_its_own(name):
    scenario = load_scenario(name)
    sim = Simulation(scenario)
    assert sim.advance(3.0) and scenario.stay
    assert {f.__struct_config__.tag for f in scenario.faults} <= {
        "deaf", "no_effect", "slow", "arms_after_sets", "reboot_after_sets", "device_id", "second_writer", "signed",
        "second_route",
    }  # fmt: skip


def test_scenarios_together_hold_every_fault_of_the_autopilot():
    named = {f.__struct_config__.tag for name in scenario_files() for f in load_scenario(name).faults}
    assert named >= {
        "deaf", "no_effect", "slow", "arms_after_sets", "reboot", "reboot_after_sets", "device_id", "second_writer",
        "signed", "second_route", "iron_step", "frozen", "absent",
    }  # fmt: skip
