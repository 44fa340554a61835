"""Scenes of known truth: a robot with two lasers and drifting odometry, ray-cast through a mesh."""

from bsmap_cli.simulate.scenes import SCENES
from bsmap_cli.simulate.simulation import Simulation, simulate_scene

__all__ = ["SCENES", "Simulation", "simulate_scene"]
