"""magmav keeps a vehicle's compass calibrated while it flies, and says how sure it is.

Path     link -> mavlink.codec -> mavlink.decode -> core.assemble -> core.estimators -> core.gate -> mavlink -> link
         bytes   message          reading           Sample           Estimate           Verdict      message
Frames   b body (forward, right, down)   n earth (north, east, down)   l levelled: b with roll and pitch undone
Names    mag_b_mg is a field in b, milligauss.  R_bn takes n to b.  shape (3,) unless said.
Units    field mG, rates rad/s, angles rad, specific force m/s^2 (level and still: -g on z), time ns or s by name
Clocks   boot_ns is the vehicle's clock, for dt.  t_ns and now_ns are the link's arrival clock, for timeouts.
Sign     a hard iron is what you subtract.  Only mavlink/autopilot knows that ArduPilot adds and PX4 subtracts.
"""

__version__ = "0.1.0"
