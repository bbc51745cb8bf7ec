"""The state of one hypothesis: what stands where, with its unit.

alpha   rad     azimuth of magnetic north in the own frame, a frame level with the earth that the gyro carries along
b       mG      hard iron, the sensor's axes
h, v    mG      the Earth's field here, horizontal and downward
e       rad     error of the tilt, a small rotation about the own frame's two level axes, Gauss-Markov
d       mG      short-lived disturbance of the reading, body axes, Gauss-Markov
k       mG      what full throttle adds, body axes
s       -       soft iron, symmetric: xx, yy, zz, xy, xz, yz of S, where the sensor sees (I + S) field
g       rad/s   gyro bias, body axes
t       s       delay of the compass beyond what is known
kappa   -       share of the tilt by which the reported tilt is wrong
r       rad     turn of the compass against the vehicle about the body's x and y axes
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[Any]

ALPHA = 0
B = slice(1, 4)
H, V = 4, 5
E = slice(6, 8)
D = slice(8, 11)
K = slice(11, 14)
S = slice(14, 20)
G = slice(20, 23)
T = 23
KAPPA = 24
R = slice(25, 27)
LATE = slice(23, 27)  # t, kappa and r
TURNS = np.array((6, 7, 23, 24, 25, 26))  # all that turns the field: e, t, kappa and r
SIZE = 27
