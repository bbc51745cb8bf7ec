"""MAVProxy's own loader of parameter files, which is pymavlink's. Prints what it read as one JSON document.

python mavproxy_parameters.py FILE
"""

import contextlib
import json
import sys

from MAVProxy.modules.lib import param_ftp  # noqa: F401 (that this is MAVProxy's environment)
from pymavlink.mavparm import MAVParmDict


def main():
    held = MAVParmDict()
    with contextlib.redirect_stdout(sys.stderr):
        if not held.load(sys.argv[1]):
            sys.exit(1)
    print(json.dumps(held))


main()
