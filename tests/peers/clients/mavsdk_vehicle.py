"""mavsdk as a vehicle's parameter server. Says "serving", then one line for every value that was set.

python mavsdk_vehicle.py PORT NAME=VALUE ...
"""

import sys
import time

from mavsdk import Configuration, Mavsdk
from mavsdk.component_type import ComponentType
from mavsdk.plugins.param_server import ParamServer


def main():
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.AUTOPILOT))
    server = ParamServer(mavsdk.server_component())
    for word in sys.argv[2:]:
        name, value = word.split("=")
        server.provide_param_float(name, float(value))
    server.subscribe_changed_param_float(lambda p, _: print(f"set {p.name} {p.value!r}", flush=True))
    mavsdk.add_any_connection(f"udpout://127.0.0.1:{sys.argv[1]}")
    print("serving", flush=True)
    while True:
        time.sleep(1.0)


main()
