"""A recording is run, and the trajectory evaluated by graphvio and by evo (pip install evo).

    python examples/evaluate_with_evo.py RECORDING

evo takes nearest stamps, and graphvio interpolates the truth: their figures differ by little.
"""

import sys
from pathlib import Path

import numpy as np
from evo.core import metrics, sync
from evo.core.trajectory import PoseTrajectory3D

import graphvio
from graphvio.evaluation import evaluate
from graphvio.sources import Source
from graphvio.trajectory import Trajectory
from graphvio.trajectory_files import load_trajectory


def estimated(source: Source) -> Trajectory:
    """Return the trajectory that the odometry estimates."""
    odometry = graphvio.Odometry(source.rig)
    estimates = [odometry.process(measurement) for measurement in source] + list(odometry.finish())
    posed = {e.stamp_ns: e.nav_T_body for e in estimates if e is not None and e.nav_T_body is not None}
    return Trajectory(np.array(list(posed)), np.array(list(posed.values())))


def of_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    """Return evo's form of a trajectory."""
    return PoseTrajectory3D(poses_se3=list(trajectory.nav_T_body), timestamps=trajectory.stamps_ns * 1e-9)


def main(recording: Path) -> None:
    """Print the ATE by both."""
    source = graphvio.open_source(recording)
    if source.truth is None:
        raise SystemExit(f"{recording} has no truth")
    trajectory, truth = estimated(source), load_trajectory(source.truth)
    print(f"graphvio: ATE rmse {1e3 * evaluate(trajectory, truth).ate_position_m.rmse:.2f} mm")
    reference, estimate = sync.associate_trajectories(of_evo(truth), of_evo(trajectory), max_diff=0.01)
    estimate.align(reference)
    ate = metrics.APE(metrics.PoseRelation.translation_part)
    ate.process_data((reference, estimate))
    print(f"evo: ATE rmse {1e3 * ate.get_statistic(metrics.StatisticsType.rmse):.2f} mm")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
