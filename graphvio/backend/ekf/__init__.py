"""The paper's extended Kalman filter (section 5), and the same model as a factor graph."""
