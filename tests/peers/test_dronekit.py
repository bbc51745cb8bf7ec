"""dronekit2 3.0.0: one dictionary for all components' parameters, and every PARAM_SET to component 0."""

from __future__ import annotations

import json

import pytest
from rig import CLIENTS, peer, program, stage
from sim_rig import COMPASS, HEAD

pytestmark = pytest.mark.peers


def test_dronekit2_sets_our_parameters_and_the_vehicles_with_target_component_0(tmp_path):
    python = peer("wire-dronekit2")
    with (
        stage(tmp_path, HEAD + "stay = true\n" + COMPASS) as hub,
        program([python, CLIENTS / "dronekit_ground.py", hub.port], tmp_path) as client,
    ):
        got = json.loads(client.expect(r"^\{.*\}$", within_s=90.0).group(0))
    assert got["ours"] >= 36
    assert (got["before"], got["after"]) == (1.0, 0.0)
    assert got["vehicle after"] == 11.5
    assert got["trigger after"] == 0.0  # nothing was begun
