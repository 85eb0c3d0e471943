"""Motions by rolling shutters in the smoother: the velocities by which they were compensated are its variables."""

from dataclasses import replace

import numpy as np
from synthetic import measured_motion, pose_at, velocity_at
from test_backend_smoother import PERIOD_NS, Run, known_to

from graphvio.arrays import Float
from graphvio.backend.states import RigState
from graphvio.geometry import se3_exp
from graphvio.measurements.motion import ByVelocities

SPEED_SIGMA = 1.0
FRAMESETS_OF_A_KEYFRAME = 5
BY_VELOCITY = 0.03 * np.vstack([0.2 * np.eye(3), np.eye(3)])  # seconds until a middle line, and a turn that looks alike
DERIVATIVES = np.array([BY_VELOCITY, -BY_VELOCITY])


class RollingRun(Run):
    """A walk whose framesets are compensated by the velocity that the smoother predicts, unknown at first."""

    def begin(self, has_factor: bool) -> "RollingRun":
        self.has_factor, self.used, self.refused = has_factor, {0: np.zeros(3)}, 0
        velocity = velocity_at(0.0) + SPEED_SIGMA * self.rng.standard_normal(3)
        pose = pose_at(0.0)
        self.smoother.initialise(0, RigState(pose, velocity, np.zeros(3), np.zeros(3)), known_to(pose, SPEED_SIGMA))
        return self

    def frameset(self, stamp_ns: int, reference_ns: int) -> None:
        state = self.predict(stamp_ns)
        self.used[stamp_ns] = state.nav_T_body[:3, :3].T @ state.velocity_nav
        used = np.array([self.used[stamp_ns], self.used[reference_ns]])
        true = np.array([in_body(stamp_ns), in_body(reference_ns)])
        motion = measured_motion(reference_ns, stamp_ns, self.rng)
        seen = motion.reference_T_current @ se3_exp(np.einsum("kij,kj->i", DERIVATIVES, true - used))
        by_velocities = ByVelocities(used, DERIVATIVES, np.tile(np.eye(3), (2, 1, 1))) if self.has_factor else None
        motion = replace(motion, reference_T_current=seen, by_velocities=by_velocities)
        if self.smoother.gate(motion).accepted:
            self.smoother.add_motion(motion)
        else:
            self.refused += 1
        self.smoother.update(frozenset({reference_ns, stamp_ns}))

    def walk(self, framesets: int) -> "RollingRun":
        for k in range(framesets):
            reference = k - k % FRAMESETS_OF_A_KEYFRAME
            self.frameset((k + 1) * PERIOD_NS, reference * PERIOD_NS)
        return self


def in_body(stamp_ns: int) -> Float:
    return np.asarray(pose_at(1e-9 * stamp_ns)[:3, :3].T @ velocity_at(1e-9 * stamp_ns))


def test_velocities_that_were_wrong_do_not_make_motions_wrong() -> None:
    with_factor, without = ([RollingRun(seed).begin(each).walk(40) for seed in range(12)] for each in (True, False))
    assert sum(run.refused for run in with_factor) <= 3  # of 480, at a gate that one in ten thousand exceeds
    assert 4.0 < np.mean([run.nees() for run in with_factor]) < 8.5
    assert sum(run.refused for run in without) > 50
    assert np.mean([run.nees() for run in without]) > 9.0


def test_gate_knows_what_wrong_velocities_do() -> None:
    """The first motion is off by 3 cm, and accepted; one that is turned is not: the gyro knows that it has not."""
    for seed in range(6):
        run = RollingRun(seed).begin(has_factor=True)
        state = run.predict(PERIOD_NS)
        used = np.array([state.nav_T_body[:3, :3].T @ state.velocity_nav, np.zeros(3)])
        true, motion = np.array([in_body(PERIOD_NS), in_body(0)]), measured_motion(0, PERIOD_NS, run.rng)
        off = np.einsum("kij,kj->i", DERIVATIVES, true - used)
        by_velocities = ByVelocities(used, DERIVATIVES, np.tile(np.eye(3), (2, 1, 1)))
        seen = replace(motion, reference_T_current=motion.reference_T_current @ se3_exp(off))
        assert run.smoother.gate(replace(seen, by_velocities=by_velocities)).accepted
        turned = replace(motion, reference_T_current=motion.reference_T_current @ se3_exp(np.r_[0.02, np.zeros(5)]))
        assert not run.smoother.gate(replace(turned, by_velocities=by_velocities)).accepted
