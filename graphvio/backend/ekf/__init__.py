"""The paper's extended Kalman filter (section 5)."""
