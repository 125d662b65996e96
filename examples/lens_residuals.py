"""Simulated residuals of a calibration with an off-centre lens, for `virest criticise`: 40 frames of 60 points, as CSV.

$ python examples/lens_residuals.py > residuals.csv
"""

import sys

import numpy as np

FRAMES, POINTS, NOISE_PX, TANGENTIAL_PX = 40, 60, 0.15, 0.25

rng = np.random.default_rng(1)
count = FRAMES * POINTS
x, y = rng.uniform(0, 640, count), rng.uniform(0, 480, count)
frame = np.repeat(np.arange(FRAMES), POINTS)
vx, vy = (np.repeat(rng.normal(0, 150, FRAMES), POINTS) for _ in "xy")
u, v = (x - 320) / 320, (y - 240) / 320
dx = rng.normal(0, NOISE_PX, count) + TANGENTIAL_PX * 2 * u * v
dy = rng.normal(0, NOISE_PX, count) + TANGENTIAL_PX * (u * u + 3 * v * v)
table = np.column_stack([x, y, dx, dy, y / 480, frame, vx, vy])
np.savetxt(sys.stdout, table, fmt="%.4f", delimiter=",", header="x,y,dx,dy,row,frame,vx,vy", comments="")
