"""dronekit2 as a ground station: it sends every PARAM_SET to component 0. Prints one JSON document.

python dronekit_ground.py PORT
"""

import json
import sys
import time

from dronekit import connect


def settled(vehicle, name, value):
    """The value a moment later: a PARAM_VALUE of the list, on its way when the set was, is taken for its answer."""
    end = time.monotonic() + 5.0
    while vehicle.parameters[name] != value and time.monotonic() < end:
        time.sleep(0.1)
    return vehicle.parameters[name]


def main():
    vehicle = connect(f"udpout:127.0.0.1:{sys.argv[1]}", wait_ready=["parameters"], timeout=60)
    out = {"armed": vehicle.armed}
    end = time.monotonic() + 30.0
    while "MMAG_LEARN" not in vehicle.parameters and time.monotonic() < end:
        time.sleep(0.2)
    ours, grew = [], time.monotonic()
    while time.monotonic() - grew < 4.0 and time.monotonic() < end:  # the list is paced by our budget
        now = [name for name in vehicle.parameters if name.startswith("MMAG_")]
        ours, grew = now, grew if len(now) == len(ours) else time.monotonic()
        time.sleep(0.2)
    out["ours"] = len(ours)
    out["before"] = vehicle.parameters["MMAG_LEARN"]
    out["set"] = vehicle.parameters.set("MMAG_LEARN", 0.0, retries=3)
    out["after"] = settled(vehicle, "MMAG_LEARN", 0.0)
    out["vehicle set"] = vehicle.parameters.set("COMPASS_OFS_Z", 11.5, retries=3)
    out["vehicle after"] = settled(vehicle, "COMPASS_OFS_Z", 11.5)
    # A trigger wants exactly our component: dronekit2 cannot give it, and is told the old value.
    out["trigger"] = vehicle.parameters.set("MMAG_UPLOAD", 1.0, retries=1)
    out["trigger after"] = vehicle.parameters["MMAG_UPLOAD"]
    print(json.dumps(out), flush=True)
    vehicle.close()


main()
