"""Scenario files: all of the shipped ones fly, and a wrong one is refused by file, key and value."""

from __future__ import annotations

import math

import pytest
from magmav_sim import ScenarioError, Simulation, load_scenario, parse_scenario, scenario_files
from sim_rig import COMPASS, HEAD

NAMES = {
    "demo", "hover_yaw", "figure8", "survey", "loiter", "climbs", "s_turns", "payload_step", "drift", "motor",
    "takeoff_anomaly", "soft_iron", "three_compasses", "frozen", "absent", "reboot_in_flight",
}  # fmt: skip


def test_every_scenario_has_a_name_and_starts():
    assert set(scenario_files()) >= NAMES
    for name in scenario_files():
        scenario = load_scenario(name)
        assert scenario.name == name and len(scenario.about) > 20
        simulation = Simulation(scenario)
        simulation.advance(1.0)
        assert not simulation.finished


def test_demo_is_hard_enough_to_be_worth_showing():
    demo = load_scenario("demo")
    assert len(demo.compasses) == 2 and demo.autopilot.yaw == "compass"
    for compass in demo.compasses:
        assert math.hypot(*compass.hard_iron_mg[:2]) >= 150
        assert max(map(abs, compass.hard_iron_mg)) <= 400
    assert len(demo.flights) == 2 and demo.flights[1].start == "command"


def test_path_and_bare_name_give_the_same():
    assert load_scenario(scenario_files()["figure8"]) == load_scenario("figure8")


FLIGHT = '[[flight]]\npattern = [{ kind = "takeoff" }, { kind = "land" }]\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HEAD.replace("seed = 5", 'seed = "x"') + COMPASS, ("seed", "'x'")),
        (HEAD + "colour = 3\n" + COMPASS, ("colour", "3")),
        (HEAD + COMPASS.replace("noise_mg = 0.0", "noise_mg = -2.0"), ("compass", "noise_mg", "-2.0")),
        (HEAD + COMPASS + "nose = 1\n", ("compass", "nose", "1")),
        (HEAD + COMPASS + '[[fault]]\nkind = "frozen"\ncompass = 2\n', ("fault[0].compass", "2")),
        (HEAD + COMPASS + '[[fault]]\nkind = "gremlin"\n', ("fault", "gremlin")),
        (HEAD + COMPASS + FLIGHT.replace("land", "loiter"), ("flight[0].pattern[1].kind", "Loiter")),
        (HEAD + COMPASS + FLIGHT.replace("takeoff", "hover"), ("flight[0].pattern[0].kind", "Hover")),
        (HEAD.replace("F450", "747") + COMPASS, ("airframe", "747")),
        (HEAD.replace("2026-11", "2035-11") + COMPASS, ("date", "2035")),
        (HEAD.replace("10:00:00Z", "10:00:00") + COMPASS, ("date", "2026")),
        (HEAD, ("compass",)),
        (HEAD + COMPASS.replace("100.0, -50.0", "nan, -50.0"), ("compass[0].hard_iron_mg[0]", "nan")),
        (HEAD.replace("alt_m = 488.0", "alt_m = inf") + COMPASS, ("place.alt_m", "inf")),
        ("seed = = 1", ("not TOML",)),
    ],
)  # fmt: skip
def test_wrong_scenario_is_refused_naming_file_key_and_value(text, words):
    with pytest.raises(ScenarioError) as refused:
        parse_scenario(text.encode(), "some/where.toml")
    for word in ("some/where.toml", *words):
        assert word in str(refused.value)


@pytest.mark.parametrize(
    "extra",
    [
        "[autopilot.parameters]\nNONSENSE = 1e300\n",
        "[autopilot]\nrates_hz = { NONSENSE = 5 }\n",
        "[autopilot.parameters]\nNONSENSE = 1.0\n",
    ],
)
def test_unknown_names_of_the_autopilot_are_refused(extra):
    with pytest.raises(ScenarioError, match="NONSENSE"):
        Simulation(parse_scenario((HEAD + COMPASS + extra).encode(), "x.toml"))


def test_missing_scenario_is_named_with_what_there_is(tmp_path):
    with pytest.raises(ScenarioError, match=r"nowhere.*demo"):
        load_scenario("nowhere")
    with pytest.raises(ScenarioError, match=r"gone\.toml.*No such file"):
        load_scenario(tmp_path / "gone.toml")
