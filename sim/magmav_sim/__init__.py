"""A vehicle on the other end of the wire: flown by JSBSim, speaking MAVLink as ArduPilot 4.5 or PX4 does.

    scenario -> mission (pilot, JSBSim) -> State -> world (field, iron, noise) -> autopilot -> frames
    frames -> protocol -> autopilot (ardupilot, px4)

It shares no code with ``magmav.core``, so that a sign error cannot cancel: field in mG, body axes
forward-right-down, earth north-east-down, angles rad. All of it is deterministic; only a link has a clock.

    link = SimulatedLink(Simulation(load_scenario("demo")))   # in process, bit for bit the same each time
    python -m magmav_sim demo --to udpout:127.0.0.1:14550     # on a wire
"""

from magmav_sim.link import SimulatedLink
from magmav_sim.scenario import Scenario, ScenarioError
from magmav_sim.scenario_file import load_scenario, parse_scenario, scenario_files
from magmav_sim.serve import serve
from magmav_sim.truth import TruthLog
from magmav_sim.vehicle import Simulation, Truth

__all__ = [
    "Scenario",
    "ScenarioError",
    "SimulatedLink",
    "Simulation",
    "Truth",
    "TruthLog",
    "load_scenario",
    "parse_scenario",
    "scenario_files",
    "serve",
]
