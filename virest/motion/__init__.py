"""How the camera moved: orientation from the gyroscope, tracked points, and the two brought together."""
