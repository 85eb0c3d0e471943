"""Compiles kernels of odometry, simulator and calibration into the cache that the processes of the tests share."""

import numpy as np

from graphvio import Trajectory, calibrate_trajectories
from graphvio.config import Config
from graphvio.simulation.simulator import make_simulator
from graphvio.warmup import warm_up

simulator = make_simulator("room")
simulator.frameset(0)
for rig in (simulator.rig, simulator.rig.without_pairs()):
    warm_up(rig, Config())

turns = make_simulator("calibration", duration_s=10.0, stationary_s=0.0)
paths = [turns.world_T_body @ pair.left.body_T_cam for pair in turns.rig.pairs]
calibrate_trajectories([Trajectory(turns.stamps_ns, np.ascontiguousarray(path)) for path in paths], ["front", "back"])
