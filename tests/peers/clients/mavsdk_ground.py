"""mavsdk as a ground station: parameters and component metadata of component 191. Prints one JSON document.

python mavsdk_ground.py PORT
"""

import contextlib
import json
import sys
import time

from mavsdk import Configuration, Mavsdk
from mavsdk.component_type import ComponentType
from mavsdk.plugins.component_metadata import ComponentMetadata
from mavsdk.plugins.component_metadata.component_metadata import ComponentMetadataError, MetadataType
from mavsdk.plugins.param import Param
from mavsdk.plugins.param.param import ParamError, ProtocolVersion


def params(system, component):
    """A Param plugin turned to one component."""
    plugin = Param(system)
    with contextlib.suppress(ParamError):  # mavsdk 4.1.0 raises UNKNOWN although it took effect
        plugin.select_component(component, ProtocolVersion.V1)
    return plugin


def refusal(call, *words):
    """The name of the error a call ends with, "" when it works."""
    try:
        call(*words)
    except ParamError as error:
        return error.result.name
    return ""


def metadata(system, component):
    """parameter.json as mavsdk fetched it, or the error's name."""
    plugin = ComponentMetadata(system)
    plugin.request_component(component)
    result = "never asked"
    for _ in range(100):
        try:
            return json.loads(plugin.get_metadata(component, MetadataType.PARAMETER).json_metadata)
        except ComponentMetadataError as error:
            result = error.result.name
        time.sleep(0.1)
    return result


def main():
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    mavsdk.add_any_connection(f"udpout://127.0.0.1:{sys.argv[1]}")
    system = mavsdk.first_autopilot(20.0)
    # Component 191 is heard by then, and has read what it reads of the vehicle: mavsdk takes every PARAM_VALUE that
    # passes while it lists, whichever component sent it.
    time.sleep(10.0)
    vehicle, ours = params(system, 1), params(system, 191)
    out = {"vehicle": vehicle.get_param_float("COMPASS_OFS_Y")}
    everything = ours.get_all_params()
    out["all"] = {p.name: p.value for p in everything.float_params}
    out["ints"] = [p.name for p in everything.int_params]
    out["before"] = ours.get_param_float("MMAG_LEARN")
    out["set"] = refusal(ours.set_param_float, "MMAG_LEARN", 0.0)
    out["after"] = ours.get_param_float("MMAG_LEARN")
    out["read-only"] = refusal(ours.set_param_float, "MMAG_RESULT", 7.0)
    out["unknown"] = refusal(ours.get_param_float, "MMAG_NOSUCH")
    out["result"] = ours.get_param_float("MMAG_RESULT")
    out["metadata"] = metadata(system, 191)
    print(json.dumps(out), flush=True)


main()
