"""Compiles what the odometry and the simulator need into the cache, where the processes of the tests find it."""

from graphvio.config import Config
from graphvio.simulation.simulator import make_simulator
from graphvio.warmup import warm_up

simulator = make_simulator("room")
simulator.frameset(0)
warm_up(simulator.rig, Config())
