"""Estimation from frames and inertial samples together: tracked points, clocks, robust fits and their covariances."""
