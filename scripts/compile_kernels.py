"""Compiles the kernels of the odometry and the simulator into the cache that the tests' processes share."""

from graphvio.config import Config
from graphvio.simulation.simulator import make_simulator
from graphvio.warmup import warm_up

simulator = make_simulator("room")
simulator.frameset(0)
warm_up(simulator.rig, Config())
