"""What frames and inertial samples tell together: tracked points, clocks, robust fits with their deviations."""
