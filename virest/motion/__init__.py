"""Camera motion: orientation and displacement from the inertial samples, and the moving lens."""
