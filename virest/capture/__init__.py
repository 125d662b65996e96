"""What was recorded: the logger's files, the movie, the inertial samples, and one joined `Capture` of them."""
